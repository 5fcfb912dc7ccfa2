"""DoG keypoints whose settings follow the photo.

hloc's settings are meant for well-lit photos of about 1600 pixels. In a photo that is small, dark,
hazy or smooth they find too few keypoints to match, so finer and weaker ones are added until there
are enough.
"""

import cv2
import numpy as np

from ..utils import colmap

HLOC = {"first_octave": 0, "peak_threshold": 0.01}
COLMAP = {"first_octave": -1, "peak_threshold": 0.0067}
# name -> the settings that are tried first, and whether finer ones are where these find too few
SETTINGS = {"adaptive": (HLOC, True), "colmap": (COLMAP, True), "hloc": (HLOC, False)}
KEYPOINTS = tuple(SETTINGS)

ENOUGH = 2500  # keypoints of a photo, and in small ones
PIXELS = 200  # for each of them
SMALL = 1200  # pixels on the longer side: twice as large it is still fast to search
# (first_octave, peak_threshold), tried one after the other while there are not enough keypoints.
# Octave -1 is that of the photo at twice its size; 0.0067 is COLMAP's own threshold.
LADDERS = {
    "small": ((-1, 0.0067), (-1, 0.0033), (-1, 0.001)),
    "large": ((0, 0.005), (0, 0.0025), (0, 0.001), (-1, 0.0033)),
}

BLUR = 4.0  # pixels, standard deviation of the blur that suppresses noise
LEAST_SIGNAL = 5.0  # times what noise alone leaves after such a blur


def detect(
    image: np.ndarray, options: dict, adaptive: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Detect and describe keypoints, with other settings where those given find too few.

    Where they find enough, the keypoints are exactly theirs. A photo that shows nothing but noise
    is left as it is.

    Args:
        image: (H, W) float32 in [0, 1].
        options: of pycolmap's SiftExtractionOptions.
        adaptive: try other settings.

    Returns:
        As `colmap.detect_dog`.
    """
    found = colmap.detect_dog(image, options)
    enough = min(ENOUGH, image.size / PIXELS)
    if not adaptive or len(found[0]) >= enough or is_noise(image):
        return found
    ladder = LADDERS["small" if max(image.shape) <= SMALL else "large"]
    for first_octave, peak_threshold in ladder:
        settings = {"first_octave": first_octave, "peak_threshold": peak_threshold}
        if first_octave > options["first_octave"] or peak_threshold >= options["peak_threshold"]:
            continue
        more = colmap.detect_dog(image, {**options, **settings})
        found = more if len(more[0]) > len(found[0]) else found
        if len(found[0]) >= enough:
            break
    return found


def is_noise(image: np.ndarray) -> bool:
    """Tell whether a photo (H, W) has no contrast beyond that of its noise, as of a covered lens.

    The noise is estimated from second differences (Immerkaer, 1996), by their median.
    """
    kernel = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32)
    noise = np.median(np.abs(cv2.filter2D(image, -1, kernel))) / 0.6745 / 6
    smooth = cv2.GaussianBlur(image, (0, 0), BLUR)
    left = noise / (2 * np.sqrt(np.pi) * BLUR)  # standard deviation of white noise that was blurred
    # 98 % of it lie within 2.33 deviations; never less than an 8-bit step, which dithers
    low, high = np.percentile(smooth, [1, 99])
    return bool(high - low <= max(LEAST_SIGNAL * 2 * 2.33 * left, 1 / 255))
