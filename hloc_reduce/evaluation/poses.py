"""Errors of estimated poses and recall at thresholds."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from ..localization.records import pose_of, read_records
from ..utils.cli import InputError
from ..utils.parsers import parse_poses

FAILED = (float("inf"), float("inf"))  # the errors of a query without a pose
ERRORS = ("position_error_m", "rotation_error_deg")


def pose_error(estimated: pycolmap.Rigid3d | None, true: pycolmap.Rigid3d) -> tuple[float, float]:
    """Compare two poses, both camera from world.

    Returns:
        The distance between the camera centres in metres and the angle of the rotation between the
        poses in degrees, as in the benchmark of visuallocalization.net; `FAILED` if there is no
        estimated pose.
    """
    if estimated is None:
        return FAILED
    centre, true_centre = (pose.inverse().translation for pose in (estimated, true))
    degrees = np.degrees(estimated.rotation.angle_to(true.rotation))
    return float(np.linalg.norm(centre - true_centre)), float(degrees)


def status(pose: pycolmap.Rigid3d | None, localized: bool) -> str:
    """Return the status of a query: localized, fallback (a pose nevertheless) or failed (none)."""
    return "failed" if pose is None else "localized" if localized else "fallback"


def recall(
    errors: Iterable[tuple[float, float]], thresholds: Iterable[tuple[float, float]]
) -> list[float]:
    """Return the percentage of queries within each pair of thresholds, metres and degrees.

    `errors` has metres and degrees of every query, infinite for a failure.
    """
    errors = np.array(list(errors), float).reshape(-1, 2)
    return [
        float(100 * (errors <= limits).all(axis=1).mean()) if len(errors) else 0.0
        for limits in map(np.array, thresholds)
    ]


def counted_errors(rows: Iterable[dict]) -> list[tuple[float, float]]:
    """Return the errors that count for recall: infinite for fallbacks and failures.

    Args:
        rows: a dict for each query with its `status` and `ERRORS`; where these are None, the true
            pose is not known and the query does not count.
    """
    position, rotation = ERRORS
    return [
        (row[position], row[rotation]) if row["status"] == "localized" else FAILED
        for row in rows
        if row[position] is not None
    ]


def summarize_errors(rows: list[dict], thresholds: Sequence[tuple[float, float]]) -> dict:
    """Summarize the errors of queries.

    Args:
        rows: as for `counted_errors`, all with known true poses.
        thresholds: pairs of metres and degrees.

    Returns:
        The number of queries; recall in percent at each pair of thresholds; and the median errors
        of all poses, fallbacks included, or None if half of the queries have no pose.
    """
    medians = np.median([[row[key] for key in ERRORS] for row in rows], axis=0)
    position, rotation = (float(value) if np.isfinite(value) else None for value in medians)
    return {
        "with_ground_truth": len(rows),
        "thresholds_m_deg": [list(limits) for limits in thresholds],
        "recall_percent": [round(value, 2) for value in recall(counted_errors(rows), thresholds)],
        "median_position_error_m": position,
        "median_rotation_error_deg": rotation,
    }


def cumulative(errors: Iterable[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return a cumulative curve: the sorted finite errors and the percentage within each."""
    values = np.sort(np.array(list(errors), float))
    share = 100 * np.arange(1, len(values) + 1) / max(len(values), 1)
    finite = np.isfinite(values)
    return values[finite], share[finite]


def read_truth(paths: Iterable[Path]) -> dict[str, pycolmap.Rigid3d]:
    """Read true poses from several files, by full name.

    Raises:
        InputError: for a broken or empty file, or a name that is in two files.
    """
    truth: dict[str, pycolmap.Rigid3d] = {}
    for path in paths:
        poses = parse_poses(path)
        if not poses:
            raise InputError(f"{path} has no pose.")
        if twice := truth.keys() & poses.keys():
            raise InputError(f"{path}: {min(twice)} is also in another file of true poses.")
        truth |= poses
    return truth


def read_estimates(path: Path) -> tuple[dict[str, pycolmap.Rigid3d], set[str]]:
    """Read estimated poses from a text file or from the `*_logs.jsonl` of a pipeline.

    Returns:
        The poses by name, and the names of the fallbacks, which a text file does not tell.

    Raises:
        InputError: for a broken file.
    """
    if path.suffix != ".jsonl":
        return parse_poses(path), set()
    records = read_records(path)
    poses = {name: pose_of(record) for name, record in records.items()}
    known = {name: pose for name, pose in poses.items() if pose is not None}
    return known, {name for name in known if not records[name]["localized"]}


def find_estimates(estimates: Iterable[str], names: Iterable[str]) -> dict[str, str]:
    """Find the names of estimates of queries, given the full names of queries.

    An estimate has the full name of its query or, as in submissions, the last parts of it.

    Returns:
        From full name to name of the estimate, for queries that have one.

    Raises:
        InputError: when an estimate fits several queries.
    """
    estimates, names = set(estimates), dict.fromkeys(names)
    owners: dict[str, str] = {}
    for name in names:
        parts = name.split("/")
        endings = ("/".join(parts[i:]) for i in range(len(parts)))
        written = next((ending for ending in endings if ending in estimates), None)
        if written is None or (written in names and written != name):  # another's full name
            continue
        if written in owners:
            raise InputError(
                f"The estimate {written} could be of {owners[written]} and of {name}: "
                "full names are needed, as in the *_logs.jsonl of a pipeline."
            )
        owners[written] = name
    return {name: written for written, name in owners.items()}
