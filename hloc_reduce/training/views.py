"""Pairs of views of photos, to train networks with: clean, and as a bad camera takes them.

A view is a square part of a photo, seen through a homography. Photos of the demo town come in twos,
by day and by night from the same place: their views show the day to the teacher. Views are made
many at a time, on the device of the training.
"""

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from ..demo.cameras import DAY, MAP, MIN_QUERIES, NIGHT, list_photos
from ..demo.photo import take
from ..demo.town import build_town
from ..utils.files import replacing
from ..utils.images import list_images, read_image
from ..utils.progress import progress
from .degradation import degrade

SIZE = 320  # pixels, the side of a view
LONGEST = 1600  # pixels, the longest side of a photo
LEVELS = 3  # a photo, its half and its quarter
# pixels of the photo that a pixel of a view takes; and octaves between the two views of a pair
SCALES, OCTAVES, MAX_OCTAVES = (0.7, 2.5), 0.6, 2.0
TILTED = 0.5  # share of pairs with rotations of up to 45 degrees between them; others: 8
ROTATION, UPRIGHT = 22.5, 4.0  # degrees, of each view
SHIFT, PERSPECTIVE = 0.15, 0.1  # of a view's centre and corners, as shares of its side
DARK = 0.6  # share of the views of a photo by day and by night that the student sees by night


@dataclass(frozen=True)
class Source:
    """A photo, and the same view in the dark if there is one."""

    clean: Path
    dark: Path | None = None


@dataclass(frozen=True)
class Pairs:
    """Pairs of views of photos: views 2 i and 2 i + 1 show the same photo.

    Args:
        clean: (2 B, 1, SIZE, SIZE) float32 in [0, 1], grey.
        degraded: the same as a bad camera takes it.
        matrices: (B, 3, 3) float32, homographies from pixels of the first view to the second.
    """

    clean: torch.Tensor
    degraded: torch.Tensor
    matrices: torch.Tensor


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
                    seen = dataclasses.replace(photo, kind=kind, index=photo.index % MIN_QUERIES)
                    with replacing(path) as temporary:
                        temporary.write_bytes(take(build_town(seed), seen, seed))
            sources.append(Source(*paths))
    build_town.cache_clear()
    return sources


class Photos:
    """Photos in memory, grey, each at full, half and a quarter of the size: 2.5 MB for 2 MP.

    Args:
        sources: what to read.
        device: where the pixels are kept and views are made.
    """

    def __init__(self, sources: list[Source], device: torch.device):
        self.device = device
        pixels: list[torch.Tensor] = []
        shapes: list[list[tuple[int, int]]] = []
        numbers: dict[Path, int] = {}
        for source in progress(sources, "Reading photos", "photo", len(sources)):
            for path in (source.clean, source.dark):
                if path is not None and path not in numbers:
                    numbers[path] = len(numbers)
                    levels = _read(path)
                    pixels += [torch.from_numpy(level.ravel()).to(device) for level in levels]
                    shapes.append([level.shape[:2] for level in levels])
        # of each photo and level: its first pixel, height and width
        starts = np.cumsum([0, *(len(level) for level in pixels)])[:-1].reshape(-1, LEVELS, 1)
        layout = np.concatenate([starts, np.array(shapes)], axis=2)
        self.layout = torch.from_numpy(layout).to(device)
        self.pixels = torch.cat(pixels)
        self.sides = layout[:, 0, :0:-1].astype(float)  # width, height
        self.clean = np.array([numbers[source.clean] for source in sources])
        self.dark = np.array([numbers[source.dark or source.clean] for source in sources])

    def draw(self, number: int, seed: Iterable[int]) -> Pairs:
        """Draw pairs of views; the same ones for a seed on the same kind of device."""
        rng = np.random.default_rng(list(seed))
        which = rng.integers(len(self.clean), size=number)
        clean, dark = self.clean[which], self.dark[which]
        homographies = _homographies(rng, self.sides[clean])
        views = self._warp(np.repeat(clean, 2), homographies)
        degraded = degrade(views, rng)
        dark = np.repeat(dark, 2)
        night = (dark != np.repeat(clean, 2)) & (rng.random(2 * number) < DARK)
        if night.any():
            seen = torch.from_numpy(night).to(self.device)
            degraded[seen] = self._warp(dark[night], homographies[night])
        matrices = np.linalg.inv(homographies[1::2]) @ homographies[::2]
        return Pairs(views, degraded, self._to_device(matrices))

    def _warp(self, which: np.ndarray, homographies: np.ndarray) -> torch.Tensor:
        """Return views (V, 1, SIZE, SIZE) in [0, 1] of photos (V,)."""
        scales = np.sqrt(np.abs(np.linalg.det(homographies[:, :2, :2])))
        level = np.clip(np.floor(np.log2(np.maximum(scales, 1)) + 0.3), 0, LEVELS - 1).astype(int)
        shrink = np.stack([0.5**level, 0.5**level, np.ones(len(level))], axis=1)
        matrices = self._to_device(shrink[:, :, None] * homographies)
        first, height, width = self.layout[which, level][:, :, None].unbind(dim=1)
        side = torch.arange(SIZE, dtype=torch.float32, device=self.device)
        x, y = torch.meshgrid(side, side, indexing="xy")
        x, y, depth = (matrices @ torch.stack([x, y, torch.ones_like(x)]).flatten(1)).unbind(dim=1)
        x = (x / depth).clamp(min=0).minimum(width - 1)
        y = (y / depth).clamp(min=0).minimum(height - 1)
        left, top = x.long().minimum(width - 2), y.long().minimum(height - 2)
        corner = first + top * width + left
        upper, lower = (
            torch.lerp(self.pixels[row].float(), self.pixels[row + 1].float(), x - left)
            for row in (corner, corner + width)
        )
        return torch.lerp(upper, lower, y - top).view(-1, 1, SIZE, SIZE) / 255

    def _to_device(self, values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values.astype(np.float32)).to(self.device)


