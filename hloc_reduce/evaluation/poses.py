"""Errors of estimated poses and recall at thresholds."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pycolmap

from ..localization.records import pose_of, read_records
from ..utils.cli import InputError
from ..utils.parsers import parse_poses

FAILED = (float("inf"), float("inf"))


def pose_error(estimated: pycolmap.Rigid3d, true: pycolmap.Rigid3d) -> tuple[float, float]:
    """Compare two poses, both camera from world.

    Returns:
        The distance of the camera centres in metres and the angle of the rotation between the
        poses in degrees, as in the benchmark of visuallocalization.net.
    """
    estimated_rotation, true_rotation = estimated.rotation.matrix(), true.rotation.matrix()
    centre = -estimated_rotation.T @ estimated.translation
    true_centre = -true_rotation.T @ true.translation
    difference = estimated_rotation @ true_rotation.T
    sine = np.linalg.norm(difference - difference.T) / 8**0.5
    cosine = (np.trace(difference) - 1) / 2
    return (
        float(np.linalg.norm(centre - true_centre)),
        float(np.degrees(np.arctan2(sine, cosine))),
    )


def recall(
    errors: Iterable[tuple[float, float]], thresholds: Iterable[tuple[float, float]]
) -> list[float]:
    """Compute the share of queries within both thresholds.

    Args:
        errors: metres and degrees of every query; infinite for one that failed.
        thresholds: pairs of metres and degrees.

    Returns:
        Percentages, one for each pair of thresholds.
    """
    errors = np.array(list(errors), float).reshape(-1, 2)
    return [
        float(100 * (errors <= limits).all(axis=1).mean()) if len(errors) else 0.0
        for limits in map(np.array, thresholds)
    ]


def summarize_errors(
    errors: list[tuple[float, float]],
    counted: list[tuple[float, float]],
    thresholds: Iterable[tuple[float, float]],
) -> dict:
    """Summarize the errors of queries, metres and degrees.

    Args:
        errors: of the poses, of which medians are taken; infinite without one.
        counted: those that count for recall, infinite for a failure.
        thresholds: pairs of metres and degrees.

    Returns:
        The number of queries, recall in percent at each of the thresholds, and median errors, None
        if half of the queries have none.
    """
    medians = np.median(errors, axis=0)
    position, rotation = (float(value) if np.isfinite(value) else None for value in medians)
    return {
        "with_ground_truth": len(errors),
        "thresholds_m_deg": [list(limits) for limits in thresholds],
        "recall_percent": [round(value, 2) for value in recall(counted, thresholds)],
        "median_position_error_m": position,
        "median_rotation_error_deg": rotation,
    }


def read_truth(paths: Iterable[Path]) -> dict[str, pycolmap.Rigid3d]:
    """Read true poses of several files, by full name.

    Raises:
        InputError: for a broken or empty file, or a name that two files have.
    """
    truth = {}
    for path in paths:
        poses = parse_poses(path)
        if not poses:
            raise InputError(f"{path} has no pose.")
        if twice := truth.keys() & poses.keys():
            raise InputError(f"{path}: {min(twice)} is in another file of true poses, too.")
        truth |= poses
    return truth


def find_estimates(estimates: Iterable[str], names: Iterable[str]) -> dict[str, str]:
    """Find the estimates of queries by their full names, or else by what full names end with.

    Benchmarks want base names, or the last folder and the base name.

    Args:
        estimates: their names.
        names: full names of queries.

    Returns:
        From full name to the name of the estimate, for those that have one.

    Raises:
        InputError: when an estimate could be of several queries.
    """
    estimates, names = set(estimates), list(names)
    found = {name: name for name in names if name in estimates}
    owner = dict(found)
    for name in names:
        parts = name.split("/")
        endings = ["/".join(parts[i:]) for i in range(1, len(parts))]
        written = next((ending for ending in endings if ending in estimates), None)
        if name in found or written is None or written in found:
            continue
        if written in owner:
            raise InputError(
                f"The estimate {written} could be of {owner[written]} and of {name}: "
                "whole names are needed, which the *_logs.jsonl of a pipeline has."
            )
        found[name], owner[written] = written, name
    return found


def read_estimates(path: Path) -> tuple[dict[str, pycolmap.Rigid3d], set[str]]:
    """Read estimated poses, from a text file or from the `*_logs.jsonl` of a pipeline.

    Returns:
        The poses by name, in the latter whole names, and the names of those that are fallbacks,
        which only the latter tells.

    Raises:
        InputError: for a broken file.
    """
    if path.suffix != ".jsonl":
        return parse_poses(path), set()
    records = read_records(path)
    poses = {name: pose_of(record) for name, record in records.items()}
    known = {name: pose for name, pose in poses.items() if pose is not None}
    return known, {name for name in known if not records[name]["localized"]}


def errors_of(
    estimates: Mapping[str, pycolmap.Rigid3d], truth: Mapping[str, pycolmap.Rigid3d]
) -> dict[str, tuple[float, float]]:
    """Return the errors, metres and degrees, of all queries with true poses; infinite without."""
    return {
        name: pose_error(estimates[name], pose) if name in estimates else FAILED
        for name, pose in truth.items()
    }


def cumulative(errors: Iterable[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the cumulative curve of errors: sorted finite ones, and the percentage within each."""
    errors = np.sort(np.array(list(errors), float))
    share = 100 * np.arange(1, len(errors) + 1) / max(len(errors), 1)
    finite = np.isfinite(errors)
    return errors[finite], share[finite]
