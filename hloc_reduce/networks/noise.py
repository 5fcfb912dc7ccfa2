"""Blur noisy photos as much as helps a network, and cut off their lamps."""

import cv2
import numpy as np

BLOCK_PIXELS = 32  # the side of the blocks in which noise is measured
SMOOTH = 0.1  # share of the blocks that are taken for smooth
CLIPPED = 0.02, 0.98  # blocks of a mean beyond have lost their noise
# lamps are brighter than this multiple of the median, and this share of the pixels at most
LAMP_BRIGHTNESS, MAX_LAMP_SHARE = 2.5, 0.02
STEP = 4  # every fourth row and column tells as much of them, in a tenth of the time
NOISY = 0.08  # standard deviation of the noise, in that of the image, from which it is blurred
# the blur, a standard deviation in pixels: the smaller of BLUR_PER_ROOT_NOISE * sqrt(noise)
# and BLUR_PER_NOISE * noise, which are equal at 0.34 (docs/lab.md)
BLUR_PER_ROOT_NOISE, BLUR_PER_NOISE = 2.8, 4.8


def relative_noise(image: np.ndarray) -> float:
    """Estimate the noise of an image in units of its contrast.

    Noise is what varies from pixel to pixel in the smoothest parts: the diagonal details of a Haar
    transform, in which edges show least. Lamps do not add to the contrast: networks normalize
    images by their standard deviation, most of which a lamp in a dark photo would make up.

    Args:
        image: (H, W) float32 in [0, 1].

    Returns:
        The ratio of two standard deviations: of the noise, and of the image; 0 for an image that
        is too small, or of one colour.
    """
    height, width = (side // BLOCK_PIXELS * BLOCK_PIXELS for side in image.shape)
    contrast = float(image.clip(max=lamps(image)).std()) if image.size else 0.0
    if not (height and width and contrast):
        return 0.0
    pixels = image[:height, :width]
    detail = pixels[::2, ::2] - pixels[1::2, ::2] - pixels[::2, 1::2] + pixels[1::2, 1::2]
    side = BLOCK_PIXELS // 2
    blocks = (detail / 2).reshape(height // BLOCK_PIXELS, side, width // BLOCK_PIXELS, side)
    means = pixels.reshape(
        height // BLOCK_PIXELS, BLOCK_PIXELS, width // BLOCK_PIXELS, BLOCK_PIXELS
    ).mean(axis=(1, 3))
    measured = blocks.std(axis=(1, 3))[(means > CLIPPED[0]) & (means < CLIPPED[1])]
    return float(np.quantile(measured, SMOOTH)) / contrast if measured.size else 0.0


def lamps(image: np.ndarray) -> float:
    """Return the value above which pixels (H, W) or (C, H, W) in [0, 1] are lamps."""
    median, brightest = np.quantile(image[..., ::STEP, ::STEP], [0.5, 1 - MAX_LAMP_SHARE])
    return float(max(LAMP_BRIGHTNESS * median, brightest))


def reduce_noise(channels: np.ndarray) -> tuple[np.ndarray, float]:
    """Blur an image and cut off its lamps if it is noisy.

    Args:
        channels: (C, H, W) float32 in [0, 1].

    Returns:
        The image, as given if it is not noisy, and the standard deviation of the blur in pixels.
    """
    noise = relative_noise(channels.mean(axis=0))
    if noise < NOISY:
        return channels, 0.0
    cut = channels.clip(max=lamps(channels))
    blur = min(BLUR_PER_ROOT_NOISE * np.sqrt(noise), BLUR_PER_NOISE * noise)
    return np.stack([cv2.GaussianBlur(channel, (0, 0), blur) for channel in cut]), float(blur)
