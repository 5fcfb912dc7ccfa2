"""Photos that too few points hold."""

import numpy as np

from ...localization.gate import DEFAULT_GATE
from ..findings import Finding
from .inputs import Inputs

# A few points hold an image like a hinge: it fits them, but its pose is often wrong by degrees.
# Of images with fewer than 30 points, and than an eighth of the median of their map, three of four
# were wrong, in 103 maps.
HINGE_POINTS, HINGE_SHARE = 30, 1 / 8


def find(inputs: Inputs) -> list[Finding]:
    """Find the photos that too few points hold: those with the fewest, as others share these.

    Photos that a rig took at one moment are held by the points of all.
    """
    if not inputs.images:
        return []
    of_frames = np.bincount(inputs.frames, [image.num_points3D for image in inputs.images])
    number = {
        image.name: int(of_frames[frame])
        for image, frame in zip(inputs.images, inputs.frames, strict=True)
    }
    median = np.median(list(number.values()))
    least = max(DEFAULT_GATE.min_inliers, min(HINGE_POINTS, HINGE_SHARE * median))
    fewest = min(number.values())
    names = [name for name, points in number.items() if points == fewest < least]
    if not names:
        return []
    text = (
        f"These photos have fewer than {DEFAULT_GATE.min_inliers} points, or fewer than "
        f"{HINGE_POINTS} where most photos have more than eight times as many, so that their poses "
        "are not certain: {names}. Add photos between those in the map and these."
    )
    values = dict.fromkeys(names, float(fewest))
    return [Finding("few_points", text, tuple(names), values, "drop", "photos with few points")]
