"""Photos whose matches fit their poses badly."""

from collections.abc import Iterable, Mapping
from types import MappingProxyType

import numpy as np

from ...localization.projection import DETECTED, photo_scale
from ..epipolar import MIN_VERIFIED_MATCHES, errors_of_pairs
from ..findings import Finding
from .inputs import Inputs

# A right pose is about as precise as the keypoints: its matches are a few tenths of a pixel from
# their epipolar lines. Where bundle adjustment has traded a turn for a move, or something large has
# moved, they are one to nine pixels away, which the mapper's thresholds still allow.
MISFIT_PIXELS = 1.0  # of the reduced photo; a photo fits badly beyond it,
MISFIT_RATIO = 3.0  # and beyond this multiple of the median of all photos


def find(inputs: Inputs) -> list[Finding]:
    """Find photos whose verified matches are much farther from their epipolar lines than others'.

    A pair of photos is measured by the median distance, and a photo by the best one of its pairs
    that have half as many matches as the strongest: wrong matches of some pairs do not count
    against it.
    """
    if inputs.verified is None:
        return []
    cameras = {image.name: inputs.model.cameras[image.camera_id] for image in inputs.images}
    pixels = {name: one.cam_from_img_threshold(photo_scale(one)) for name, one in cameras.items()}
    evidence = {
        pair: rows for pair, rows in inputs.verified.items() if len(rows) >= MIN_VERIFIED_MATCHES
    }
    pairs: dict[str, list[tuple[int, float]]] = {}  # of an image: matches, median distance
    errors = errors_of_pairs(inputs.images, inputs.keypoints, evidence)
    for (name0, name1), errors0, errors1 in errors:
        distance = np.maximum(errors0 / pixels[name0], errors1 / pixels[name1])
        distance = np.nan_to_num(distance, nan=np.inf, posinf=np.inf)  # of points without a ray
        for name in (name0, name1):
            pairs.setdefault(name, []).append((len(distance), float(np.median(distance))))
    best = {}
    for name, measured in pairs.items():
        most = max(number for number, _ in measured)
        best[name] = min(median for number, median in measured if 2 * number >= most)
    if not best:
        return []
    limit = max(MISFIT_PIXELS, MISFIT_RATIO * float(np.median([*best.values()])))
    worst = sorted((name for name in best if best[name] > limit), key=lambda name: -best[name])
    values = {name: min(best[name], float(DETECTED)) for name in worst}  # JSON has no infinity
    return [finding(worst, values)] if worst else []


def finding(names: Iterable[str], distances: Mapping[str, float] = MappingProxyType({})) -> Finding:
    """Return the finding for photos, and the distances of their matches in pixels."""
    text = (
        "The map may be wrong: the matches of these photos fit their poses much worse than those "
        "of the others: {names}. They may be misplaced, or something large has moved. Build the "
        "map again without them, or with more photos between them and the others."
    )
    doubt = "photos whose matches fit their poses badly"
    return Finding("misfits", text, tuple(names), distances, "refuse", doubt)
