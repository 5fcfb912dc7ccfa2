"""Compare RANSACs on the 2D-3D matches of real queries, by the share of right matches.

The queries of places in Aachen's layout, with given intrinsics, are matched with maps of each
feature, by its own matcher and without a ratio test; the matches are kept in the outputs folder. A
match is right if its point is within the inlier threshold by the true pose. All RANSACs get the
same matches, threshold, confidence and limits of trials, and refine the pose that they find. They
take all matches, or, as `Localizer`, the likeliest ones first and then those near the pose; or, by
PROSAC, those first that are more likely. Times are CPU milliseconds of one thread, `ms` their
median. Adds rows to results/ransacs.csv. Those of another version of pycolmap are added where
PYTHONPATH has that, and those of PoseLib where it is installed.
"""

import copy
import importlib
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from unittest import mock

import numpy as np
import pycolmap

from benchmarks import rows
from benchmarks.small_maps import Remembering
from hloc_reduce import Localizer, logger, maps
from hloc_reduce.confs import features as features_confs
from hloc_reduce.datasets import true_poses
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.evaluation.poses import FAILED, pose_error
from hloc_reduce.localization import absolute_pose, lens_choice
from hloc_reduce.localization.absolute_pose import LEAST_RATIO, SAMPLE, WIDER
from hloc_reduce.localization.gate import DEFAULT_GATE
from hloc_reduce.localization.projection import reprojection_errors
from hloc_reduce.localization.query import ransac_options
from hloc_reduce.localize_sfm import RANSAC_THRESH
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.files import replacing
from hloc_reduce.utils.progress import progress

NAME = "ransacs"
WITHOUT_RATIO = "NN-mutual"
SHARES = 0, 5, 20, 50  # percent of right matches from which on queries are compared


@dataclass(frozen=True)
class Query:
    """The matches of a query.

    Args:
        points2D: (M, 2) image points in COLMAP's pixels.
        points3D: (M, 3) their world points, near the origin.
        images: of each map image the indices of its matches, the most similar first.
        camera: intrinsics.
        cam_from_world: the true pose.
    """

    points2D: np.ndarray
    points3D: np.ndarray
    images: list[np.ndarray]
    camera: pycolmap.Camera
    cam_from_world: pycolmap.Rigid3d

    @property
    def config(self) -> dict:
        """Options of RANSAC, see `absolute_pose.estimate`."""
        return ransac_options(RANSAC_THRESH, self.camera)

    @property
    def max_error(self) -> float:
        """The inlier threshold in pixels."""
        return float(self.config["estimation"]["ransac"]["max_error"])

    def errors(self, cam_from_world: pycolmap.Rigid3d) -> np.ndarray:
        """Return the reprojection errors (M,) of a pose in pixels."""
        return reprojection_errors(self.points2D, self.points3D, cam_from_world, self.camera)[0]

    @property
    def right(self) -> float:
        """The share of right matches in percent."""
        return 100 * float((self.errors(self.cam_from_world) <= self.max_error).mean())


Found = pycolmap.Rigid3d | None
Estimate = Callable[[Query, np.ndarray], Found]  # a pose from chosen matches (K,)


def by_colmap(query: Query, chosen: np.ndarray) -> Found:
    """Estimate a pose from chosen matches (K,) by pycolmap."""
    points = query.points2D[chosen], query.points3D[chosen]
    camera, ransac = copy.deepcopy(query.camera), {"min_inlier_ratio": LEAST_RATIO}
    found = colmap.estimate_pose(*points, camera, query.config, ransac)
    return found and found["cam_from_world"]


