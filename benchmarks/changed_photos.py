"""Localize queries that were resized or turned, or in a map of resized photos.

The place is in the layout of Aachen. Photos are written without EXIF data; intrinsics are given.
Each change is tried as it is, as a feature that knows nothing of the map would see the photo, and
as `localization.views` shows it. Adds rows to results/changed_photos.csv, leaving out what has rows
unless --again is given.
"""

import copy
import os
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import torch

from benchmarks import rows
from hloc_reduce import Localizer, maps
from hloc_reduce.datasets import true_poses
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.evaluation.poses import FAILED, pose_error
from hloc_reduce.maps.map import Map
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.images import read_image

NAME = "changed_photos"
NUM_LOC = 10


def resized(photo: np.ndarray, size: float) -> np.ndarray:
    """Return a photo (H, W, 3) of another size, relative to its own."""
    height, width = (max(1, round(side * size)) for side in photo.shape[:2])
    return cv2.resize(photo, (width, height), interpolation=cv2.INTER_AREA)


def write(photo: np.ndarray, path: Path) -> None:
    """Write a photo (H, W, 3) RGB, unless it is there."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), photo[..., ::-1])


def build(place: Aachen, folder: Path, size: float, feature: str, storage: str) -> Map:
    """Build the map of photos of another size."""
    options = {"feature": feature, "storage": storage}
    built = folder / f"{feature}-{storage}"
    if size == 1:
        return maps.main(built, place.images, place.reference_model, **options)
    model = colmap.read_model(place.reference_model)
    for image in model.images.values():
        write(resized(read_image(place.images / image.name), size), folder / "images" / image.name)
    for camera in model.cameras.values():
        camera.rescale(*(max(1, round(side * size)) for side in (camera.width, camera.height)))
    (folder / "sparse").mkdir(exist_ok=True)
    model.write_binary(folder / "sparse")
    return maps.main(built, folder / "images", folder / "sparse", **options)


def on_its_side(camera: pycolmap.Camera, turns: int) -> pycolmap.Camera:
    """Return the intrinsics of a photo without distortion after quarter turns, counterclockwise."""
    if camera.extra_params_idxs():
        raise InputError("Cameras with a distortion are not turned.")
    calibration, width, height = camera.calibration_matrix(), camera.width, camera.height
    (fx, _, x), (_, fy, y), _ = calibration.tolist()
    for _ in range(turns):
        fx, fy, x, y, width, height = fy, fx, y, width - x, height, width
    return pycolmap.Camera(model="PINHOLE", width=width, height=height, params=[fx, fy, x, y])


def about_axis(pose: pycolmap.Rigid3d, turns: int) -> pycolmap.Rigid3d:
    """Return the pose, camera from world, of a photo after quarter turns, counterclockwise."""
    turn = pycolmap.Rotation3d(np.array([0.0, 0.0, -turns * np.pi / 2]))
    return pycolmap.Rigid3d(turn, np.zeros(3)) * pose


def measured(
    localizer: Localizer, place: Aachen, folder: Path, size: float, turns: int, as_stored: bool
) -> dict[str, object]:
    """Return the cells of all queries after a change.

    Args:
        localizer: of the map.
        place: the place.
        folder: for the changed photos.
        size: of the queries, relative to their own.
        turns: quarter turns, counterclockwise.
        as_stored: give pixels, which are not turned.
    """
    queries = [query for part in place.query_lists().values() for query in part]
    truth = true_poses([name for name, _ in queries], place.ground_truth, True)
    errors, inliers, seconds = [], [], []
    for name, camera in queries:
        photo = np.rot90(resized(read_image(place.images / name), size), turns)
        path = folder / f"{size:g}-{turns}" / Path(name).with_suffix(".png")
        write(photo, path)
        its_camera = copy.deepcopy(camera)
        its_camera.rescale(*photo.shape[:2][:: 1 if turns % 2 else -1])
        its_camera = on_its_side(its_camera, turns)
        pose, info = localizer.localize(
            np.ascontiguousarray(photo) if as_stored else path, its_camera
        )
        inliers.append(info["num_inliers"])
        seconds.append(sum(info["seconds"].values()))
        true = about_axis(truth[name], turns)
        errors.append(FAILED if pose is None else pose_error(pose, true))
    localized = sum(error != FAILED for error in errors)
    return {
        "photos": len(place.map_names()),
        "points": len(localizer.reference.points),
        **rows.localization(errors, inliers, localized),
        **rows.how(float(np.mean(seconds)), cores=1),
    }


def _main() -> None:
    parser = cli.Parser(__doc__, "--dataset datasets/herz-jesus --size 0.5 --map_size 1")
    add = parser.add_argument
    add("--dataset", nargs="+", type=Path, required=True, help="places in Aachen's layout")
    add("--feature", nargs="+", default=["mini32:uint2"], help="features, with the map's storage")
    add("--map_size", nargs="+", type=float, default=[1], help="of map photos, of their own")
    add("--size", nargs="+", type=float, default=[1, 0.5, 0.35, 0.25], help="of queries")
    add(
        "--turns",
        nargs="+",
        type=int,
        default=[0],
        choices=range(4),
        help="of queries, by 90 degrees",
    )
    add("--outputs", type=Path, default=Path("outputs/changed_photos"))
    rows.add_again_option(parser)
    args = parser.parse_args()
    if not 0 < min(args.map_size + args.size) <= max(args.map_size + args.size) <= 4:
        raise InputError("--map_size and --size: above 0, at most 4.")
    torch.set_num_threads(1)
    known = [] if args.again else rows.read(NAME)
    for root, given, map_size in product(args.dataset, args.feature, args.map_size):
        place, (feature, _, storage) = Aachen(root), given.partition(":")
        storage = storage or "float16"
        folder = args.outputs / place.root.name
        built = None
        for size, turns, as_stored in product(args.size, args.turns, (True, False)):
            change = f"map {map_size:g}, queries {size:g}, turned {90 * turns}"
            variant = f"{change}, {'as stored' if as_stored else 'as shown'}"
            cells = {"place": place.root.name, "feature": feature, "storage": storage}
            cells |= {"variant": variant}
            if rows.select(known, **cells):
                continue
            built = built or build(place, folder / f"map-{map_size:g}", map_size, feature, storage)
            localizer = Localizer(built.folder, num_loc=NUM_LOC)
            if as_stored:
                localizer.preprocessing = built.conf["preprocessing"]
            cells["matcher"] = built.matcher
            rows.add(NAME, [cells | measured(localizer, place, folder, size, turns, as_stored)])


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    cli.run(_main)
