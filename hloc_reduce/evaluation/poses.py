"""Errors of estimated poses and recall at thresholds."""

from collections.abc import Iterable

import numpy as np
import pycolmap


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
