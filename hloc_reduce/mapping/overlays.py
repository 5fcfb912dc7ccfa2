"""What was burnt into photos, such as a logo or a time stamp: it matches itself in every photo."""

from collections.abc import Mapping

import numpy as np

from .. import logger
from ..utils.cli import some

# pixels that a keypoint of an overlay moves from photo to photo, at most: also what a camera that
# circles around an object looks at stays nearly where it is
STILL = 1.0
PHOTOS = 3  # others in which it is at the same place
LEAST = 5  # keypoints of an overlay
SHARE = 0.5  # of its matches that are so
AROUND = 40.0  # pixels: what is so near is of the overlay, too, as the digits of a clock
COVERED = 0.5  # of the keypoints of a photo, at most: else the camera has not moved

Pair = tuple[str, str]


def drop_overlays(
    keypoints: Mapping[str, np.ndarray], matches: Mapping[Pair, np.ndarray]
) -> dict[Pair, np.ndarray]:
    """Drop the matches of overlays.

    A keypoint is of an overlay if most of its matches are at its own place in other photos: what a
    camera sees moves as the camera does. Where that holds for most keypoints of a photo, it is the
    camera that has not moved.

    Args:
        keypoints: from image to (N, 2).
        matches: from pair to (M, 2) indices of keypoints.

    Returns:
        The other matches.
    """
    from scipy.spatial import cKDTree

    still = {name: np.zeros(len(points), int) for name, points in keypoints.items()}
    number = {name: np.zeros(len(points), int) for name, points in keypoints.items()}
    for (a, b), indices in matches.items():
        first, second = indices.T
        same = np.abs(keypoints[a][first] - keypoints[b][second]).max(axis=1, initial=0) <= STILL
        for name, column in ((a, first), (b, second)):
            np.add.at(number[name], column, 1)
            np.add.at(still[name], column, same)
    least = min(PHOTOS, len(keypoints) - 1)
    covered = {name: np.zeros(len(points), bool) for name, points in keypoints.items()}
    for name, points in keypoints.items():
        overlay = (still[name] >= max(2, least)) & (still[name] >= SHARE * number[name])
        if overlay.sum() >= LEAST:
            distance, _ = cKDTree(points[overlay]).query(points)
            near = distance <= AROUND
            if near.mean() <= COVERED:
                covered[name] = near
    if having := sorted(name for name, inside in covered.items() if inside.any()):
        logger.info(
            "Matches of what is at the same place in many photos, such as a logo or a time stamp, "
            "are left out in %d photos: %s.",
            *(len(having), some(having)),
        )
    return {
        (a, b): indices[~(covered[a][indices[:, 0]] | covered[b][indices[:, 1]])]
        for (a, b), indices in matches.items()
    }
