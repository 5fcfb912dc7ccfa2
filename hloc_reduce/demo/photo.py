"""Taking a photo: the light of its hour, then lens, sensor and JPEG."""

from collections.abc import Callable

import cv2
import numpy as np

from .cameras import MAP, MIN_QUERIES, NIGHT, Photo
from .render import SUPERSAMPLING, Light, Scene, downsample, render
from .surface import View

LAMP = np.array([1.0, 0.70, 0.38])  # colour of the lamps, linear


def take(scene: Scene, photo: Photo, seed: int) -> bytes:
    """Return the photo as a JPEG file; it depends only on the scene, the photo and the seed."""
    view = View.of(photo.camera, photo.cam_from_world, SUPERSAMPLING)
    return expose(lambda light: downsample(render(scene, view, light)), photo, seed)


def expose(see: Callable[[Light], np.ndarray], photo: Photo, seed: int) -> bytes:
    """Return a photo of what a lens sees as a JPEG file.

    Args:
        see: returns the linear light at every pixel, float32 RGB (H, W, 3).
        photo: whose kind and index determine light and noise.
        seed: of the town.
    """
    rng = np.random.default_rng([seed, 20 + photo.kind, photo.index])
    if photo.kind == NIGHT:
        # Every degree of difficulty occurs once, whatever the seed.
        ranks = np.random.default_rng([seed, 30]).permutation(MIN_QUERIES)
        rank = (ranks[photo.index % MIN_QUERIES] + rng.uniform(0.2, 0.8)) / MIN_QUERIES
        difficulty = 0.2 + 0.75 * rank
        image = _night(rng, see(_moonlight(rng)), difficulty)
    else:
        image = _day(rng, see(_daylight(rng)), phone=photo.kind != MAP)
    levels = (np.clip(image, 0, 1) ** (1 / 2.2) * 255 + 0.5).astype(np.uint8)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 93 if photo.kind == MAP else 90]
    return cv2.imencode(".jpg", levels[..., ::-1], quality)[1].tobytes()


def _daylight(rng: np.random.Generator) -> Light:
    """Draw the light of a day: one of the suns, bright to veiled."""
    return Light(
        sun=int(rng.integers(2)),
        sun_color=rng.uniform(0.4, 1.3) * np.array([1.0, 0.94, 0.84]),
        sky_color=rng.uniform(0.45, 0.6) * np.array([0.93, 1.0, 1.1]),
        lamp_color=np.zeros(3),
        sky_shift=rng.random(),
    )


def _day(rng: np.random.Generator, image: np.ndarray, phone: bool) -> np.ndarray:
    """Apply exposure, white balance and noise of a camera by day; a phone's are worse."""
    spread = 2 if phone else 1
    image = image * (0.30 / np.mean(image) * np.exp(rng.normal(0, 0.10 * spread)))
    image *= np.exp(rng.normal(0, 0.03 * spread, 3)).astype(np.float32)
    image = image / (1 + np.maximum(image - 0.7, 0))  # highlights roll off
    noise = rng.standard_normal(image.shape, dtype=np.float32)
    return image + 0.004 * spread * noise * np.sqrt(np.maximum(image, 0.02))


def _moonlight(rng: np.random.Generator) -> Light:
    """Draw the light of a night: the lamps, and hardly any from the sky."""
    return Light(
        sun=0,
        sun_color=np.zeros(3),
        sky_color=rng.uniform(0.010, 0.022) * np.array([0.62, 0.80, 1.25]),
        lamp_color=LAMP * rng.uniform(0.10, 0.16),
        sky_shift=rng.random(),
    )


def _night(rng: np.random.Generator, image: np.ndarray, difficulty: float) -> np.ndarray:
    """Apply the glow of lamps, then blur and noise that grow with `difficulty`, in [0, 1]."""
    for sigma, share in ((4, 0.04), (18, 0.03)):
        image = image + share * cv2.GaussianBlur(np.minimum(image, 2), (0, 0), sigma)
    blur = rng.uniform(0.2, 0.5) + 2.0 * difficulty
    if rng.random() < 0.5:
        image = cv2.GaussianBlur(image, (0, 0), blur)
    else:
        image = cv2.filter2D(image, -1, _motion(rng, 1 + 3.0 * blur), borderType=cv2.BORDER_REFLECT)
    gain = np.exp(np.interp(difficulty, (0, 1), np.log((3.6, 0.5))))
    read, shot = 0.005 + 0.018 * difficulty, 0.02 + 0.06 * difficulty
    image = image * gain
    noise = rng.standard_normal(image.shape, dtype=np.float32)
    return image + noise * np.sqrt(read**2 + shot**2 * np.maximum(image, 0))


def _motion(rng: np.random.Generator, length: float) -> np.ndarray:
    """Draw the blur kernel of a straight motion of `length` pixels, float32 of odd size."""
    size = 2 * int(np.ceil(length / 2)) + 1
    angle = rng.uniform(0, np.pi)
    t = np.linspace(-0.5, 0.5, 64) * length
    x, y = size // 2 + t * np.cos(angle), size // 2 + t * np.sin(angle)
    kernel = np.zeros((size, size), np.float32)
    for dx in (0, 1):
        for dy in (0, 1):
            column, row = np.floor(x).astype(int) + dx, np.floor(y).astype(int) + dy
            weight = (1 - abs(x - column)) * (1 - abs(y - row))
            inside = (column >= 0) & (column < size) & (row >= 0) & (row < size)
            np.add.at(kernel, (row[inside], column[inside]), weight[inside])
    return kernel / kernel.sum()
