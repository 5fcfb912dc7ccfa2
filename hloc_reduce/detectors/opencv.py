"""SIFT of OpenCV, several times as fast as COLMAP's, with options of COLMAP's."""

import cv2
import numpy as np

CONTRAST_PER_PEAK = 3  # OpenCV divides its contrastThreshold by the number of layers of an octave
MAX_KEYPOINTS = 8192  # COLMAP's default; of more, those of the strongest contrast are kept


def detect(image: np.ndarray, options: dict) -> tuple[np.ndarray, np.ndarray]:
    """Detect and describe keypoints.

    OpenCV doubles an image before it searches. For the octave 0 it gets one of half the size, which
    makes it fast, and keypoints a little less precise.

    Args:
        image: (H, W) float32 in [0, 1], rounded to 8 bits.
        options: of COLMAP: first_octave, -1 or 0, and peak_threshold; no others.

    Returns:
        What `utils.colmap.detect_dog` does. Descriptors of a keypoint that both find differ from
        COLMAP's by rounding and sampling: OpenCV has the same layout, and L1_ROOT is taken here.
    """
    factor = 2 if options["first_octave"] == 0 else 1
    height, width = image.shape
    if factor > 1:
        size = max(width // factor, 1), max(height // factor, 1)
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    pixels: np.ndarray = np.round(image * 255).astype(np.uint8)
    sift = cv2.SIFT.create(
        nfeatures=MAX_KEYPOINTS,
        contrastThreshold=CONTRAST_PER_PEAK * options["peak_threshold"],
        enable_precise_upscale=True,
    )
    found, described = sift.detectAndCompute(pixels, None)
    if not found:
        return np.empty((0, 4), np.float32), np.empty((0, 128), np.float32)
    scale = np.array([width, height]) / pixels.shape[::-1]
    x_y = (np.array([keypoint.pt for keypoint in found]) + 0.5) * scale - 0.5
    sizes = [(keypoint.size / 2 * factor, keypoint.angle) for keypoint in found]
    norm = np.maximum(described.sum(axis=1, keepdims=True), 1)
    return np.hstack([x_y, sizes]).astype(np.float32), np.sqrt(described / norm)
