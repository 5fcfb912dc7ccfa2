"""Localize rigs: one to four cameras in the demo town at night, or the halves of dark photos.

A rig stands where a query by night is taken in towns of seed 0 with 320 photos or more; its cameras
look ahead, to the left, back and to the right, and are 20 cm apart. Adds rows to results/rigs.csv,
leaving out what has rows unless --again is given: the first one to four cameras as a rig; the photo
of these that has the most inliers when it is localized alone; all photos alone; and rigs whose last
camera took its photo elsewhere in the town. Position errors are those of the rig; `wrong` counts
those above 1 m.

With --strangers, rigs are of successive photos of other places, and none may be localized.

With --halves, each night photo of data sets in the layout of Aachen is cut into a left and a right
half, as if two cameras had taken them. `apart_cm` is the largest distance between the pose of the
halves and that of the whole photo.
"""

import copy
import os
from collections import defaultdict
from collections.abc import Sequence
from contextlib import AbstractContextManager
from itertools import product
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import numpy as np
import pycolmap
import torch

from benchmarks import rows
from hloc_reduce import Localizer, maps
from hloc_reduce.confs import features as features_confs
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.demo.cameras import NIGHT, Photo, list_photos
from hloc_reduce.demo.photo import take
from hloc_reduce.demo.town import build_town
from hloc_reduce.evaluation.poses import FAILED, pose_error
from hloc_reduce.utils import cli
from hloc_reduce.utils.files import replacing
from hloc_reduce.utils.images import list_images, read_image
from hloc_reduce.utils.progress import progress

NAME = "rigs"
NUM_LOC, SEED, FRAMES = 10, 0, 40
WRONG = 1.0  # metres
NOWHERE = float("inf"), 180.0  # the error of a rig that is not in the town
OFFSET = 0.1  # metres from the centre of the rig to each camera


def cams_from_rig(number: int) -> list[pycolmap.Rigid3d]:
    """Return the poses of cameras that look ahead, to the left, back and to the right."""
    poses = []
    for i in range(number):
        turn = pycolmap.Rotation3d(np.array([0, i * np.pi / 2, 0]))
        poses.append(pycolmap.Rigid3d(turn, np.array([0, 0, -OFFSET])))
    return poses


def photos_of(photo: Photo, number: int, folder: Path) -> list[Path]:
    """Render what the cameras of a rig see, whose first one looks as that of a photo."""
    paths = []
    for i, cam_from_rig in enumerate(cams_from_rig(number)):
        path = folder / f"{photo.index:04}-{i}.jpg"
        if not path.exists():
            pose = cam_from_rig * photo.cam_from_world
            # another index for each camera: it seeds the noise
            one = Photo(photo.kind, 100 * (i + 1) + photo.index, path.name, photo.camera, pose)
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path) as temporary:
                temporary.write_bytes(take(build_town(SEED), one, SEED))
        paths.append(path)
    return paths


def halves(image: np.ndarray, camera: pycolmap.Camera) -> list[tuple[np.ndarray, pycolmap.Camera]]:
    """Cut a photo (H, W, 3) into a left and a right half, with their intrinsics."""
    found, middle = [], camera.width // 2
    for columns in (slice(middle), slice(middle, None)):
        part = np.ascontiguousarray(image[:, columns])
        half = copy.deepcopy(camera)
        half.width = part.shape[1]
        half.principal_point_x -= columns.start or 0
        found.append((part, half))
    return found


