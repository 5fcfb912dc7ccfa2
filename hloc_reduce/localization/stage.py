"""Localize the queries of feature and match files in any map, and record each."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import asdict
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pycolmap

from .. import logger
from ..runtime import parallel
from ..runtime.executors import SERIAL, Executor
from ..runtime.group_writer import failure_of, failures
from ..utils import cli
from ..utils.cli import InputError
from ..utils.feature_files import dimension, get_colmap_keypoints, get_image_size
from ..utils.h5 import open_h5
from ..utils.match_files import find_pair, get_matcher, get_matches
from ..utils.parsers import write_poses
from ..utils.progress import progress
from .confidence import DEFAULT_GATE, Gate
from .query import localize
from .records import RECORDS, Log, log_file, pose_of, to_record
from .references import Reference

CHUNK = 8  # queries
SHOWN = 3  # queries that a message gives the reason of


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
    log = Log(log_file(results), header, overwrite)
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
    poses = {name: pose_of(record) for name, record in records.items()}
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
        return name, to_record(reference, list(found), cam_from_world, info)

    with open_h5(features) as feature_file, open_h5(matches) as match_file:
        tasks = (
            (name, camera, *_read(feature_file, match_file, name, retrieved, reference))
            for name, camera, retrieved in queries
        )
        with closing(parallel.ordered("localize", solve, tasks)) as solved:
            yield from solved


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
            record = to_record(reference, names, None, info)
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
