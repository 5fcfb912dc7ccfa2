"""Make a data set in the layout of Aachen from a map: some of its photos become queries.

Every third photo becomes a query, and the others stay in the map; with --map_every, only every
N-th photo stays, for a map with long baselines. With --gain, each query is multiplied by a gain,
blurred, made noisy and rounded to 8 bits again, with parameters that are drawn from a seed, and is
listed by night. `pipelines.aachen --dataset` runs on it. With --sequence, the photos are the frames
of an RGB-D sequence, and the model has their poses only.
"""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from benchmarks import video
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.training.tracks import parse_maps
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.images import read_image

EVERY = 3
DARK = (0.06, 0.12)  # gain
BLUR = (0.3, 1.2)  # standard deviation in pixels
NOISE = 0.003  # standard deviation, relative to full scale


def darken(
    image: np.ndarray, generator: np.random.Generator, gain: tuple[float, float] = DARK
) -> np.ndarray:
    """Darken, blur and add noise to an 8-bit image; the gain is drawn log-uniformly."""
    view = image / 255 * np.exp(generator.uniform(*np.log(gain)))
    view = cv2.GaussianBlur(view, (0, 0), generator.uniform(*BLUR))
    view += NOISE * generator.standard_normal(view.shape)
    return np.round(255 * view.clip(0, 1)).astype(np.uint8)


def main(
    images: Path,
    model: Path,
    output: Path,
    gain: tuple[float, float] | None = None,
    map_every: int | None = None,
) -> None:
    """Write a data set.

    Args:
        images: folder of the photos.
        model: COLMAP model of them.
        output: new folder of the data set.
        gain: range of the gain of the queries; default: they stay as they are.
        map_every: keep every N-th photo in the map; default: two of three.
    """
    reconstruction = colmap.read_model(model)
    photos = sorted(reconstruction.images.values(), key=lambda image: image.name)
    queries = photos[EVERY // 2 :: EVERY]
    if map_every:
        queries = [photo for i, photo in enumerate(photos) if i % map_every != map_every // 2]
    lines, poses = [], []
    for number, photo in enumerate(queries):
        name = Path("query") / Path(photo.name).with_suffix(".png")
        target = output / "images_upright" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        view = read_image(images / photo.name)
        if gain:
            view = darken(view, np.random.default_rng(number), gain)
        cv2.imwrite(str(target), view[..., ::-1])
        camera, pose = photo.camera, photo.cam_from_world()
        if (camera.width, camera.height) != (view.shape[1], view.shape[0]):
            camera.rescale(view.shape[1], view.shape[0])
        size_and_params = (camera.width, camera.height, *camera.params.tolist())
        lines.append(f"{name} {camera.model.name} {' '.join(map(repr, size_and_params))}\n")
        x, y, z, w = pose.rotation.quat.tolist()
        numbers = (w, x, y, z, *pose.translation.tolist())
        poses.append(f"{name} {' '.join(map(repr, numbers))}\n")
    for photo in queries:
        reconstruction.deregister_frame(photo.frame_id)
    for photo in photos:
        if photo.has_pose:
            target = output / "images_upright" / "db" / photo.name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(images / photo.name, target)
            photo.name = f"db/{photo.name}"
    folder = output / "3D-models/aachen_v_1_1"
    folder.mkdir(parents=True, exist_ok=True)
    reconstruction.write_binary(folder)
    (output / "queries").mkdir(exist_ok=True)
    light = "night" if gain else "day"
    listed = output / f"queries/{light}_time_queries_with_intrinsics.txt"
    listed.write_text("".join(lines))
    (output / "queries/ground_truth_poses.txt").write_text("".join(poses))
    place = Aachen(output)
    print(f"{output}: {len(place.map_names())} map photos, {len(queries)} queries")


def _main() -> None:
    parser = cli.Parser(__doc__, "--map sceaux/images:sceaux/sparse --output datasets/sparse")
    add = parser.add_argument
    add("--map", metavar="IMAGES:MODEL")
    add("--sequence", type=Path, help="folder of an RGB-D sequence, instead of --map")
    add("--gain", type=float, nargs=2, metavar=("LEAST", "MOST"), help="darken the queries by this")
    add("--map_every", type=int, metavar="N", help="keep every N-th photo in the map, at least 2")
    add("--output", type=Path, required=True, help="new folder of the data set")
    args = parser.parse_args()
    if args.gain and not 0 < args.gain[0] <= args.gain[1]:
        raise InputError("--gain: give two numbers above 0, the smaller first.")
    if args.map_every is not None and args.map_every < 2:
        raise InputError("--map_every: at least 2.")
    if (args.map is None) == (args.sequence is None):
        raise InputError("Give --map or --sequence.")
    rest = args.output, args.gain and tuple(args.gain), args.map_every
    if args.map:
        [(images, model)] = parse_maps([args.map]).values()
        main(images, model, *rest)
        return
    with TemporaryDirectory() as folder:
        images, model = Path(folder) / "images", Path(folder) / "model"
        model.mkdir()
        video.sequence(args.sequence, 0, images).write(model)
        main(images, model, *rest)


if __name__ == "__main__":
    cli.run(_main)
