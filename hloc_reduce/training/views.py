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
from torch.nn.functional import conv2d, pad

from ..demo.cameras import DAY, MAP, NIGHT, QUERIES, list_photos
from ..demo.photo import take
from ..demo.town import build_town
from ..utils.files import replacing
from ..utils.images import list_images, read_image
from ..utils.progress import progress

SIZE = 320  # pixels, the side of a view
LONGEST = 1600  # pixels, the longest side of a photo
LEVELS = 3  # a photo, its half and its quarter
# pixels of the photo that a pixel of a view takes; and octaves between the two views of a pair
SCALES, OCTAVES, MAX_OCTAVES = (0.7, 2.5), 0.6, 2.0
TILTED = 0.5  # share of pairs with rotations of up to 45 degrees; others are nearly upright
ROTATION, UPRIGHT = 22.5, 4.0  # degrees, of each view
SHIFT, PERSPECTIVE = 0.15, 0.1  # of a view's centre and corners, as shares of its side
KEPT = 0.25  # share of views that are not degraded
DARK = 0.6  # share of the views of a photo by day and by night that the student sees by night
KERNEL = 13  # pixels, the side of a blur
LAMPS = 5  # at most, in a view
# Quantization of JPEG's luminance, ITU-T T.81, table K.1
QUANTIZATION = """
    16 11 10 16 24 40 51 61 12 12 14 19 26 58 60 55 14 13 16 24 40 57 69 56 14 17 22 29 51 87 80 62
    18 22 37 56 68 109 103 77 24 35 55 64 81 104 113 92 49 64 78 87 103 121 120 101
    72 92 95 98 112 100 103 99"""


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
                    seen = dataclasses.replace(photo, kind=kind, index=photo.index % QUERIES)
                    with replacing(path) as temporary:
                        temporary.write_bytes(take(build_town(seed), seen, seed))
            sources.append(Source(*paths))
    build_town.cache_clear()
    return sources


