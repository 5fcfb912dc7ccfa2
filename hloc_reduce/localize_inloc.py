"""Localize the queries of InLoc: 2D-3D matches through the scans of cutouts, PnP + RANSAC."""

import argparse
import hashlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from functools import lru_cache, partial
from pathlib import Path

import h5py
import numpy as np
import pycolmap

from . import cli, localization, logger, scans, stamps
from .cli import InputError
from .confidence import DEFAULT_GATE, Gate, add_gate_options
from .executors import SERIAL, Executor
from .group_writer import Group, GroupWriter, failures, fill
from .io import get_dataset, get_image_size, get_keypoints, open_h5, reading
from .parsers import parse_query_lists, parse_retrieval
from .paths import strings_as_paths
from .progress import progress

RANSAC_THRESH = 48.0  # pixels of a photo of the iPhone 7, as in hloc
RANSAC_SIZE = 4032  # the longer side of such a photo
CHUNK = 4  # cutouts
CACHED_IMAGES = 128  # points of so many cutouts stay in memory: 25 MB at 8,000 keypoints


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
    points: Path | None = None,
    gate: Gate = DEFAULT_GATE,
) -> dict[str, dict]:
    """Localize queries in a data set of InLoc's layout.

    Takes what hloc's `localize_inloc.main` takes. Each floor has a frame of its own, so the
    cutouts of each floor are matched together, and the pose of the highest confidence is kept.

    Args:
        dataset_dir: the folder that image names are relative to.
        retrieval: pairs of queries and cutouts, best first.
        features: feature file of queries and cutouts.
        matches: match file of the pairs.
        results: text file of poses, camera from world, one line for every query that has one.
        skip_matches: leave out cutouts with fewer matches.
        queries: names and intrinsics, or the list of them, or a glob of lists; default: all
            queries of the pairs, with the intrinsics of `by_iphone7`.
        ransac_thresh: RANSAC inlier threshold in pixels of a photo of 4032 pixels, of others
            in proportion.
        overwrite: localize anew what is there.
        executor: does the work.
        points: keeps what the keypoints of cutouts show, for later runs, and if it is given for
            other features of the same keypoints, too; default: `points_file(features)`.
        gate: what a pose must have for the query to be called localized.

    Returns:
        A record for each query, as `localization.main`; a query with too few inliers has the pose
        that PnP found all the same, if any.

    Raises:
        InputError: when an input is missing or broken.
    """
    if ransac_thresh <= 0:
        raise InputError(f"ransac_thresh is {ransac_thresh}: it must be above 0.")
    retrieved = parse_retrieval(retrieval)
    if isinstance(queries, Path):
        queries = [query for part in parse_query_lists(queries).values() for query in part]
    elif queries is None:
        queries = by_iphone7(features, retrieved)
    cutouts = sorted({cutout for name, _ in queries for cutout in retrieved.get(name, [])})
    failed = failures(features)
    if not cutouts and not (queries and all(name in failed for name, _ in queries)):
        raise InputError(f"{retrieval} has no pair of a query and a cutout.")
    points = points or points_file(features)
    lift_keypoints(dataset_dir, features, cutouts, points, overwrite, executor)

    options = {"ransac_thresh": ransac_thresh, "skip_matches": skip_matches}
    options["queries"] = localization.to_stamp(queries)
    poses = {cutout: scans.read_pose(dataset_dir, cutout) for cutout in cutouts}
    options["scans"] = hashlib.sha256(np.array(list(poses.values())).tobytes()).hexdigest()
    return localization.main(
        partial(_load, points, features, poses),
        queries,
        retrieved,
        features,
        matches,
        results,
        partial(_config, ransac_thresh),
        stamps.stamp(options, [p for p in (retrieval, features, matches) if p.exists()]),
        overwrite,
        skip_matches=skip_matches,
        executor=executor,
        gate=gate,
    )


def _load(points: Path, features: Path, poses: Mapping[str, np.ndarray]) -> "ScanMap":
    return ScanMap(h5py.File(points), h5py.File(features), poses)


def _config(ransac_thresh: float, _: str, camera: pycolmap.Camera) -> dict:
    scale = max(camera.width, camera.height) / RANSAC_SIZE
    return {"estimation": {"ransac": {"max_error": ransac_thresh * scale}}}


def points_file(features: Path) -> Path:
    """Return the file of the points that the keypoints of a feature file show."""
    return features.with_name(f"{features.stem}-points3D.h5")


def point_group(features: h5py.File, name: str) -> str:
    """Return the group of the points of a cutout, which is named by its keypoints, too.

    So features that have the same keypoints share their points, and others do not.
    """
    keypoints, _ = get_keypoints(features, name)
    size = np.array(get_image_size(features, name))
    return f"{name}/{hashlib.sha256(size.tobytes() + keypoints.tobytes()).hexdigest()[:16]}"