def _read(path: Path) -> list[np.ndarray]:
    """Read a photo, (H, W) uint8, at full, half and a quarter of the size."""
    pixels = read_image(path, grayscale=True)
    ratio = LONGEST / max(pixels.shape)
    if ratio < 1:
        pixels = cv2.resize(pixels, None, fx=ratio, fy=ratio, interpolation=cv2.INTER_AREA)
    levels = [pixels]
    while len(levels) < LEVELS:
        levels.append(cv2.pyrDown(levels[-1]))
    return levels


def _homographies(rng: np.random.Generator, sides: np.ndarray) -> np.ndarray:
    """Draw homographies (2 B, 3, 3) from pixels of views to pixels of photos.

    Args:
        rng: what is drawn from.
        sides: (B, 2), width and height of the photos.
    """
    number = len(sides)
    largest = np.clip(sides.min(axis=1) / SIZE, *SCALES)
    scale = np.exp(rng.uniform(np.log(SCALES[0]), np.log(largest)))[:, None]
    margin = np.minimum(scale * SIZE / 2, sides / 2)
    centre = rng.uniform(margin, sides - margin)
    limit = np.where(rng.random((number, 1)) < TILTED, ROTATION, UPRIGHT)
    octaves = np.clip(rng.normal(0, OCTAVES, (number, 1)), -MAX_OCTAVES, MAX_OCTAVES)
    angles = np.radians(rng.uniform(-1, 1, (number, 2)) * limit)
    size = scale * 2.0 ** (octaves * [-0.5, 0.5])  # pixels of the photo in one of a view, (B, 2)
    turns = np.stack([np.cos(angles), -np.sin(angles), np.sin(angles), np.cos(angles)], axis=-1)
    turns = size[..., None, None] * turns.reshape(number, 2, 2, 2)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (SIZE - 1.0)
    bent = corners - (SIZE - 1) / 2 + rng.uniform(-1, 1, (number, 2, 4, 2)) * PERSPECTIVE * SIZE
    moved = centre[:, None] + rng.uniform(-1, 1, (number, 2, 2)) * (SHIFT * SIZE * scale)[:, None]
    quads = moved[:, :, None] + bent @ turns.swapaxes(2, 3)
    corners, quads = corners.astype(np.float32), quads.reshape(-1, 4, 2).astype(np.float32)
    return np.stack([cv2.getPerspectiveTransform(corners, quad) for quad in quads])