def measure_halves(root: Path, feature: str, storage: str, folder: Path) -> dict[str, dict]:
    """Return the measures of dark photos of a place as they are, and of their halves as a rig."""
    place = Aachen(root)
    options = {"feature": feature, "storage": storage}
    built = maps.main(folder, place.images, place.reference(folder / "reference"), **options)
    localizer, true = Localizer(built.folder, num_loc=NUM_LOC), place.true_poses()
    poses: dict[str, list] = {"whole photos": [], "halves": []}
    inliers: dict[str, list] = {"whole photos": [], "halves": []}
    queries = [
        query for name, part in place.query_lists().items() if "night" in name for query in part
    ]
    for name, camera in progress(queries, "Localizing", "photo"):
        image = read_image(place.images / name, grayscale=False)
        parts = halves(image, camera)
        still = [pycolmap.Rigid3d()] * len(parts)
        for variant, (pose, info) in {
            "whole photos": localizer.localize(image, camera),
            "halves": localizer.localize_rig(*zip(*parts, strict=True), still),
        }.items():
            poses[variant].append(pose)
            inliers[variant].append(info["num_inliers"] if pose else 0)
    apart = [
        100 * pose_error(half, whole)[0]
        for half, whole in zip(poses["halves"], poses["whole photos"], strict=True)
        if half and whole
    ]
    measures = {}
    for variant, found in poses.items():
        errors = [
            FAILED if pose is None else pose_error(pose, true[name])
            for (name, _), pose in zip(queries, found, strict=True)
        ]
        localized = sum(pose is not None for pose in found)
        measures[variant] = rows.localization(errors, inliers[variant], localized)
    measures["halves"] |= {"apart_cm": max(apart), "median_apart_cm": float(np.median(apart))}
    return measures


class Found(NamedTuple):
    """The pose of a rig, None if it is not localized, its inliers, and poses that are right."""

    rig_from_world: pycolmap.Rigid3d | None
    inliers: int
    right: Sequence[pycolmap.Rigid3d]


def measures_of(found: Sequence[Found]) -> dict[str, object]:
    """Return the measures of poses, with errors to the nearest one that is right."""
    errors = [
        FAILED
        if one.rig_from_world is None
        else min(
            (pose_error(one.rig_from_world, pose) for pose in one.right), default=(np.inf, 180.0)
        )
        for one in found
    ]
    localized = sum(error != FAILED for error in errors)
    wrong = sum(error != FAILED and error[0] > WRONG for error in errors)
    measures = rows.localization(errors, [one.inliers for one in found], localized)
    return {**measures, "wrong": wrong}


