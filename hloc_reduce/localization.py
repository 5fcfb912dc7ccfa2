"""Localize queries in any map: 2D-3D matches through retrieved images, PnP + RANSAC, records."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Protocol

import h5py
import numpy as np
import pycolmap

from . import absolute_pose, cli, logger, parallel
from .cli import InputError
from .confidence import DEFAULT_GATE, RIVAL, Gate
from .executors import SERIAL, Executor
from .group_writer import failure_of, failures
from .intrinsics import from_list, to_list
from .io import (
    find_pair,
    get_colmap_keypoints,
    get_image_size,
    get_matcher,
    get_matches,
    naming,
    open_h5,
    replacing,
)
from .parsers import write_poses
from .progress import progress
from .storage import dimension

CHUNK = 8  # queries
SHOWN = 3  # queries that a message gives the reason of
RECORDS = 10  # the version of what a record holds, and of the gate


class Reference(Protocol):
    """A map: the 3D points that the keypoints of its images show."""

    def __contains__(self, name: str) -> bool:
        """Return whether it has an image."""

    def num_keypoints(self, name: str) -> int:
        """Return how many keypoints an image has."""

    def lift(self, name: str, keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the points that keypoints (M,) of an image show.

        Returns:
            Their ids (M,) int64, -1 where there is none, and coordinates (M, 3).
        """

    def clusters(self, names: list[str]) -> list[list[str]]:
        """Split images, one at least, into those whose points are matched together."""

    def fallback(self, names: list[str]) -> pycolmap.Rigid3d | None:
        """Return what to say of a query without a pose, by its images, best first, if any."""


def localize(
    reference: Reference,
    keypoints: np.ndarray,
    camera: pycolmap.Camera,
    matches: Mapping[str, np.ndarray],
    config: dict,
    gate: Gate = DEFAULT_GATE,
) -> tuple[pycolmap.Rigid3d | None, dict]:
    """Localize a query.

    Args:
        reference: the map.
        keypoints: (N, 2) of the query, COLMAP's pixels.
        camera: intrinsics.
        matches: from map images, best first, to (M, 2) indices of the keypoints of the query and
            of the image.
        config: hloc's dict of options of pycolmap, under "estimation" and "refinement".
        gate: what a pose must have to be trusted.

    Returns:
        The pose (camera from world) or None, and info: `reason`, why the pose is not to be trusted,
        None if it is; `confidence`, as of `confidence.confidence` and at least 0; `agreement`, as
        of `confidence.agreement`; `num_inliers`; `num_matches`, with a 3D point, of
        `num_correspondences` different ones (M); `num_without_point`, the other matches; `camera`,
        the intrinsics, refined where `config` says so; `db`, the image retrieved first, of the
        cluster that was localized in; and of that cluster `keypoints` (M,), indices of the query's,
        `point3D_ids` (M,), `points3D` (M, 3) and `inliers` (M,) bool.
    """
    solved = []
    for names in reference.clusters(list(matches)) if matches else [[]]:
        info, images = _correspondences(reference, names, matches)
        points = keypoints[info["keypoints"]], info["points3D"]
        found = absolute_pose.estimate(*points, images, camera, config, gate)
        info |= {
            "reason": _reason(len(keypoints), names, info) or found.refusal,
            "confidence": round(max(0.0, found.confidence), 2),
            "agreement": round(found.agreement, 3),
            "camera": found.camera,
            "num_inliers": found.num_inliers,
            "inliers": found.inliers,
            "db": names[0] if names else None,
        }
        solved.append((found, info))
    best, info = max(solved, key=lambda both: _quality(both[1]))
    for other, its_info in solved:
        if info["reason"] is None is its_info["reason"] and other is not best:
            rivals = other.num_inliers >= RIVAL * best.num_inliers
            if rivals and absolute_pose.differ(best, other, info["points3D"]):
                info["reason"] = (
                    f"ambiguous: a pose by other images has {other.num_inliers} inliers, this one "
                    f"{best.num_inliers}"
                )
    return best.cam_from_world, info


def _quality(info: dict) -> tuple[bool, float, int]:
    return info["reason"] is None, info["confidence"], info["num_inliers"]


