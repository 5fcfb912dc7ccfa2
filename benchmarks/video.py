"""Compare maps of videos whose frames are paired exhaustively and in sequence.

The frames are those of a walk around the demo town, rendered with exact poses, or of an RGB-D
sequence with poses, as `benchmarks.scan_frames` reads it. They are named by their time stamps. With
--encode they are also encoded as a video, whose sharp frames are chosen. A similarity aligns the
positions of a map with the exact ones. Adds rows to results/video.csv; position errors are in
percent of the largest distance between two given positions.
"""

import shutil
import time
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from scipy.interpolate import PchipInterpolator

from benchmarks import rows
from benchmarks.photos_alone import measured
from benchmarks.scan_frames import PIXEL_CENTRE
from hloc_reduce import frames_from_video, logger, maps
from hloc_reduce.confs import features as features_confs
from hloc_reduce.demo.cameras import look
from hloc_reduce.demo.render import SUPERSAMPLING, Light, downsample, render
from hloc_reduce.demo.surface import View
from hloc_reduce.demo.town import build_town
from hloc_reduce.maps.pairing import PAIRS
from hloc_reduce.runtime import provenance
from hloc_reduce.runtime.outputs import STAGES
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.parsers import parse_pairs
from hloc_reduce.utils.progress import progress
from hloc_reduce.utils.time_stamps import name_of

NAME = "video"
RATE = 10.0  # frames per second of the videos
KINECT_RATE = 30.0  # of an RGB-D sequence, whose frames are numbered

# Around the square, (x, y, x, y) in metres of the camera and its target as in `cameras.WALK`, but
# no two of them have an obstacle between them. The end is where the walk began.
ROUTE = [
    (-8.5, -6, -9, 10),
    (-5.5, -6, -3, 10),
    (-1, -7.5, -1, 10),
    (4.5, -7, 1, 10),
    (7.8, -6.8, 4, 10),
    (7.2, -3, -12, 1),
    (7.4, 1.5, -12, 1),
    (8.4, 6, -10, 0),
    (6, 7.4, 2, -10),
    (1, 7.5, 2, -10),
    (-5, 7, -1, -10),
    (-8.8, 7, -3, -10),
    (-9, 1.5, 12, 0),
    (-9, -4, 12, 4),
    (-8.5, -6, -9, 10),
    (-5.5, -6, -3, 10),
]
METRES_PER_RADIAN = 3.0  # the camera turns so much slower that frames overlap evenly
HEIGHT, PITCH = 1.7, 0.08  # metres, radians
CAMERA = pycolmap.Camera(
    camera_id=1, model="PINHOLE", width=640, height=480, params=[528, 528, 320, 240]
)
LIGHT = Light(0, np.array([0.9, 0.85, 0.76]), np.array([0.49, 0.52, 0.57]), np.zeros(3))


def walk(number: int) -> list[pycolmap.Rigid3d]:
    """Return evenly spaced poses along `ROUTE`, camera from world."""
    x, y, x_target, y_target = np.array(ROUTE).T
    yaw = np.unwrap(np.arctan2(y_target - y, x_target - x))
    curve = PchipInterpolator(np.arange(len(x)), np.stack([x, y, yaw], axis=1))
    dense = np.linspace(0, len(x) - 1, 10_000)
    path = curve(dense)
    steps = np.linalg.norm(np.diff(path * (1, 1, METRES_PER_RADIAN), axis=0), axis=1)
    along = np.concatenate([[0], np.cumsum(steps)])
    chosen = curve(np.interp(np.linspace(0, along[-1], number), along, dense))
    sway = 0.03 * np.sin(np.arange(number))  # of steps
    return [
        look(np.array([*row[:2], HEIGHT + up]), row[2], PITCH + up / 3, up / 2)
        for row, up in zip(chosen, sway, strict=True)
    ]