def localize_town(
    localizer: Localizer, frames: Sequence[tuple[Photo, Sequence[Path]]], most: int
) -> dict[str, list[Found]]:
    """Return the poses of rigs of the town by variant.

    Args:
        localizer: a map of the town.
        frames: the photo by which each rig stands, and those of its cameras.
        most: number of cameras.
    """
    rig, found = cams_from_rig(most), defaultdict(list)
    for i, (photo, paths) in enumerate(progress(frames, "Localizing", "frame")):
        right, elsewhere = photo.cam_from_world, frames[(i + len(frames) // 2) % len(frames)]
        alone = []
        for path, cam_from_rig in zip(paths, rig, strict=True):
            pose, info = localizer.localize(path, photo.camera)
            inliers = 0 if pose is None else info["num_inliers"]
            alone.append(Found(pose and cam_from_rig.inverse() * pose, inliers, [right]))
        found["alone"] += alone
        for number in range(1, most + 1):
            cameras = [photo.camera] * number
            pose, info = localizer.localize_rig(paths[:number], cameras, rig[:number])
            inliers = info["num_inliers"] if pose else 0
            found[f"{number} cameras"].append(Found(pose, inliers, [right]))
            best = max(alone[:number], key=lambda one: one.inliers)
            found[f"best of {number}"].append(best)
            if number == 1:
                continue
            mixed = [*paths[: number - 1], elsewhere[1][number - 1]]
            cameras[-1] = elsewhere[0].camera
            pose, info = localizer.localize_rig(mixed, cameras, rig[:number])
            inliers = info["num_inliers"] if pose else 0
            both = [right, elsewhere[0].cam_from_world]
            found[f"{number} cameras, one elsewhere"].append(Found(pose, inliers, both))
    return found


def localize_strangers(
    localizer: Localizer, folders: Sequence[Path], most: int
) -> dict[str, list[Found]]:
    """Return the poses of rigs of two and of the most cameras whose photos are of other places."""
    rig, found = cams_from_rig(most), defaultdict(list)
    for folder in folders:
        paths = [folder / name for name in list_images(folder)]
        cameras = []
        for path in paths:
            height, width = read_image(path).shape[:2]
            params = [max(width, height), width / 2, height / 2]
            size = {"width": width, "height": height}
            cameras.append(pycolmap.Camera(model="SIMPLE_PINHOLE", params=params, **size))
        for number in sorted({2, most}):
            for i in progress(range(len(paths) - number + 1), f"Localizing {folder}", "rig"):
                part = slice(i, i + number)
                pose, info = localizer.localize_rig(paths[part], cameras[part], rig[:number])
                inliers = info["num_inliers"] if pose else 0
                found[f"{number} cameras, strangers"].append(Found(pose, inliers, []))
    return found


def remember(localizer: Localizer) -> AbstractContextManager:
    """In a block, let a localizer extract the features of a file once."""
    extract, known = localizer.engine.extract, {}

    def once(image: Path, shown: dict, mask: None = None) -> dict:
        key = image, str(shown)
        if key not in known:
            known[key] = extract(image, shown, mask)
        return known[key]

    return mock.patch.object(localizer.engine, "extract", once)


def _main() -> None:
    parser = cli.Parser(__doc__, "--feature colmap_sift_sv64 mini32:uint2")
    add = parser.add_argument
    add("--feature", nargs="+", default=["colmap_sift_sv64"], help="with the map's storage")
    add("--dataset", type=Path, default=Path("datasets/demo_town"), help="a demo town")
    add("--cameras", type=int, default=4, choices=(2, 3, 4), help="most of a rig")
    add("--strangers", nargs="+", type=Path, help="instead photos of other places, in folders")
    add("--halves", nargs="+", type=Path, help="cut dark photos of these data sets instead")
    add("--outputs", type=Path, default=Path("outputs/rigs"))
    rows.add_again_option(parser)
    args = parser.parse_args()
    torch.set_num_threads(1)
    known = [] if args.again else rows.read(NAME)
    for root, given in product(args.halves or (), args.feature):
        feature, _, storage = given.partition(":")
        storage = storage or "float16"
        cells = {"place": root.name, "list": "night", "feature": feature, "storage": storage}
        cells["matcher"] = features_confs.matcher_of(features_confs.get(feature)[1])
        if not rows.select(known, **cells):
            folder = args.outputs / f"{root.name}-{feature}-{storage}"
            for variant, measures in measure_halves(root, feature, storage, folder).items():
                rows.add(NAME, [cells | {"variant": variant} | measures | rows.how(cores=1)])
    if args.halves:
        return
    place = Aachen(args.dataset)
    # a town of eight times as many photos has as many queries by night
    photos = [photo for photo in list_photos(SEED, 8 * FRAMES) if photo.kind == NIGHT]
    folder = args.outputs / "photos"
    frames = [(one, photos_of(one, args.cameras, folder)) for one in progress(photos)]
    for given in args.feature:
        feature, _, storage = given.partition(":")
        storage = storage or "float16"
        cells = {"place": place.root.name, "list": "night", "feature": feature, "storage": storage}
        cells["matcher"] = features_confs.matcher_of(features_confs.get(feature)[1])
        last = f"{args.cameras} cameras, strangers" if args.strangers else "alone"
        if rows.select(known, variant=last, **cells):
            continue
        folder = args.outputs / f"{place.root.name}-{feature}-{storage}"
        options = {"feature": feature, "storage": storage}
        built = maps.main(folder, place.images, place.reference_model, **options)
        localizer = Localizer(built.folder, num_loc=NUM_LOC)
        with remember(localizer):
            if args.strangers:
                found = localize_strangers(localizer, args.strangers, args.cameras)
            else:
                found = localize_town(localizer, frames, args.cameras)
        cells["photos"] = len(place.map_names())
        for variant, poses in found.items():
            rows.add(NAME, [cells | {"variant": variant} | measures_of(poses) | rows.how(cores=1)])


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    cli.run(_main)
