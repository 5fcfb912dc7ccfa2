"""Find photos of a map of photos alone whose matches fit their poses badly."""

from collections.abc import Mapping

import numpy as np
import pycolmap

from .. import logger
from ..localization.projection import photo_scale
from ..mapping.epipolar import EVIDENCE, Pair, errors_of_pairs
from ..mapping.registration import NAMED
from ..utils import cli

# A right pose is about as precise as the keypoints: its matches are a few tenths of a pixel from
# their epipolar lines. Where bundle adjustment has traded a turn for a move, or something large has
# moved, they are one to nine pixels away, which the mapper's thresholds still allow.
FAR = 1.0  # pixels, of the reduced photo; a photo fits badly beyond it
TIMES = 3.0  # and beyond this multiple of the median of all photos, or of SHARP if that is larger
SHARP = 0.3  # pixels
STRONG = 0.5  # pairs count that have this share of the matches of the photo's strongest pair


def find(sfm: pycolmap.Reconstruction, verified: Mapping[Pair, np.ndarray]) -> list[str]:
    """Find photos whose verified matches are much farther from their epipolar lines than others'.

    A pair of photos is measured by the median distance, and a photo by the best one of its pairs
    with many matches: wrong matches of some pairs do not count against it.

    Args:
        sfm: the map, whose images have all keypoints.
        verified: the matches (M, 2) of pairs that agree with a two-view geometry.

    Returns:
        Their names, the worst first.
    """
    images = [sfm.images[i] for i in sfm.reg_image_ids()]
    keypoints, pixels = {}, {}
    for image in images:
        camera = sfm.cameras[image.camera_id]
        keypoints[image.name] = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        pixels[image.name] = camera.cam_from_img_threshold(photo_scale(camera))
    evidence = {pair: rows for pair, rows in verified.items() if len(rows) >= EVIDENCE}
    pairs: dict[str, list[tuple[int, float]]] = {}  # of an image: matches, median distance
    for (name0, name1), errors0, errors1 in errors_of_pairs(images, keypoints, evidence):
        distance = np.maximum(errors0 / pixels[name0], errors1 / pixels[name1])
        distance = np.nan_to_num(distance, nan=np.inf, posinf=np.inf)  # of points without a ray
        for name in (name0, name1):
            pairs.setdefault(name, []).append((len(distance), float(np.median(distance))))
    best = {}
    for name, measured in pairs.items():
        enough = STRONG * max(number for number, _ in measured)
        best[name] = min(median for number, median in measured if number >= enough)
    if not best:
        return []
    limit = max(FAR, TIMES * max(SHARP, float(np.median([*best.values()]))))
    return sorted((name for name in best if best[name] > limit), key=lambda name: -best[name])


def doubts(names: list[str]) -> list[str]:
    """Say that a map may be wrong because the matches of photos fit their poses badly."""
    if not names:
        return []
    return [
        "The map may be wrong: the matches of these photos fit their poses much worse than those "
        f"of the others: {cli.some(names, NAMED)}. They may be misplaced, or something large has "
        "moved. Build the map again without them, or with more photos between them and the others."
    ]


def warn(names: list[str]) -> None:
    """Warn of photos whose matches fit their poses badly, if there are any."""
    for doubt in doubts(names):
        logger.warning(doubt)
