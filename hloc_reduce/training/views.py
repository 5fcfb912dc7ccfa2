"""Pairs of views of photos, to train networks with: clean, and as a bad camera takes them.

A view is a square part of a photo, seen through a homography. Photos of the demo town come in twos,
by day and by night from the same place: their views show the day to the teacher.
"""

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from ..demo.cameras import DAY, MAP, NIGHT, QUERIES, list_photos
from ..demo.photo import take
from ..demo.town import build_town
from ..utils.files import replacing
from ..utils.images import list_images, read_image
from ..utils.progress import progress

SIZE = 320  # pixels, the side of a view
LONGEST = 1600  # pixels, the longest side of a photo
CACHED = 512  # photos in memory: 2 MB each
# pixels of the photo that a pixel of a view takes; and octaves between the two views of a pair
SCALES, OCTAVES, MAX_OCTAVES = (0.7, 2.5), 0.6, 2.0
TILTED = 0.5  # share of pairs with rotations of up to 45 degrees; others are nearly upright
ROTATION, UPRIGHT = 45.0, 8.0  # degrees
SHIFT, PERSPECTIVE = 0.15, 0.1  # of a view's centre and corners, as shares of its side


@dataclass(frozen=True)
class Source:
    """A photo, and the same view in the dark if there is one."""

    clean: Path
    dark: Path | None = None


@dataclass(frozen=True)
class Pair:
    """Two views of a photo.

    Args:
        clean: (2, SIZE, SIZE) float32 in [0, 1], grey.
        degraded: the same as a bad camera takes it.
        matrix: (3, 3), homography from pixels of the first to pixels of the second.
    """

    clean: np.ndarray
    degraded: np.ndarray
    matrix: np.ndarray


def of_folders(folders: Iterable[Path]) -> list[Source]:
    """List the photos of folders."""
    return [Source(folder / name) for folder in folders for name in list_images(folder)]


def render_towns(seeds: Iterable[int], output: Path) -> list[Source]:
    """Render map photos of demo towns by day and by night, unless they are there.

    Args:
        seeds: of the towns; that of the demo's data set is 0.
        output: folder for the photos.
    """
    sources = []
    for seed in seeds:
        photos = [photo for photo in list_photos(seed) if photo.kind == MAP]
        for photo in progress(photos, f"Rendering town {seed}", "photo", len(photos)):
            paths = [output / f"{seed}-{photo.index}-{time}.jpg" for time in ("day", "night")]
            for path, kind in zip(paths, (DAY, NIGHT), strict=True):
                if not path.exists():
                    seen = dataclasses.replace(photo, kind=kind, index=photo.index % QUERIES)
                    with replacing(path) as temporary:
                        temporary.write_bytes(take(build_town(seed), seen, seed))
            sources.append(Source(*paths))
    build_town.cache_clear()
    return sources


@lru_cache(CACHED)
def _read(path: Path) -> tuple[np.ndarray, ...]:
    """Read a photo (H, W) uint8, at full, half, and a quarter of the size."""
    pixels = read_image(path, grayscale=True)
    ratio = LONGEST / max(pixels.shape)
    if ratio < 1:
        pixels = cv2.resize(pixels, None, fx=ratio, fy=ratio, interpolation=cv2.INTER_AREA)
    half = cv2.pyrDown(pixels)
    return pixels, half, cv2.pyrDown(half)


def draw(sources: list[Source], number: int, rng: np.random.Generator) -> Iterator[Pair]:
    """Draw pairs of views."""
    for _ in range(number):
        source = sources[rng.integers(len(sources))]
        photo = _read(source.clean)[0]
        views = _views(rng, photo.shape)
        clean = np.stack([_warp(source.clean, view) for view in views])
        if source.dark is not None and rng.random() < 0.7:
            degraded = np.stack([_warp(source.dark, view) for view in views])
        else:
            degraded = np.stack([degrade(view, rng) for view in clean])
        yield Pair(clean, degraded, np.linalg.inv(views[1]) @ views[0])