def by_iphone7(features: Path, names: Iterable[str]) -> list[tuple[str, pycolmap.Camera]]:
    """Give queries of a feature file the intrinsics of the benchmark's: 28 mm on 35 mm film."""
    queries = []
    with open_h5(features) as file:
        for name in names:
            width, height = get_image_size(file, name)
            params = [max(width, height) * 28 / 36, width / 2, height / 2]
            camera = pycolmap.Camera(
                model="SIMPLE_PINHOLE", width=width, height=height, params=params
            )
            queries.append((name, camera))
    return queries


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
            the frame of its scan, NaN where that has no depth.
        overwrite: compute anew what is there.
        executor: does the work.

    Returns:
        `output`; cutouts it holds already are skipped.

    Raises:
        InputError: when a scan is missing or broken.
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
) -> Iterator[tuple[None, Group]]:
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
            yield None, (point_group(file, name), {"points3D": points.astype(np.float32)}, {})


class ScanMap:
    """Keypoints of cutouts and the points that they show, as a `localization.Reference`.

    Args:
        file: open h5 file of `lift_keypoints`.
        features: open feature file.
        poses: from cutout to the pose of its scan, floor from scan (4, 4).
    """

    def __init__(self, file: h5py.File, features: h5py.File, poses: Mapping[str, np.ndarray]):
        self.file, self.features, self.poses = file, features, poses
        self.points = lru_cache(CACHED_IMAGES)(self._read)
        # by name, so that no order of queries or cutouts changes anything
        self.numbers = {name: number for number, name in enumerate(sorted(poses))}

    def _read(self, name: str) -> np.ndarray:
        group = point_group(self.features, name)
        with reading(self.file.filename):
            found = group in self.file
        if not found:
            raise InputError(
                f"{self.file.filename} is not of the keypoints of {name} that are now in "
                f"{self.features.filename}: localize anew."
            )
        points = get_dataset(self.file, group, "points3D")[()].astype(np.float64)
        pose = self.poses[name]
        return points @ pose[:3, :3].T + pose[:3, 3]

    def __contains__(self, name: str) -> bool:
        return name in self.numbers

    def num_keypoints(self, name: str) -> int:
        """Return how many keypoints a cutout has."""
        return get_dataset(self.features, name, "keypoints").shape[0]

    def lift(self, name: str, keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the ids and coordinates of the points that keypoints of a cutout show.

        Every keypoint of every cutout has a point of its own.
        """
        points = self.points(name)[keypoints]
        ids = (self.numbers[name] << 32) + keypoints
        return np.where(np.isfinite(points[:, 0]), ids, -1), points

    def clusters(self, names: list[str]) -> list[list[str]]:
        """Split cutouts by floor, the floor of the first one first."""
        floors: dict[str, list[str]] = {}
        for name in names:
            floors.setdefault(scans.floor_of(name), []).append(name)
        return list(floors.values())

    def fallback(self, names: list[str]) -> None:
        """Return None: a cutout has no pose."""


def _main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python -m hloc_reduce.localize_inloc --dataset_dir datasets/inloc "
        "--retrieval pairs-query-netvlad40.txt --features outputs/feats-dog-colmap_sift_sv64.h5 "
        "--matches outputs/matches.h5 --results outputs/poses.txt",
        formatter_class=cli.HelpFormatter,
    )
    parser.add_argument("--dataset_dir", type=Path, required=True, help="folder of the data set")
    parser.add_argument("--retrieval", type=Path, required=True, help="pairs of queries, cutouts")
    parser.add_argument("--features", type=Path, required=True, help="feature file")
    parser.add_argument("--matches", type=Path, required=True, help="match file")
    parser.add_argument("--results", type=Path, required=True, help="text file of poses")
    parser.add_argument(
        "--skip_matches", type=int, help="leave out cutouts with fewer matches with the query"
    )
    parser.add_argument(
        "--queries",
        type=Path,
        help="query list with intrinsics, or a glob (default: those of the pairs, by an iPhone 7)",
    )
    parser.add_argument(
        "--ransac_thresh",
        type=float,
        default=RANSAC_THRESH,
        help="RANSAC inlier threshold in pixels of a photo of 4032 pixels, of others in proportion",
    )
    add_gate_options(parser)
    parser.add_argument("--overwrite", action="store_true", help="localize anew what is there")
    args = vars(parser.parse_args())
    gate = Gate(args.pop("min_confidence"), args.pop("min_inliers"))
    main(**args, gate=gate)


if __name__ == "__main__":
    cli.run(_main)
