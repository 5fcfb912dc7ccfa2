"""Make a data set with held-out, strongly darkened queries from a map, in the layout of Aachen.

Every third photo of the map becomes a query; the others stay in the map. Each query is multiplied
by a gain, blurred, made noisy and rounded to 8 bits again, with parameters that are drawn from a
seed. With --as_they_are, queries are not altered. `pipelines.aachen --dataset` runs on it.
"""

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.training.tracks import parse_maps
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.images import read_image

EVERY = 3
GAIN = (0.06, 0.12)
BLUR = (0.3, 1.2)  # standard deviation in pixels
NOISE = 0.003  # standard deviation, relative to full scale
Vary = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def resize(image: np.ndarray, scale: float) -> np.ndarray:
    """Resize a photo by a factor."""
    if scale == 1:
        return image
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=method)


def fit(camera: pycolmap.Camera, image: np.ndarray) -> None:
    """Rescale intrinsics to the size of a photo; those that photos share are rescaled once."""
    height, width = image.shape[:2]
    if (camera.width, camera.height) != (width, height):
        camera.rescale(width, height)


def darken(
    image: np.ndarray, generator: np.random.Generator, gain: tuple[float, float] = GAIN
) -> np.ndarray:
    """Darken, blur and add noise to an 8-bit image; the gain is drawn log-uniformly."""
    view = image / 255 * np.exp(generator.uniform(*np.log(gain)))
    view = cv2.GaussianBlur(view, (0, 0), generator.uniform(*BLUR))
    view += NOISE * generator.standard_normal(view.shape)
    return np.round(255 * view.clip(0, 1)).astype(np.uint8)


def main(images: Path, model: Path, output: Path, vary: Vary | None, scale: float = 1.0) -> None:
    """Write a data set with altered queries, or with queries by day as they are.

    Args:
        images: folder of the photos.
        model: COLMAP model of them.
        output: new folder of the data set.
        vary: returns the query for an 8-bit photo, given a random generator; None: as it is.
        scale: factor of the size of all photos, map and queries.
    """
    reconstruction = colmap.read_model(model)
    photos = sorted(reconstruction.images.values(), key=lambda image: image.name)
    queries = photos[EVERY // 2 :: EVERY]
    lines, poses = [], []
    for number, photo in enumerate(queries):
        name = Path("query") / Path(photo.name).with_suffix(".png")
        target = output / "images_upright" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        generator = np.random.default_rng(number)
        view = resize(read_image(images / photo.name), scale)
        view = view if vary is None else vary(view, generator)
        cv2.imwrite(str(target), view[..., ::-1])
        camera, pose = photo.camera, photo.cam_from_world()
        fit(camera, view)
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
            if scale == 1:
                shutil.copyfile(images / photo.name, target)
            else:
                view = resize(read_image(images / photo.name), scale)
                cv2.imwrite(str(target), view[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
                fit(photo.camera, view)
            photo.name = f"db/{photo.name}"
    folder = output / "3D-models/aachen_v_1_1"
    folder.mkdir(parents=True, exist_ok=True)
    reconstruction.write_binary(folder)
    (output / "queries").mkdir(exist_ok=True)
    light = "day" if vary is None else "night"
    listed = output / f"queries/{light}_time_queries_with_intrinsics.txt"
    listed.write_text("".join(lines))
    (output / "queries/ground_truth_poses.txt").write_text("".join(poses))
    place = Aachen(output)
    print(f"{output}: {len(place.map_names())} map photos, {len(queries)} queries")


def _main() -> None:
    parser = cli.Parser(__doc__, "--map sceaux/images:sceaux/sparse --output datasets/sceaux_dark")
    parser.add_argument("--map", required=True, metavar="IMAGES:MODEL")
    changed = parser.add_mutually_exclusive_group()
    changed.add_argument(
        "--gain",
        type=float,
        nargs=2,
        default=GAIN,
        metavar=("LEAST", "MOST"),
        help="range of the gain of the queries",
    )
    changed.add_argument(
        "--as_they_are", action="store_true", help="do not alter the queries, and list them by day"
    )
    parser.add_argument("--output", type=Path, required=True, help="new folder of the data set")
    args = parser.parse_args()
    if not 0 < args.gain[0] <= args.gain[1]:
        raise InputError("--gain: give two numbers above 0, the smaller first.")
    [(images, model)] = parse_maps([args.map]).values()
    vary = None if args.as_they_are else partial(darken, gain=tuple(args.gain))
    main(images, model, args.output, vary)


if __name__ == "__main__":
    cli.run(_main)
