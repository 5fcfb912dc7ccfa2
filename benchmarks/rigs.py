"""Localize rigs: one to four cameras in the demo town at night, or the halves of dark photos.

A rig stands where a query by night was taken; its cameras look ahead, to the left, back and to the
right, and are 20 cm apart. Adds rows to results/rigs.csv, leaving out what has rows unless --again
is given: the first one to four cameras, and the one of these that is localized with the most
inliers by itself. Position errors are those of the rig.

With --halves, each night photo of data sets in the layout of Aachen is cut into a left and a right
half, as if two cameras had taken them. `apart_cm` is the largest distance between the pose of the
halves and that of the whole photo.
"""

import copy
import os
from itertools import product
from pathlib import Path

import numpy as np
import pycolmap
import torch

from benchmarks import rows
from hloc_reduce import Localizer, demo, maps
from hloc_reduce.confs import features as features_confs
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.demo.cameras import NIGHT, WALK, Photo, list_photos
from hloc_reduce.demo.photo import take
from hloc_reduce.demo.town import build_town
from hloc_reduce.evaluation.poses import FAILED, pose_error
from hloc_reduce.utils import cli
from hloc_reduce.utils.files import replacing
from hloc_reduce.utils.images import read_image
from hloc_reduce.utils.progress import progress

NAME = "rigs"
NUM_LOC, SEED = 10, 0
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


def _main() -> None:
    parser = cli.Parser(__doc__, "--feature colmap_sift_sv64 mini32:uint2")
    add = parser.add_argument
    add("--feature", nargs="+", default=["colmap_sift_sv64"], help="with the map's storage")
    add("--dataset", type=Path, default=Path("datasets/demo_town"), help="the demo town")
    add("--cameras", type=int, default=4, choices=(2, 3, 4), help="most of a rig")
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
    place = Aachen(demo.main(args.dataset, SEED))
    photos = [photo for photo in list_photos(SEED, len(WALK)) if photo.kind == NIGHT]
    seen = [photos_of(one, args.cameras, args.outputs / "photos") for one in progress(photos)]
    rig = cams_from_rig(args.cameras)
    for given in args.feature:
        feature, _, storage = given.partition(":")
        storage = storage or "float16"
        cells = {"place": place.root.name, "list": "night", "feature": feature, "storage": storage}
        cells["matcher"] = features_confs.matcher_of(features_confs.get(feature)[1])
        if rows.select(known, **cells):
            continue
        folder = args.outputs / f"{feature}-{storage}"
        options = {"feature": feature, "storage": storage}
        built = maps.main(folder, place.images, place.reference_model, **options)
        localizer = Localizer(built.folder, num_loc=NUM_LOC)
        found: dict[str, list] = {}
        for photo, paths in zip(photos, seen, strict=True):
            alone = [localizer.localize(path, photo.camera) for path in paths]
            for number in range(1, args.cameras + 1):
                cameras = [photo.camera] * number
                pose, info = localizer.localize_rig(paths[:number], cameras, rig[:number])
                result = pose, info["num_inliers"]
                found.setdefault(f"{number} cameras", []).append((photo, *result))
                best = max(range(number), key=lambda i: _inliers(alone[i]))
                pose = alone[best][0] and rig[best].inverse() * alone[best][0]
                result = pose, _inliers(alone[best])
                found.setdefault(f"best of {number}", []).append((photo, *result))
        for variant, results in found.items():
            errors = [
                FAILED if pose is None else pose_error(pose, photo.cam_from_world)
                for photo, pose, _ in results
            ]
            localized = sum(error != FAILED for error in errors)
            inliers = [number for _, _, number in results]
            measures = rows.localization(errors, inliers, localized) | rows.how(cores=1)
            rows.add(NAME, [cells | {"variant": variant} | measures])


def _inliers(found: tuple[pycolmap.Rigid3d | None, dict]) -> int:
    """Return the number of inliers of a photo, 0 if it is not localized."""
    return 0 if found[0] is None else found[1]["num_inliers"]


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    cli.run(_main)
