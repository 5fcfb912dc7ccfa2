"""DoG keypoints whose settings follow the photo.

hloc's settings suit well-lit photos of about 1600 pixels. In small, dark, hazy or smooth photos
they find too few keypoints to match, so settings that find finer and weaker ones are tried until
there are enough.
"""

from collections.abc import Callable
from functools import partial
from typing import Annotated

import cv2
import numpy as np

from ..utils import colmap
from ..utils.cli import choose
from ..utils.options import Option
from . import opencv

HLOC_OPTIONS = {"first_octave": 0, "peak_threshold": 0.01}
COLMAP_OPTIONS = {"first_octave": -1, "peak_threshold": 0.0067}
FAST = "fast"  # found by OpenCV
# name -> the options to try first, and whether to try others if these find too few keypoints
SETTINGS = {
    "adaptive": (HLOC_OPTIONS, True),
    "colmap": (COLMAP_OPTIONS, True),
    "hloc": (HLOC_OPTIONS, False),
    FAST: (HLOC_OPTIONS, True),
}
KEYPOINT_SETTINGS = tuple(SETTINGS)
KeypointSettings = Annotated[
    str,
    Option(
        "keypoints",
        KEYPOINT_SETTINGS,
        "adaptive finds more keypoints in small, dark and hazy photos; colmap finds several times "
        "as many in every photo; hloc uses hloc's settings for every photo; fast finds them by "
        "OpenCV in photos of half the size, in a fraction of the time",
    ),
]

ENOUGH_KEYPOINTS = 2500  # of a photo
PIXELS_PER_KEYPOINT = 200  # fewer keypoints are enough in small photos
# After settings that find a smaller share of enough keypoints, the next ones do not find enough
# either: `python -m benchmarks.keypoint_steps`
HOPELESS = 0.01
SMALL_PHOTO_PIXELS = 1200  # on the longer side: detection is fast even at twice the size
# (first_octave, peak_threshold), tried in turn until there are enough keypoints. Octave -1 is the
# photo at twice its size; 0.0067 is COLMAP's threshold.
LADDERS = {
    "small": ((-1, 0.0067), (-1, 0.0033), (-1, 0.001)),
    "large": ((0, 0.005), (0, 0.0025), (0, 0.001), (-1, 0.0033)),
}

# of the extractor `dog`
DEFAULT_CONF = {
    "options": HLOC_OPTIONS,
    "keypoints": "adaptive",
    "descriptor": "sift",
    "max_keypoints": -1,
    "mr_size": 12,
}

KEYPOINT_UNCERTAINTY_PIXELS = 1.0  # standard deviation, as hloc assumes

BLUR_PIXELS = 4.0  # standard deviation of the blur that suppresses noise
LEAST_SIGNAL = 5.0  # minimum contrast after the blur, relative to that of pure noise


def detector(conf: dict) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """Return what detects keypoints with a configuration like `DEFAULT_CONF`, see `detect`.

    Raises:
        InputError: for unknown options or settings.
    """
    name = choose("keypoints", conf["keypoints"], KEYPOINT_SETTINGS)
    colmap.check_dog_options(conf["options"])
    own = conf["options"] != HLOC_OPTIONS
    options, adaptive = (conf["options"], False) if own else SETTINGS[name]
    return partial(detect, options=options, adaptive=adaptive, fast=is_fast(conf))


def is_fast(conf: dict) -> bool:
    """Tell whether OpenCV, not COLMAP, detects keypoints with a conf like `DEFAULT_CONF`."""
    return conf["keypoints"] == FAST and conf["options"] == HLOC_OPTIONS


def is_rotation_invariant(conf: dict) -> bool:
    """Tell whether keypoints of a conf like `DEFAULT_CONF` have the photo's orientations."""
    return not conf["options"].get("upright", False)


def strongest(
    keypoints: np.ndarray, descriptors: np.ndarray, number: int
) -> tuple[np.ndarray, np.ndarray]:
    """Keep a number of the largest keypoints (N, 4), as COLMAP ranks them; all if negative."""
    if number < 0:
        return keypoints, descriptors
    order = np.argsort(-keypoints[:, 2], kind="stable")[:number]
    return keypoints[order], descriptors[order]


def detect(
    image: np.ndarray,
    options: dict,
    adaptive: bool = False,
    fast: bool = False,
    mask: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Detect and describe keypoints.

    Args:
        image: (H, W) float32 in [0, 1].
        options: of pycolmap's SiftExtractionOptions; if `fast`, see `opencv.detect`.
        adaptive: try other settings if `options` find too few keypoints, unless the image shows
            nothing but noise.
        fast: detect them by OpenCV.
        mask: (H, W) bool, which pixels may have keypoints; default: all.

    Returns:
        Keypoints and descriptors, see `colmap.detect_dog`.
    """
    search = partial(_search, opencv.detect if fast else colmap.detect_dog, mask)
    found = more = search(image, options)
    least = enough(image.size if mask is None else int(np.count_nonzero(mask)))
    if not adaptive or len(found[0]) >= least or is_noise(image):
        return found
    ladder = LADDERS["small" if max(image.shape) <= SMALL_PHOTO_PIXELS else "large"]
    left = [
        {"first_octave": first_octave, "peak_threshold": peak_threshold}
        for first_octave, peak_threshold in ladder
        if first_octave <= options["first_octave"] and peak_threshold < options["peak_threshold"]
    ]
    while left and len(found[0]) < least:
        if len(more[0]) < HOPELESS * least:
            left = left[1:] or left
        more = search(image, {**options, **left[0]})
        found = more if len(more[0]) > len(found[0]) else found
        left = left[1:]
    return found


def enough(pixels: int) -> float:
    """Return how many keypoints of a photo with a number of pixels are enough."""
    return min(ENOUGH_KEYPOINTS, pixels / PIXELS_PER_KEYPOINT)


def _search(
    find: Callable[[np.ndarray, dict], tuple[np.ndarray, np.ndarray]],
    mask: np.ndarray | None,
    image: np.ndarray,
    options: dict,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the keypoints that a function finds in pixels of a mask, see `detect`."""
    keypoints, descriptors = find(image, options)
    if mask is None:
        return keypoints, descriptors
    x, y = np.floor(keypoints[:, :2].T + 0.5).astype(int)
    kept = mask[y.clip(0, mask.shape[0] - 1), x.clip(0, mask.shape[1] - 1)]
    return keypoints[kept], descriptors[kept]


def is_noise(image: np.ndarray) -> bool:
    """Tell whether a photo (H, W) has no contrast beyond its noise, as with a covered lens.

    The noise is estimated from the median of second differences (Immerkaer, 1996).
    """
    kernel = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32)
    noise = np.median(np.abs(cv2.filter2D(image, -1, kernel))) / 0.6745 / 6
    smooth = cv2.GaussianBlur(image, (0, 0), BLUR_PIXELS)
    left = noise / (2 * np.sqrt(np.pi) * BLUR_PIXELS)  # standard deviation of blurred white noise
    # 98 % of it is within 2.33 deviations; at least an 8-bit step, because of dithering
    low, high = np.percentile(smooth, [1, 99])
    return bool(high - low <= max(LEAST_SIGNAL * 2 * 2.33 * left, 1 / 255))
