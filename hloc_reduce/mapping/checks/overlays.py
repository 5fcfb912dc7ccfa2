"""What was burnt into photos, such as a logo or a time stamp: it matches itself in every photo."""

from collections.abc import Mapping

import numpy as np

from ... import logger
from ...utils import cli
from ..epipolar import Pair
from ..findings import PHOTOS_NAMED, Finding
from .inputs import Inputs

# that a keypoint of an overlay moves from photo to photo: also what a camera that circles around an
# object looks at stays nearly where it is
MAX_STILL_PIXELS = 1.0
MIN_STILL_PHOTOS = 3  # other photos in which it is there
MIN_OVERLAY_KEYPOINTS = 5
OVERLAY_MARGIN_PIXELS = 40.0  # what is so near is of the overlay, too, as the digits of a clock


def find(inputs: Inputs) -> list[Finding]:
    """Find the photos with an overlay that has verified matches."""
    if inputs.verified is None:
        return []
    inside = {*inputs.names}
    matches = {pair: rows for pair, rows in inputs.verified.items() if inside.issuperset(pair)}
    names = [name for name, one in covered(inputs.keypoints, matches).items() if one.any()]
    if not names:
        return []
    text = (
        "Something is at the same place in these photos and matches itself, such as a logo or a "
        "time stamp: {names}. It may have misplaced them: mask it, or use photos without it."
    )
    return [Finding("overlays", text, tuple(sorted(names)), doubt="photos with an overlay")]


def drop_overlays(
    keypoints: Mapping[str, np.ndarray], matches: Mapping[Pair, np.ndarray]
) -> dict[Pair, np.ndarray]:
    """Return the matches (M, 2) of pairs but for those of overlays, see `covered`."""
    inside = covered(keypoints, matches)
    if having := sorted(name for name, one in inside.items() if one.any()):
        logger.info(
            "Matches of what is at the same place in many photos, such as a logo or a time stamp, "
            "are left out in %d photos: %s.",
            len(having),
            cli.some(having, PHOTOS_NAMED),
        )
    return {
        (a, b): indices[~(inside[a][indices[:, 0]] | inside[b][indices[:, 1]])]
        for (a, b), indices in matches.items()
    }


def covered(
    keypoints: Mapping[str, np.ndarray], matches: Mapping[Pair, np.ndarray]
) -> dict[str, np.ndarray]:
    """Tell which keypoints are of an overlay.

    A keypoint is of an overlay if most of its matches are at its own place in other photos: what a
    camera sees moves as the camera does. Where that holds for most keypoints of a photo, it is the
    camera that has not moved.

    Args:
        keypoints: from image to (N, 2).
        matches: from pair to (M, 2) indices of keypoints.

    Returns:
        From image to (N,) bool.
    """
    from scipy.spatial import cKDTree

    still = {name: np.zeros(len(points), int) for name, points in keypoints.items()}
    number = {name: np.zeros(len(points), int) for name, points in keypoints.items()}
    for (a, b), indices in matches.items():
        first, second = indices.T
        moved = np.abs(keypoints[a][first] - keypoints[b][second]).max(axis=1, initial=0)
        for name, column in ((a, first), (b, second)):
            np.add.at(number[name], column, 1)
            np.add.at(still[name], column, moved <= MAX_STILL_PIXELS)
    least = max(2, min(MIN_STILL_PHOTOS, len(keypoints) - 1))
    inside = {name: np.zeros(len(points), bool) for name, points in keypoints.items()}
    for name, points in keypoints.items():
        overlay = (still[name] >= least) & (2 * still[name] >= number[name])
        if overlay.sum() >= MIN_OVERLAY_KEYPOINTS:
            distance, _ = cKDTree(points[overlay]).query(points)
            near = distance <= OVERLAY_MARGIN_PIXELS
            if 2 * near.sum() <= len(near):
                inside[name] = near
    return inside
