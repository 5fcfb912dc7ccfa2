"""Localize queries that were resized, cropped or turned, or in a map of resized photos.

The place is in the layout of Aachen. Photos are written without EXIF data; intrinsics are given.
Each change is tried as photos are stored, and as `localization.views` shows them to the feature.
With --mixed, every second photo of the map is resized. Adds rows to results/changed_photos.csv,
leaving out what has rows unless --again is given.
"""

import copy
import os
from itertools import product
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap
import torch
import yaml

from benchmarks import rows
from hloc_reduce import Localizer, maps
from hloc_reduce.confs import features as features_confs
from hloc_reduce.datasets import true_poses
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.evaluation.poses import FAILED, pose_error
from hloc_reduce.maps.map import Map
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.files import replacing
from hloc_reduce.utils.images import read_image

NAME = "changed_photos"
NUM_LOC = 10
SHOWN = "as stored", "as shown"


def resized(photo: np.ndarray, size: float) -> np.ndarray:
    """Return a photo (H, W, 3) of another size, relative to its own."""
    height, width = (max(1, round(side * size)) for side in photo.shape[:2])
    return cv2.resize(photo, (width, height), interpolation=cv2.INTER_AREA)


def write(photo: np.ndarray, path: Path) -> None:
    """Write a photo (H, W, 3) RGB, unless it is there."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            temporary.write_bytes(cv2.imencode(path.suffix, photo[..., ::-1])[1].tobytes())


def build(
    place: Aachen,
    folder: Path,
    size: float,
    mixed: bool,
    feature: str,
    storage: str,
    as_stored: bool,
) -> Map:
    """Build the map of photos of another size, all or every second one."""
    options, built = {"storage": storage, "feature": feature}, folder / f"{feature}-{storage}"
    if as_stored:
        _, conf = features_confs.get(feature)
        conf = {**conf, "preprocessing": {**conf["preprocessing"], "resize_min": 0}}
        built = folder / f"{feature}-{storage}-as-stored"
        file = folder / f"{feature}.yaml"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(yaml.safe_dump({key: conf[key] for key in ("model", "preprocessing")}))
        options |= {"feature": str(file), "matcher": features_confs.matcher_of(conf)}
    if size == 1:
        return maps.main(built, place.images, place.reference_model, **options)
    model, resized_cameras = colmap.read_model(place.reference_model), set()
    for i, image in enumerate(sorted(model.images.values(), key=lambda image: image.name)):
        its_size = size if i % 2 or not mixed else 1
        photo = resized(read_image(place.images / image.name), its_size)
        write(photo, folder / "images" / image.name)
        if image.camera_id not in resized_cameras:
            model.cameras[image.camera_id].rescale(photo.shape[1], photo.shape[0])
        resized_cameras.add(image.camera_id)
    if mixed and len(model.cameras) < len(model.images):
        raise InputError("--mixed needs a camera for each photo of the map.")
    (folder / "sparse").mkdir(exist_ok=True)
    model.write_binary(folder / "sparse")
    return maps.main(built, folder / "images", folder / "sparse", **options)


def middle(
    photo: np.ndarray, camera: pycolmap.Camera, part: float
) -> tuple[np.ndarray, pycolmap.Camera]:
    """Return the middle part of a photo (H, W, 3), a share of each side, and its intrinsics."""
    height, width = photo.shape[:2]
    h, w = (max(1, round(side * part)) for side in (height, width))
    x, y = (width - w) // 2, (height - h) // 2
    camera = copy.deepcopy(camera)
    camera.width, camera.height = w, h
    camera.principal_point_x -= x
    camera.principal_point_y -= y
    return photo[y : y + h, x : x + w], camera


def on_its_side(camera: pycolmap.Camera, turns: int) -> pycolmap.Camera:
    """Return the intrinsics of a photo without distortion after quarter turns, counterclockwise."""
    if not turns:
        return camera
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


class Change(NamedTuple):
    """How queries are changed: resized, then cropped, then turned."""

    size: float  # relative to their own
    part: float  # that is left of each side, in the middle
    turns: int  # quarter turns, counterclockwise

    def __str__(self) -> str:
        part = "" if self.part == 1 else f", middle {self.part:g}"
        return f"queries {self.size:g}{part}, turned {90 * self.turns}"


def measured(
    localizer: Localizer, place: Aachen, folder: Path, change: Change, as_stored: bool
) -> dict[str, object]:
    """Return the cells of all queries after a change.

    Args:
        localizer: of the map.
        place: the place.
        folder: for the changed photos.
        change: of the queries.
        as_stored: give pixels, which are not turned.
    """
    queries = [query for part in place.query_lists().values() for query in part]
    truth = true_poses([name for name, _ in queries], place.ground_truth, True)
    errors, inliers, seconds = [], [], []
    for name, camera in queries:
        photo = resized(read_image(place.images / name), change.size)
        camera = copy.deepcopy(camera)
        camera.rescale(*photo.shape[1::-1])
        photo, camera = middle(photo, camera, change.part)
        photo = np.ascontiguousarray(np.rot90(photo, change.turns))
        path = folder / str(change).replace(" ", "-") / Path(name).with_suffix(".png")
        write(photo, path)
        given = photo if as_stored else path
        pose, info = localizer.localize(given, on_its_side(camera, change.turns))
        inliers.append(info["num_inliers"])
        seconds.append(sum(info["seconds"].values()))
        true = about_axis(truth[name], change.turns)
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
    add("--part", nargs="+", type=float, default=[1], help="of each side of the queries")
    add(
        "--turns",
        nargs="+",
        type=int,
        default=[0],
        choices=range(4),
        help="of queries, by 90 degrees",
    )
    add("--outputs", type=Path, default=Path("outputs/changed_photos"))
    add("--mixed", action="store_true", help="resize every second map photo only")
    rows.add_again_option(parser)
    args = parser.parse_args()
    if not 0 < min(args.map_size + args.size) <= max(args.map_size + args.size) <= 4:
        raise InputError("--map_size and --size: above 0, at most 4.")
    if not 0 < min(args.part) <= max(args.part) <= 1:
        raise InputError("--part: above 0, at most 1.")
    torch.set_num_threads(1)
    known = [] if args.again else rows.read(NAME)
    for root, name, map_size in product(args.dataset, args.feature, args.map_size):
        place, (feature, _, storage) = Aachen(root), name.partition(":")
        storage = storage or "float16"
        folder = args.outputs / place.root.name
        mixed = args.mixed and map_size != 1
        of_map = f"map {map_size:g}{' and 1' if mixed else ''}"
        part = folder / of_map.replace(" ", "-")
        for as_stored in (True, False):
            localizer = None
            for change in map(Change._make, product(args.size, args.part, args.turns)):
                cells = {
                    "place": place.root.name,
                    "feature": feature,
                    "storage": storage,
                    "variant": f"{of_map}, {change}, {SHOWN[not as_stored]}",
                }
                if rows.select(known, **cells):
                    continue
                if localizer is None:
                    given = part, map_size, mixed, feature, storage, as_stored
                    built = build(place, *given)
                    localizer = Localizer(built.folder, num_loc=NUM_LOC)
                cells["matcher"] = built.matcher
                rows.add(NAME, [cells | measured(localizer, place, folder, change, as_stored)])


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    cli.run(_main)