def _reason(num_keypoints: int, names: list[str], info: dict) -> str | None:
    """Say why a query has no matches to localize it by, if it has none."""
    if not num_keypoints:
        return "no keypoints"
    if not names:
        return "no map image was retrieved"
    return None if info["num_matches"] else "no match with a 3D point"


def _correspondences(
    reference: Reference, names: list[str], matches: Mapping[str, np.ndarray]
) -> tuple[dict, list[np.ndarray]]:
    """Collect the different 2D-3D matches through some images, sorted.

    Returns:
        Parts of `info` of `localize`, and of each image the indices of its matches.
    """
    keypoints, ids, points = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros((0, 3))]
    for name in names:
        shown, xyz = reference.lift(name, matches[name][:, 1])
        keypoints.append(matches[name][:, 0])
        ids.append(shown)
        points.append(xyz)
    pairs = np.stack([np.concatenate(keypoints), np.concatenate(ids)], 1)
    known = np.flatnonzero(pairs[:, 1] >= 0)
    different, first, which = np.unique(
        pairs[known], axis=0, return_index=True, return_inverse=True
    )
    image = np.repeat(np.arange(len(names)), [len(matches[name]) for name in names])[known]
    images = [np.unique(which.reshape(-1)[image == i]) for i in range(len(names))]
    return {
        "num_matches": len(known),
        "num_without_point": len(pairs) - len(known),
        "num_correspondences": len(different),
        "keypoints": different[:, 0],
        "point3D_ids": different[:, 1],
        "points3D": np.concatenate(points)[known[first]],
    }, images


def main(
    load_reference: Callable[[], Reference],
    queries: list[tuple[str, pycolmap.Camera | None]],
    retrieved: Mapping[str, list[str]],
    features: Path,
    matches: Path,
    results: Path,
    config: Callable[[str, pycolmap.Camera], dict],
    made_from: dict,
    overwrite: bool = False,
    skip_matches: int | None = None,
    name_parts: int | None = 1,
    executor: Executor = SERIAL,
    gate: Gate = DEFAULT_GATE,
) -> dict[str, dict]:
    """Localize queries by the files of their features and matches.

    A query whose photo could not be read, or is of another size than its intrinsics, is not
    localized.

    Args:
        load_reference: gives the map, in each process where there is something to do.
        queries: names and intrinsics, None where these are not known.
        retrieved: the map images of each query, best first.
        features: feature file of the queries.
        matches: match file of the pairs.
        results: text file of poses, camera from world, one line for every query that has one.
        config: from the name and the intrinsics of a query to the options of `localize`.
        made_from: stamp of all that determines the poses; the records of `<results>_logs.jsonl`
            are used again when it is the same.
        overwrite: localize anew what is there.
        skip_matches: leave out retrieved images with fewer matches.
        name_parts: as of `parsers.write_poses`.
        executor: does the work; unless in this process, `load_reference` and `config` are pickled.
        gate: what a pose must have for the query to be called localized; its agreement, if not
            given, is that for the matcher and the dimension that the files tell.

    Returns:
        A record for each query: `localized`; `reason`, why it is not localized, None where it is;
        `confidence` and `agreement`; the pose that is written as `qvec` (w, x, y, z) and `tvec`,
        the fallback where the query is not localized, None where there is none; `camera`, the
        model, width, height and parameters in a list, None where not known; `max_error`, the pixels
        within which inliers reproject, None for pycolmap's default; and the numbers and `db` of
        `localize`.
    """
    header = {"records": RECORDS, "gate": asdict(gate), **made_from}
    log = _Log(log_file(results), header, overwrite)
    todo = [query for query in queries if query[0] not in log.records]
    if todo:
        with open_h5(features) as feature_file:
            refused = _refused(feature_file, todo)
        with log:
            for name, record in _refuse(load_reference, todo, refused, retrieved):
                log.add(name, record)
        todo = [query for query in todo if query[0] not in refused]
    if todo:
        with open_h5(matches) as match_file:
            _check_some_matched(match_file, queries, retrieved)
            gate = gate.of_matches(get_matcher(match_file), dimension(features))
        work = partial(_localize_all, load_reference, features, matches, config, skip_matches, gate)
        tasks = ((name, camera, retrieved.get(name, [])) for name, camera in todo)
        with log, closing(executor.map(work, tasks, CHUNK)) as found:
            for name, record in progress(found, "Localizing", "query", len(todo)):
                log.add(name, record)
    records = {name: log.records[name] for name, _ in queries}
    poses = {name: pose(record) for name, record in records.items()}
    submitted = {name: known for name, known in poses.items() if known is not None}
    write_poses(submitted, results, name_parts)
    if failed := [name for name in poses if name not in submitted]:
        logger.warning("%d queries have no pose: %s.", len(failed), cli.some(failed))
    unreadable = failures(features)  # the extraction has named them
    reasons = [
        f"{name} ({record['reason']})"
        for name, record in records.items()
        if record["reason"] and name not in unreadable
    ]
    if reasons:
        logger.warning("Not localized: %s.", cli.some(reasons, SHOWN))
    if len(reasons) > SHOWN:
        logger.warning("The reasons of all %d are in %s.", len(reasons), log.path)
    localized = sum(record["localized"] for record in records.values())
    logger.info("Localized %d of %d queries: %s", localized, len(records), results)
    return records