class Photos:
    """Photos in memory, grey, each at full, half and a quarter of the size.

    Args:
        sources: what to read.
        device: where the pixels are kept and views are made.
    """

    def __init__(self, sources: list[Source], device: torch.device):
        self.device = device
        pixels: list[np.ndarray] = []
        shapes: list[list[tuple[int, int]]] = []
        numbers: dict[Path, int] = {}
        for source in progress(sources, "Reading photos", "photo", len(sources)):
            for path in (source.clean, source.dark):
                if path is not None and path not in numbers:
                    numbers[path] = len(numbers)
                    levels = _read(path)
                    pixels += [level.ravel() for level in levels]
                    shapes.append([level.shape[:2] for level in levels])
        # of each photo and level: its first pixel, height and width
        starts = np.cumsum([0, *(len(level) for level in pixels)])[:-1].reshape(-1, LEVELS, 1)
        layout = np.concatenate([starts, np.array(shapes)], axis=2)
        self.layout = torch.from_numpy(layout).to(device)
        self.pixels = torch.from_numpy(np.concatenate(pixels)).to(device)
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
        matrices = torch.from_numpy(matrices.astype(np.float32)).to(self.device)
        return Pairs(views, degraded, matrices)

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
        upper, upper_right, lower, lower_right = (
            self.pixels[corner + step].float() for step in (0, 1, width, width + 1)
        )
        upper, lower = (
            torch.lerp(left_one, right_one, x - left)
            for left_one, right_one in ((upper, upper_right), (lower, lower_right))
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


def degrade(views: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """Return views (V, 1, H, W) in [0, 1] as a bad camera takes them, perhaps in the dark.

    Lamps, blur by focus or motion, exposure, shot and read noise in linear light; tone curve,
    8 bits, JPEG. Each may be absent.
    """
    number, device = len(views), views.device

    def column(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values).to(device)[:, None, None, None]

    def log_uniform(least: np.ndarray | float, most: np.ndarray | float) -> np.ndarray:
        return np.exp(rng.uniform(np.log(least), np.log(most), number)).astype(np.float32)

    kept, dark = rng.random(number) < KEPT, rng.random(number) < 0.5
    linear = views**2.2
    lit = dark & (rng.random(number) < 0.3)
    median = linear.flatten(1).median(dim=1).values[:, None, None, None]
    linear = linear + _lamps(rng, lit, views.shape[-1], device) * median
    linear = _blurred(linear, _kernels(rng, number))
    # in units of the contrast, as networks normalize it
    read = log_uniform(np.where(dark, 0.02, 0.005), np.where(dark, 0.6, 0.06))
    deviation = column(read) * linear.std(dim=(1, 2, 3), keepdim=True)
    shot = column(log_uniform(0.003, 0.06))
    generator = torch.Generator(device).manual_seed(int(rng.integers(2**62)))
    noise = torch.randn(views.shape, generator=generator, device=device)
    linear = linear + noise * (deviation**2 + shot**2 * linear).sqrt()
    exposure = np.where(dark, rng.uniform(0.002, 0.5, number), np.exp(rng.normal(0, 0.4, number)))
    tone = np.exp(rng.normal(0, 0.15, number)) / 2.2
    exposed = (linear * column(exposure.astype(np.float32))).clamp(0, 1)
    levels = (exposed ** column(tone.astype(np.float32)) * 255).round()
    quality = rng.integers(40, 96, number).astype(np.float32)
    compressed = column(rng.random(number) < 0.6)
    levels = torch.where(compressed, _jpeg(levels, column(quality)), levels)
    return torch.where(column(kept), views, levels / 255)


def _lamps(
    rng: np.random.Generator, lit: np.ndarray, side: int, device: torch.device
) -> torch.Tensor:
    """Return the light (V, 1, side, side) of lamps with their glow, 0 in views not lit (V,)."""
    shape = len(lit), LAMPS
    on = lit[:, None] & (np.arange(LAMPS) < rng.integers(1, LAMPS + 1, (len(lit), 1)))
    centres = rng.uniform(0, side, (2, *shape))
    power = on * rng.uniform(10, 60, shape) * rng.integers(2, 9, shape) ** 2 / 2
    # a spot and its glow: standard deviations, and their shares of the light
    sigmas = np.stack([rng.uniform(2, 4.5, shape), rng.uniform(8, 25, shape)])
    shares = np.stack([np.ones(shape), rng.uniform(0.05, 0.4, shape)])
    places = (np.arange(side) - centres[:, None, :, :, None]) / sigmas[..., None]
    profiles = np.exp(-(places**2) / 2)
    profiles[1] *= (power * shares / sigmas**2)[..., None]
    # (2, V, lamps and glows, side)
    profiles = profiles.swapaxes(1, 2).reshape(2, len(lit), -1, side).astype(np.float32)
    columns, rows = torch.from_numpy(profiles).to(device)
    return (rows.mT @ columns)[:, None]


def _kernels(rng: np.random.Generator, number: int) -> np.ndarray:
    """Draw blurs (V, KERNEL, KERNEL) float32: by focus, by a straight motion, or none."""
    offsets = np.arange(KERNEL) - KERNEL // 2
    kernels = np.zeros((number, KERNEL, KERNEL), np.float32)
    for kernel in kernels:
        if rng.random() < 0.5:
            profile = np.exp(-((offsets / rng.uniform(0.3, 2.0)) ** 2) / 2)
            kernel[:] = np.outer(profile, profile)
        elif rng.random() < 0.3:
            angle, reach = rng.uniform(0, np.pi), rng.integers(2, 5)
            end = np.round(reach * np.array([np.cos(angle), np.sin(angle)])).astype(int)
            first, last = ((KERNEL // 2 + sign * end).tolist() for sign in (-1, 1))
            cv2.line(kernel, first, last, 1.0)
        else:
            kernel[KERNEL // 2, KERNEL // 2] = 1
    return kernels / kernels.sum(axis=(1, 2), keepdims=True)


def _blurred(views: torch.Tensor, kernels: np.ndarray) -> torch.Tensor:
    """Convolve each view (V, 1, H, W) with its kernel."""
    padded = pad(views, (KERNEL // 2,) * 4, mode="reflect")
    weights = torch.from_numpy(kernels)[:, None].to(views.device)
    return conv2d(padded.transpose(0, 1), weights, groups=len(views)).transpose(0, 1)


def _jpeg(levels: torch.Tensor, quality: torch.Tensor) -> torch.Tensor:
    """Round levels (V, 1, H, W) in [0, 255] as JPEG of a quality (V, 1, 1, 1) in [1, 100] does."""
    frequency, pixel = np.mgrid[:8, :8]
    cosines = np.cos(np.pi / 8 * (pixel + 0.5) * frequency) / np.where(frequency, 2, 8**0.5)
    basis = torch.from_numpy(cosines).to(levels)
    scale = torch.where(quality < 50, 5000 / quality, 200 - 2 * quality) / 100
    steps = torch.tensor([int(step) for step in QUANTIZATION.split()]).to(levels).view(8, 8)
    steps = (steps * scale + 0.5).floor().clamp(1, 255)[:, :, None]  # (V, 1, 1, 8, 8)
    number, _, height, width = levels.shape
    blocks = levels.view(number, height // 8, 8, width // 8, 8).transpose(2, 3) - 128
    blocks = (basis @ blocks @ basis.T / steps).round() * steps
    blocks = (basis.T @ blocks @ basis + 128).round().clamp(0, 255)
    return blocks.transpose(2, 3).reshape(levels.shape)
