"""Localize the queries of InLoc: 2D-3D matches through the scans of cutouts, PnP + RANSAC."""

import hashlib
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import numpy as np
import pycolmap

from . import logger
from .datasets import scans
from .datasets.inloc import RANSAC_SIZE, RANSAC_THRESH, by_iphone7
from .localization import stage
from .localization.gate import DEFAULT_GATE, Gate
from .localization.intrinsics import to_lists
from .localization.references import ScanMap, point_group
from .localization.rigs import Frames
from .runtime import provenance
from .runtime.executors import SERIAL, Executor
from .runtime.group_writer import Group, GroupWriter, failures, fill
from .utils import cli, colmap, options
from .utils.cli import InputError
from .utils.feature_files import get_image_size, get_keypoints
from .utils.h5 import open_file, open_h5
from .utils.options import HIDDEN
from .utils.parsers import parse_retrieval
from .utils.paths import strings_as_paths
from .utils.progress import progress

CHUNK = 4  # cutouts


@strings_as_paths
def main(
    dataset_dir: Path,
    retrieval: Path,
    features: Path,
    matches: Path,
    results: Path,
    skip_matches: int | None = None,
    queries: Path | list[tuple[str, pycolmap.Camera]] | None = None,
    ransac_thresh: float = RANSAC_THRESH,
    overwrite: bool = False,
    executor: Executor = SERIAL,
    points: Annotated[Path, HIDDEN] | None = None,
    gate: Gate = DEFAULT_GATE,
    again: Sequence[stage.Try] = (),
    rigs: Annotated[Frames, HIDDEN] = MappingProxyType({}),
) -> dict[str, dict]:
    """Localize queries in a data set of InLoc's layout.

    Takes the arguments of hloc's `localize_inloc.main`. Each floor has a frame of its own, so
    queries are localized on each floor separately, and the pose with the highest confidence is
    kept.

    Args:
        dataset_dir: folder of the data set, which image names are relative to.
        retrieval: text file of pairs of queries and cutouts, best first.
        features: feature file of queries and cutouts.
        matches: match file of the pairs.
        results: text file of poses, camera from world, one line for every query that has one.
        skip_matches: leave out cutouts with fewer matches.
        queries: query list with intrinsics, or a glob of several (in Python, also names and
            intrinsics); default: the queries of `retrieval`, with those of an iPhone 7.
        ransac_thresh: RANSAC inlier threshold in pixels of a photo of 4032 pixels, of others
            in proportion.
        overwrite: localize all queries again.
        executor: does the work.
        points: file of the points that keypoints of cutouts show, for later runs and for other
            features with the same keypoints; default: `points_file(features)`.
        gate: what a pose must have for the query to be called localized.
        again: how queries that are not localized are matched once more, see
            `localization.stage.main`.
        rigs: queries of which one pose is estimated together, see `localization.stage.main`.

    Returns:
        A record for each query, as `localization.stage.main` returns it. A query that is not
        localized has the pose that PnP found, if any.

    Raises:
        InputError: if an input is missing or broken.
    """
    stage.check_threshold(ransac_thresh)
    retrieved = parse_retrieval(retrieval)
    if isinstance(queries, Path):
        queries = stage.read_queries(queries)
    elif queries is None:
        queries = by_iphone7(features, retrieved)
    cutouts = sorted({cutout for name, _ in queries for cutout in retrieved.get(name, [])})
    failed = failures(features)
    if not cutouts and not (queries and all(name in failed for name, _ in queries)):
        raise InputError(f"{retrieval} has no pair of a query and a cutout.")
    points = points or points_file(features)
    lift_keypoints(dataset_dir, features, cutouts, points, overwrite, executor)

    poses = {cutout: scans.read_pose(dataset_dir, cutout) for cutout in cutouts}
    options = {
        "ransac_thresh": ransac_thresh,
        "skip_matches": skip_matches,
        "queries": to_lists(queries),
        "scans": hashlib.sha256(np.array(list(poses.values())).tobytes()).hexdigest(),
    }
    return stage.main(
        partial(_load, points, features, poses),
        queries,
        retrieved,
        features,
        matches,
        results,
        partial(_config, ransac_thresh),
        provenance.of_inputs(options, [p for p in (retrieval, features, matches) if p.exists()]),
        overwrite,
        skip_matches=skip_matches or 0,
        executor=executor,
        gate=gate,
        again=again,
        rigs=rigs,
    )


def _load(points: Path, features: Path, poses: Mapping[str, np.ndarray]) -> ScanMap:
    return ScanMap(open_file(points), open_file(features), poses)


def _config(ransac_thresh: float, _: str, camera: pycolmap.Camera) -> dict:
    scale = max(camera.width, camera.height) / RANSAC_SIZE
    return {"estimation": {"ransac": {"max_error": ransac_thresh * scale}}}


def points_file(features: Path) -> Path:
    """Return the default file of the points that the keypoints of a feature file show."""
    return features.with_name(f"{features.stem}-points3D.h5")


@strings_as_paths
def lift_keypoints(
    dataset_dir: Path,
    features: Path,
    cutouts: list[str],
    output: Path,
    overwrite: bool = False,
    executor: Executor = SERIAL,
) -> Path:
    """Write the 3D points that the keypoints of cutouts show, reading each scan once.

    Args:
        dataset_dir: folder of the data set.
        features: feature file.
        cutouts: names of images.
        output: h5 file, `points3D` (N, 3) float32 in the `point_group` of each cutout: metres in
            the frame of its scan, NaN where that has no depth. If the data set has an attribute
            `origin` (3,), points are relative to that. Cutouts in it are skipped.
        overwrite: compute all points again.
        executor: does the work.

    Returns:
        `output`.

    Raises:
        InputError: if a scan is missing or broken.
    """
    with GroupWriter(output, {"dataset": str(dataset_dir.resolve())}, overwrite) as writer:
        with open_h5(features) as file:
            todo = [name for name in cutouts if point_group(file, name) not in writer]
        work = partial(_lift, dataset_dir, features)
        with closing(fill({None: writer}, work, todo, executor, CHUNK)) as done:
            for _ in progress(done, "Reading scans", "scan", len(todo)):
                pass
    return output


def _lift(
    dataset_dir: Path, features: Path, cutouts: Iterable[str]
) -> Generator[tuple[None, Group], None, None]:
    """Yield the points that the keypoints of cutouts show."""
    with open_h5(features) as file:
        for name in cutouts:
            keypoints, _ = get_keypoints(file, name)
            scan = scans.read_scan(dataset_dir / f"{name}.mat")
            scale = np.array(scan.shape[1::-1]) / get_image_size(file, name)
            points = scans.interpolate(scan, (keypoints + 0.5) * scale - 0.5)
            known = np.isfinite(points[:, 0]).mean() if len(points) else 1
            if known < 0.5:
                logger.warning("%.0f %% of the keypoints of %s have depth.", 100 * known, name)
            frame = colmap.near_from_world(points[np.isfinite(points[:, 0])])
            origin = frame.inverse().translation
            arrays = {"points3D": (points - origin).astype(np.float32)}
            attrs = {"points3D": {"origin": origin}} if origin.any() else {}
            yield None, (point_group(file, name), arrays, attrs)


def _main() -> None:
    example = (
        "--dataset_dir datasets/inloc --retrieval pairs-query-netvlad40.txt "
        "--features outputs/feats-dog-colmap_sift_sv64.h5 --matches outputs/matches.h5 "
        "--results outputs/poses.txt"
    )
    options.call(main, __doc__, example)


if __name__ == "__main__":
    cli.run(_main)