def by_poselib(query: Query, chosen: np.ndarray, prosac: bool = False) -> Found:
    """Estimate a pose from chosen matches (K,) by PoseLib, with pycolmap's limits."""
    poselib = importlib.import_module("poselib")
    limits = pycolmap.AbsolutePoseEstimationOptions().ransac
    options = {
        "max_reproj_error": query.max_error,
        "success_prob": limits.confidence,
        "dyn_num_trials_mult": limits.dyn_num_trials_multiplier,
        "min_iterations": limits.min_num_trials,
        "max_iterations": limits.max_num_trials,
        "progressive_sampling": prosac,
        "max_prosac_iterations": limits.max_num_trials,
    }
    camera = {"model": query.camera.model.name, "params": query.camera.params}
    camera |= {"width": query.camera.width, "height": query.camera.height}
    points = query.points2D[chosen], query.points3D[chosen]
    found, info = poselib.estimate_absolute_pose(*points, camera, options, {})
    return pycolmap.Rigid3d(found.Rt) if info["num_inliers"] else None


def from_all(estimate: Estimate, query: Query) -> Found:
    """Estimate a pose from all matches."""
    return estimate(query, np.arange(len(query.points2D)))


def from_likeliest(estimate: Estimate, query: Query) -> Found:
    """Estimate a pose from the likeliest matches, and then from those that are near it."""
    number = len(query.points2D)
    pose = estimate(query, absolute_pose.likeliest(query.images, number))
    if pose is None or number <= SAMPLE:
        return pose
    return estimate(query, np.flatnonzero(query.errors(pose) <= WIDER * query.max_error))


def by_prosac(query: Query) -> Found:
    """Estimate a pose by PoseLib, which samples the matches first that are more likely."""
    return by_poselib(query, absolute_pose.ranked(query.images, len(query.points2D)), prosac=True)


def wholly(query: Query) -> Found:
    """Estimate a pose as `Localizer` does, with other poses and all that its trust needs."""
    given = query.points2D, query.points3D, query.images, query.camera, query.config
    return absolute_pose.estimate(*given, DEFAULT_GATE).cam_from_world


def estimators() -> dict[str, Callable[[Query], Found]]:
    """Return what is compared, by name."""
    ours = f"pycolmap {pycolmap.__version__}"
    found: dict[str, Callable[[Query], Found]] = {
        f"{ours}, all matches": partial(from_all, by_colmap),
        f"{ours}, likeliest first": partial(from_likeliest, by_colmap),
        f"{ours}, with all checks": wholly,
    }
    if not find_spec("poselib"):
        logger.warning("PoseLib is not installed: it is left out.")
        return found
    poselib = f"PoseLib {version('poselib')}"
    return found | {
        f"{poselib}, all matches": partial(from_all, by_poselib),
        f"{poselib}, likeliest first": partial(from_likeliest, by_poselib),
        f"{poselib}, PROSAC": by_prosac,
    }


class _Taken(Exception):
    """The matches of a query are known, and no pose is needed."""