def _localize_all(
    load_reference: Callable[[], Reference],
    features: Path,
    matches: Path,
    config: Callable[[str, pycolmap.Camera], dict],
    skip_matches: int | None,
    gate: Gate,
    queries: Iterable[tuple[str, pycolmap.Camera, list[str]]],
) -> Iterator[tuple[str, dict]]:
    """Yield the names and the records of queries with their intrinsics and retrieved images."""
    reference = load_reference()

    def solve(task: tuple) -> tuple[str, dict]:
        name, camera, keypoints, found = task
        used = {n: m for n, m in found.items() if len(m) >= (skip_matches or 0)}
        options = config(name, camera)
        cam_from_world, info = localize(reference, keypoints, camera, used, options, gate)
        info["max_error"] = options.get("estimation", {}).get("ransac", {}).get("max_error")
        return name, _record(reference, list(found), cam_from_world, info)

    with open_h5(features) as feature_file, open_h5(matches) as match_file:
        tasks = (
            (name, camera, *_read(feature_file, match_file, name, retrieved, reference))
            for name, camera, retrieved in queries
        )
        with closing(parallel.ordered("localize", solve, tasks)) as solved:
            yield from solved


def pose(record: dict) -> pycolmap.Rigid3d | None:
    """Return the pose of a query's record, camera from world."""
    if record["qvec"] is None:
        return None
    w, x, y, z = record["qvec"]
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), np.array(record["tvec"]))


def camera(record: dict) -> pycolmap.Camera:
    """Return the intrinsics of a query's record, as they were refined."""
    return from_list(record["camera"])


def to_stamp(queries: list[tuple[str, pycolmap.Camera | None]]) -> dict[str, list | None]:
    """Return the intrinsics of queries as a stamp has them."""
    return {name: camera and to_list(camera) for name, camera in queries}


def read_records(path: Path) -> dict[str, dict]:
    """Read the records of queries that `main` left in `log_file`.

    Raises:
        InputError: when they are not there, broken, or of another version.
    """
    try:
        header, *lines = path.read_text().splitlines()
        if json.loads(header)["records"] == RECORDS:
            records = dict(json.loads(line) for line in lines)
            for record in records.values():
                record["localized"] = bool(record["localized"])
                pose(record)
            return records
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        pass
    raise InputError(f"{path} is not there or broken: run the localization again.")


def log_file(results: Path) -> Path:
    """Return the file of the records of queries, beside that of poses."""
    return Path(f"{results}_logs.jsonl")


def _check_some_matched(
    match_file: h5py.File,
    queries: list[tuple[str, pycolmap.Camera]],
    retrieved: Mapping[str, list[str]],
) -> None:
    """Refuse a match file that has not a single pair."""
    pairs = [(name, other) for name, _ in queries for other in retrieved.get(name, [])]
    if pairs and not any(find_pair(match_file, *pair)[0] for pair in pairs):
        raise InputError(
            f"The pair {pairs[0][0]}, {pairs[0][1]} is not in the match file "
            f"{match_file.filename}, and no other of the queries is."
        )