def town(number: int, folder: Path) -> pycolmap.Reconstruction:
    """Render the frames of a walk, unless they are there, and return a model of their poses."""
    folder.mkdir(parents=True, exist_ok=True)
    poses = {name_of(i / RATE): pose for i, pose in enumerate(walk(number))}
    scene = build_town(0)
    for name, pose in progress(poses.items(), "Rendering", "frame", number):
        if (folder / name).exists():
            continue
        image = downsample(render(scene, View.of(CAMERA, pose, SUPERSAMPLING), LIGHT))
        image *= 0.3 / image.mean()
        levels = (np.clip(image, 0, 1) ** (1 / 2.2) * 255 + 0.5).astype(np.uint8)
        cv2.imwrite(str(folder / name), levels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
    return model_of_poses(poses, CAMERA)


def sequence(frames: Path, number: int, folder: Path) -> pycolmap.Reconstruction:
    """Link the first frames of an RGB-D sequence, and return a model of their poses."""
    matrix = np.loadtxt(frames / "camera-intrinsics.txt")
    found = sorted(frames.glob("frames/frame-*.color.jpg"))[: number or None]
    if not found:
        raise InputError(f"{frames} has no frames/frame-NNNNNN.color.jpg.")
    folder.mkdir(parents=True, exist_ok=True)
    poses = {}
    for path in found:
        stem = path.name.split(".")[0]
        name = name_of(int(stem.removeprefix("frame-")) / KINECT_RATE)
        world_from_camera = np.loadtxt(path.with_name(f"{stem}.pose.txt"))[:3]
        poses[name] = pycolmap.Rigid3d(world_from_camera).inverse()
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(path.resolve())
    height, width = cv2.imread(str(found[0])).shape[:2]
    params = [*matrix.diagonal()[:2], *(matrix[:2, 2] + PIXEL_CENTRE)]
    camera = pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=width, height=height, params=params
    )
    return model_of_poses(poses, camera)


def model_of_poses(
    poses: dict[str, pycolmap.Rigid3d], camera: pycolmap.Camera
) -> pycolmap.Reconstruction:
    """Return a model of poses without points."""
    model = pycolmap.Reconstruction()
    for i, (name, pose) in enumerate(poses.items(), 1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=i)
        colmap.add_image(model, camera, image, pose)
    return model


def encode(photos: Path, video: Path) -> Path:
    """Encode all frames of a folder, whose time stamps are multiples of 1 / `RATE`."""
    paths = sorted(photos.glob("*.jpg"))
    size = cv2.imread(str(paths[0])).shape[1::-1]
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"mp4v"), RATE, size)
    for path in paths:
        writer.write(cv2.imread(str(path)))
    writer.release()
    return video


def measure(
    photos: Path, reference: pycolmap.Reconstruction, folder: Path, feature: str, pairs: str
) -> dict[str, object]:
    """Build a map of frames and return its measures."""
    shutil.rmtree(folder, ignore_errors=True)
    built = maps.main(
        folder,
        photos,
        feature=feature,
        accept_partial=True,
        camera_mode=pycolmap.CameraMode.SINGLE,
        pairs=pairs,
    )
    seconds = {name: stage["seconds"] for name, stage in provenance.read(folder / STAGES).items()}
    lists = sorted(folder.glob("pairs-db-*.txt"))
    return measured(colmap.read_model(built.sfm), reference) | {
        "pairs": max(len({*parse_pairs(path)}) for path in lists),
        "matching_s": seconds["match_map"],
        "mapping_s": seconds["reconstruction"],
    }


def _main() -> None:
    parser = cli.Parser(__doc__, "--frames 300")
    add = parser.add_argument
    add("--sequence", type=Path, help="folder of an RGB-D sequence; default: the demo town")
    add("--frames", type=int, default=300, help="number of frames; 0: all of a sequence")
    add("--encode", action="store_true", help="encode them, and choose sharp ones")
    add("--pairs", nargs="+", default=["exhaustive", "sequential"], choices=[*PAIRS])
    add("--feature", default=features_confs.RECOMMENDED, help="name or YAML file")
    add("--outputs", type=Path, default=Path("outputs/video"), help="folder of the maps")
    rows.add_again_option(parser)
    args = parser.parse_args()
    place = args.sequence.resolve().name if args.sequence else "demo_town"
    folder = args.outputs / f"{place}-{args.frames or 'all'}"
    photos = folder / "frames"
    if args.sequence:
        reference = sequence(args.sequence, args.frames, photos)
    else:
        reference = town(args.frames, photos)
    (folder / "reference").mkdir(exist_ok=True)  # for benchmarks.mappers
    reference.write(folder / "reference")
    listed = f"{len(reference.images)} frames"
    if args.encode:
        video = encode(photos, folder / "video.mp4")
        photos = frames_from_video.main(video, folder / "chosen")
        listed = f"{listed}, chosen"
    known = [] if args.again else rows.read(NAME)
    for pairs in args.pairs:
        cells = {"place": place, "list": listed, "feature": args.feature, "variant": pairs}
        if rows.select(known, **cells):
            continue
        start, cpu = time.perf_counter(), time.process_time()
        output = folder / f"map-{pairs}{'-chosen' * args.encode}"
        try:
            cells |= measure(photos, reference, output, args.feature, pairs)
        except InputError as error:
            logger.error("%s", error)
            cells |= {"registered": 0}
        cells |= {"photos": len([*photos.glob("*.jpg")]), "cpu_s": time.process_time() - cpu}
        rows.add(NAME, [cells | rows.how(time.perf_counter() - start, 1)])


if __name__ == "__main__":
    cli.run(_main)