def matches_of(
    localizer: Localizer, photo: Path, camera: pycolmap.Camera
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Return the points2D, points3D and images, as in `Query`, from which a pose is estimated."""
    taken = []

    def take(*given: object, **_: object) -> None:
        taken.append(given[:3])
        raise _Taken

    with mock.patch.object(lens_choice, "estimate", take), suppress(_Taken):
        localizer.localize(photo, camera)
    return taken[0]


def collect(
    place: Aachen, given: str, matcher: str, folder: Path, described: dict[tuple, dict]
) -> Iterator[Query]:
    """Yield the matches of the queries of a place.

    Args:
        place: the place.
        given: a feature, with the map's storage.
        matcher: of the queries.
        folder: of the map.
        described: the features of queries, which this adds to.
    """
    feature, _, storage = given.partition(":")
    options = {"feature": feature, "storage": storage or "float16"}
    built = maps.main(folder, place.images, place.reference_model, **options)
    localizer = Localizer(built.folder, matcher=matcher)
    localizer.engine = Remembering(localizer.engine, described)
    listed = [query for part in place.query_lists().values() for query in part]
    truth = true_poses([name for name, _ in listed], place.ground_truth, True)
    for name, camera in progress(listed, "Matching", "query"):
        points2D, points3D, images = matches_of(localizer, place.images / name, camera)
        if len(points2D):
            centre = np.median(points3D, axis=0)
            true = truth[name]
            shift = true.translation + true.rotation.matrix() @ centre
            moved = pycolmap.Rigid3d(true.rotation, shift)
            yield Query(points2D, points3D - centre, images, camera, moved)


def save(path: Path, queries: Iterable[Query]) -> None:
    """Write the matches of queries to a file of arrays."""
    arrays: dict[str, np.ndarray] = {}
    for i, query in enumerate(queries):
        camera = query.camera
        arrays[f"{i}/points2D"], arrays[f"{i}/points3D"] = query.points2D, query.points3D
        arrays[f"{i}/matches"] = np.concatenate(query.images)
        arrays[f"{i}/ends"] = np.cumsum([len(chosen) for chosen in query.images])
        arrays[f"{i}/model"] = np.array(camera.model.name)
        arrays[f"{i}/camera"] = np.array([camera.width, camera.height, *camera.params])
        arrays[f"{i}/pose"] = query.cam_from_world.matrix()
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)


def load(path: Path) -> list[Query]:
    """Read what `save` wrote."""
    queries = []
    with np.load(path) as file:
        for i in range(len({key.partition("/")[0] for key in file.files})):
            width, height, *params = file[f"{i}/camera"]
            camera = pycolmap.Camera(
                model=str(file[f"{i}/model"]), width=int(width), height=int(height), params=params
            )
            points = file[f"{i}/points2D"], file[f"{i}/points3D"]
            images = np.split(file[f"{i}/matches"], file[f"{i}/ends"][:-1])
            queries.append(Query(*points, images, camera, pycolmap.Rigid3d(file[f"{i}/pose"])))
    return queries


def measured(queries: list[Query], estimate: Callable[[Query], Found]) -> dict[str, object]:
    """Return the measures of poses of some queries."""
    errors, inliers, seconds = [], [], []
    for query in queries:
        start = time.process_time()
        pose = estimate(query)
        seconds.append(time.process_time() - start)
        errors.append(FAILED if pose is None else pose_error(pose, query.cam_from_world))
        agreeing = 0 if pose is None else int((query.errors(pose) <= query.max_error).sum())
        inliers.append(agreeing)
    found = sum(error != FAILED for error in errors)
    return {
        "matches": float(np.mean([len(query.points2D) for query in queries])),
        **rows.localization(errors, inliers, found),
        "ms": 1000 * float(np.median(seconds)),
        "mean_ms": 1000 * float(np.mean(seconds)),
        **rows.how(sum(seconds), cores=1),
    }


def _main() -> None:
    parser = cli.Parser(__doc__, "--dataset datasets/herz-jesus --feature colmap_sift_sv32:uint4")
    add = parser.add_argument
    add("--dataset", nargs="+", type=Path, required=True, help="places in Aachen's layout")
    add("--feature", nargs="+", default=["colmap_sift_sv32:uint4"], help="with the map's storage")
    add("--outputs", type=Path, default=Path("outputs/ransacs"), help="folder of maps and matches")
    rows.add_again_option(parser)
    args = parser.parse_args()
    known = [] if args.again else rows.read(NAME)
    queries: list[Query] = []
    for root in args.dataset:
        place = Aachen(root)
        for given in args.feature:
            described: dict[tuple, dict] = {}
            folder = args.outputs / place.root.name / given.replace(":", "-")
            own = features_confs.matcher_of(features_confs.get(given.partition(":")[0])[1])
            for matcher in dict.fromkeys((own, WITHOUT_RATIO)):
                kept = folder / f"{matcher}.npz"
                if not kept.exists():
                    save(kept, collect(place, given, matcher, folder / "map", described))
                queries += load(kept)
    cells = {"place": " ".join(root.name for root in args.dataset)}
    cells |= {"feature": " ".join(args.feature)}
    for low, high in pairwise((*SHARES, np.inf)):
        chosen = [query for query in queries if low <= query.right < high]
        cells["list"] = f"{low} to {min(high, 100)} % right"
        for variant, estimate in estimators().items() if chosen else ():
            if not rows.select(known, **cells, variant=variant):
                rows.add(NAME, [cells | {"variant": variant} | measured(chosen, estimate)])


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    cli.run(_main)