def _views(rng: np.random.Generator, shape: tuple[int, ...]) -> list[np.ndarray]:
    """Draw two homographies (3, 3) from pixels of a view to pixels of a photo."""
    sides = np.array(shape[1::-1], float)
    largest = max(SCALES[0], min(SCALES[1], sides.min() / SIZE))
    scale = np.exp(rng.uniform(np.log(SCALES[0]), np.log(largest)))
    margin = np.minimum(scale * SIZE / 2, sides / 2)
    centre = rng.uniform(margin, sides - margin)
    limit = ROTATION if rng.random() < TILTED else UPRIGHT
    octaves = np.clip(rng.normal(0, OCTAVES), -MAX_OCTAVES, MAX_OCTAVES)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (SIZE - 1.0)
    views = []
    for side in (-0.5, 0.5):
        angle = np.radians(rng.uniform(-limit, limit))
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        here = scale * 2.0 ** (side * octaves)
        bent = corners - (SIZE - 1) / 2 + rng.uniform(-1, 1, (4, 2)) * PERSPECTIVE * SIZE
        moved = centre + rng.uniform(-1, 1, 2) * SHIFT * SIZE * scale
        quad = moved + here * bent @ rotation.T
        views.append(
            cv2.getPerspectiveTransform(corners.astype(np.float32), quad.astype(np.float32))
        )
    return views


def _warp(path: Path, view: np.ndarray) -> np.ndarray:
    """Return a view (SIZE, SIZE) float32 in [0, 1] of a photo."""
    scale = np.sqrt(abs(np.linalg.det(view[:2, :2])))
    level = int(np.clip(np.floor(np.log2(max(scale, 1)) + 0.3), 0, 2))
    shrink = np.diag([0.5**level, 0.5**level, 1])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(
        _read(path)[level], shrink @ view, (SIZE, SIZE), flags=flags, borderMode=cv2.BORDER_REFLECT
    )
    return warped.astype(np.float32) / 255


def degrade(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a view (H, W) in [0, 1] as a bad camera takes it, perhaps in the dark.

    Lamps, blur by focus or motion, exposure, shot and read noise in linear light; tone curve,
    8 bits, JPEG. Each may be absent.
    """
    if rng.random() < 0.25:
        return image
    linear: np.ndarray = image.astype(np.float32) ** 2.2
    dark = rng.random() < 0.5
    if dark and rng.random() < 0.3:
        linear = linear + _lamps(linear.shape, rng) * np.median(linear)
    if rng.random() < 0.5:
        linear = cv2.GaussianBlur(linear, (0, 0), rng.uniform(0.3, 2.0))
    elif rng.random() < 0.3:
        linear = cv2.filter2D(linear, -1, _motion(rng), borderType=cv2.BORDER_REFLECT)
    # in units of the contrast, as networks normalize it
    least, most = (0.02, 0.6) if dark else (0.005, 0.06)
    read = linear.std() * np.exp(rng.uniform(np.log(least), np.log(most)))
    shot = np.exp(rng.uniform(np.log(0.003), np.log(0.06)))
    noise = rng.standard_normal(linear.shape, dtype=np.float32)
    linear = linear + noise * np.sqrt(read**2 + shot**2 * np.maximum(linear, 0))
    linear = linear * (rng.uniform(0.002, 0.5) if dark else np.exp(rng.normal(0, 0.4)))
    tone = 1 / 2.2 * np.exp(rng.normal(0, 0.15))
    levels = (np.clip(linear, 0, 1) ** tone * 255 + 0.5).astype(np.uint8)
    if rng.random() < 0.6:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(40, 96))]
        levels = cv2.imdecode(cv2.imencode(".jpg", levels, quality)[1], cv2.IMREAD_GRAYSCALE)
    return levels.astype(np.float32) / 255


def _lamps(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Return the light (H, W) of a few lamps with their glow."""
    light = np.zeros(shape, np.float32)
    for _ in range(rng.integers(1, 6)):
        centre = tuple(int(rng.integers(side)) for side in shape[::-1])
        cv2.circle(light, centre, int(rng.integers(2, 9)), float(rng.uniform(10, 60)), -1)
    wide = cv2.GaussianBlur(light, (0, 0), float(rng.uniform(8, 25)))
    return cv2.GaussianBlur(light, (0, 0), 2.0) + rng.uniform(0.05, 0.4) * wide


def _motion(rng: np.random.Generator) -> np.ndarray:
    """Return the blur kernel (K, K) of a straight motion."""
    side = 2 * int(rng.integers(2, 5)) + 1
    kernel = np.zeros((side, side), np.float32)
    angle = rng.uniform(0, np.pi)
    reach = (side // 2) * np.array([np.cos(angle), np.sin(angle)])
    start, end = (np.round(side // 2 + sign * reach).astype(int).tolist() for sign in (-1, 1))
    cv2.line(kernel, start, end, 1.0)
    return kernel / kernel.sum()