def _refused(
    feature_file: h5py.File, queries: list[tuple[str, pycolmap.Camera | None]]
) -> dict[str, str]:
    """Return the queries that are not to be localized, and why."""
    refused = {}
    for name, camera in queries:
        if failure := failure_of(feature_file, name):
            refused[name] = failure
        elif camera is None:
            refused[name] = "its intrinsics are not known"
        elif f"{name}/image_size" in feature_file:
            width, height = get_image_size(feature_file, name)
            if (width, height) != (camera.width, camera.height):
                refused[name] = (
                    f"the intrinsics are for {camera.width}x{camera.height} pixels, the photo has "
                    f"{width}x{height}"
                )
    return refused


def _refuse(
    load_reference: Callable[[], Reference],
    queries: list[tuple[str, pycolmap.Camera | None]],
    refused: Mapping[str, str],
    retrieved: Mapping[str, list[str]],
) -> Iterator[tuple[str, dict]]:
    """Yield the names and the records of the queries that are refused."""
    reference = load_reference() if refused else None
    for name, camera in queries:
        if name in refused:
            _, info = localize(reference, np.zeros((0, 2)), camera or pycolmap.Camera(), {}, {})
            info |= {"max_error": None, "reason": refused[name]}
            names = [other for other in retrieved.get(name, []) if other in reference]
            record = _record(reference, names, None, info)
            yield name, record | ({} if camera else {"camera": None})


def _read(
    feature_file: h5py.File,
    match_file: h5py.File,
    name: str,
    names: list[str],
    reference: Reference,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Read the keypoints of a query, and its matches with the images that were retrieved for it."""
    keypoints, _ = get_colmap_keypoints(feature_file, name)
    present = [other for other in names if other in reference]
    if len(present) < len(names):
        absent = len(names) - len(present)
        logger.warning("%d images retrieved for %s are not in the map.", absent, name)
    if present and not any(find_pair(match_file, name, other)[0] for other in present):
        logger.warning("%s was not matched: %s has none of its pairs.", name, match_file.filename)
        return keypoints, {other: np.zeros((0, 2), np.int64) for other in present}
    sizes = {other: (len(keypoints), reference.num_keypoints(other)) for other in present}
    return keypoints, {
        other: get_matches(match_file, name, other, both)[0] for other, both in sizes.items()
    }


def _record(
    reference: Reference, names: list[str], cam_from_world: pycolmap.Rigid3d | None, info: dict
) -> dict:
    localized = info["reason"] is None
    if not localized:
        cam_from_world = reference.fallback(names) or cam_from_world
    qvec = tvec = None
    if cam_from_world is not None:
        x, y, z, w = cam_from_world.rotation.quat
        qvec = [float(value) for value in (w, x, y, z)]
        tvec = [float(value) for value in cam_from_world.translation]
    numbers = ("num_matches", "num_without_point", "num_correspondences", "num_inliers")
    return {
        "localized": localized,
        "reason": info["reason"],
        "confidence": info["confidence"],
        "agreement": info["agreement"],
        "qvec": qvec,
        "tvec": tvec,
        "camera": to_list(info["camera"]),
        "max_error": info["max_error"],
        **{key: info[key] for key in numbers},
        "db": info["db"] if localized else next(iter(names), None),
    }


class _Log:
    """Records of queries, one JSON line each, under a first line that says what made them."""

    def __init__(self, path: Path, made_from: dict, overwrite: bool):
        self.path, self.records = path, {}
        header = json.dumps(made_from, sort_keys=True)
        lines = [] if overwrite or not path.exists() else path.read_text().split("\n")
        if lines and lines[0] == header:
            # what follows the last line end was cut off by a kill
            self.records = dict(json.loads(line) for line in lines[1:-1])
        kept = [json.dumps(item) for item in self.records.items()]
        with replacing(path) as temporary:
            temporary.write_text("\n".join([header, *kept]) + "\n")

    def __enter__(self) -> None:
        self.file = self.path.open("a")

    def __exit__(self, *_) -> None:
        with naming(self.path):
            self.file.close()

    def add(self, name: str, record: dict) -> None:
        self.records[name] = record
        with naming(self.path):
            self.file.write(json.dumps([name, record]) + "\n")
            self.file.flush()
