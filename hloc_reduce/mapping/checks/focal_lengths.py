"""Focal lengths that differ although one camera may have taken all photos."""

from collections.abc import Collection

import pycolmap

from ..findings import Finding, Verdict
from .inputs import Inputs

# Ratios of the largest to the smallest focal length. Above SPREAD, one camera is tried for all
# photos, and a map with several is refused; above SPREAD_OF_FEW, this is tried for few photos that
# fit with one camera, and a map with several has a warning.
SPREAD, SPREAD_OF_FEW = 1.2, 1.05
FEW_IMAGES = 100  # further attempts take little time, even for one missing image


def find(inputs: Inputs) -> list[Finding]:
    """Find focal lengths that differ so much that the map may be wrong."""
    known = inputs.registration
    if known is None or not known.alike:
        return []
    return of_spread(known.spread, known.images)


def are_alike(cameras: Collection[pycolmap.Camera]) -> bool:
    """Tell whether one camera may have taken all images, although each has its own.

    Args:
        cameras: before the model was reconstructed.
    """
    return len(cameras) > len({(c.width, c.height, *c.params) for c in cameras}) == 1


def of_spread(spread: float, number: int) -> list[Finding]:
    """Return what the ratio of the focal lengths of a number of images says of a map."""
    limit = SPREAD_OF_FEW if number <= FEW_IMAGES else SPREAD
    return [finding(round(spread, 2))] if round(spread, 2) > limit else []


def finding(factor: float) -> Finding:
    """Return the finding for a ratio of focal lengths."""
    text = (
        "The map may be wrong: its photos have the same size, but their estimated focal lengths "
        f"differ by a factor of {factor:.2f}. If one camera with a fixed zoom took all, build it "
        "again with --camera_mode single; otherwise add photos from more viewpoints."
    )
    doubt = f"focal lengths that differ by a factor of {factor:.2f}"
    verdict: Verdict = "refuse" if factor > SPREAD else "warn"
    return Finding("focal_lengths", text, (), {"factor": factor}, verdict, doubt)
