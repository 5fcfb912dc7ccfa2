"""Painting: noise, and the materials of walls, roofs and pavements.

Painters take the random generator first and work on float32 RGB (H, W, 3) in [0, 1]; row 0 is the
upper edge. Materials have `DENSITY` texels per metre.
"""

import cv2
import numpy as np
from numpy.typing import ArrayLike

from .surface import Color, Texture, Vector

DENSITY = 96  # texels per metre of the walls
FINE = 160  # of small parts: windows, signs, trim
Rng = np.random.Generator
Shape = tuple[int, ...]


def noise(rng: Rng, shape: Shape, cell: ArrayLike) -> np.ndarray:
    """Draw smooth noise of zero mean and about unit variance, float32 of `shape` (H, W).

    `cell` is the spacing of its grid in texels, one number or (vertical, horizontal).
    """
    cell_y, cell_x = np.broadcast_to(np.asarray(cell, float), 2)
    grid = (int(shape[0] / cell_y) + 3, int(shape[1] / cell_x) + 3)
    coarse = rng.standard_normal(grid, dtype=np.float32) * 1.4
    return cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC)


def fractal(
    rng: Rng, shape: Shape, cell: ArrayLike, octaves: int, decay: float = 0.6
) -> np.ndarray:
    """Sum `octaves` noises, each of half the cell and `decay` times the strength of the last."""
    cell = np.asarray(cell, float)
    total = np.zeros(shape, np.float32)
    for k in range(octaves):
        total += decay**k * noise(rng, shape, cell / 2**k)
    return total


def soft_step(values: np.ndarray, threshold: float, width: float) -> np.ndarray:
    """Map values below the threshold to 0, above it to 1, linearly over `width` around it."""
    return np.clip((values - threshold) / width + 0.5, 0, 1)


def courses(
    rng: Rng, shape: Shape, stone: tuple[float, float], wild: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lay courses of stones of `stone = (height, length)` texels, `wild` in [0, 1] irregular.

    Returns:
        float32 (H, W) each: the random tone of each stone, ~N(0, 1); the distance to its edge in
        texels; the position in the course, from 0 at its top to 1 at its bottom.
    """
    height, length = stone
    warp = wild * 0.08 * height
    y = np.arange(shape[0], dtype=np.float32)[:, None] + warp * noise(rng, shape, length)
    x = np.arange(shape[1], dtype=np.float32)[None] + warp * noise(rng, shape, length)
    row = np.clip(np.floor(y / height), 0, shape[0] // height).astype(np.int32)
    n_rows = int(shape[0] // height) + 1
    shift = length * (np.arange(n_rows) % 2 / 2 + wild * rng.random(n_rows)).astype(np.float32)
    x += shift[row] + 2 * height
    col = (x / length).astype(np.int32)
    tone = rng.standard_normal((n_rows, int(col.max()) + 1), dtype=np.float32)[row, col]
    dy, dx = y - row * height, x - col * length
    edge = np.minimum(np.minimum(dy, height - dy), np.minimum(dx, length - dx))
    return tone, edge, dy / height


def tinted(color: Color, tone: np.ndarray) -> np.ndarray:
    """Multiply a colour by `1 + tone` (H, W), float32 (H, W, 3)."""
    tone = np.float32(1) + tone.astype(np.float32)
    return cv2.merge([tone * np.float32(channel) for channel in color])


def mixed(paint: np.ndarray, other: np.ndarray | Color, share: np.ndarray) -> np.ndarray:
    """Blend a colour or another painting into a painting, by a share (H, W) in [0, 1]."""
    return paint + share[..., None] * (np.asarray(other, np.float32) - paint)


def spot(rng: Rng, paint: np.ndarray, at: Vector, axes: Vector, color: Color) -> None:
    """Draw an ellipse of any orientation in place; `at` (x, y) and `axes` in texels."""
    center, size = (tuple(int(value) for value in pair) for pair in (at, axes))
    angle = rng.uniform(0, 180)
    cv2.ellipse(paint, center, size, angle, 0, 360, as_scalar(color), -1, cv2.LINE_AA)


def as_scalar(color: Color, factor: float = 1.0) -> tuple[float, ...]:
    """Return a colour, times a factor, as OpenCV's drawing functions take it."""
    return tuple(float(value) * factor for value in color)


def finish(paint: np.ndarray) -> np.ndarray:
    """Convert from float in [0, 1] to uint8."""
    return (np.clip(paint, 0, 1) * 255 + 0.5).astype(np.uint8)


def texture(paint: np.ndarray, density: float = FINE, glow: float = 0.0) -> Texture:
    """Make a texture of a painting."""
    return Texture(finish(paint), density, glow)


def plaster(rng: Rng, shape: Shape, color: Color) -> np.ndarray:
    """Paint plaster with stains of all sizes, fallen off in places over the bricks."""
    blotches = fractal(rng, shape, 90, 6, 0.75)
    grain = noise(rng, shape, 2.2)
    paint = tinted(color, 0.045 * blotches + 0.025 * grain)
    specks = soft_step(fractal(rng, shape, 14, 3), 2.1, 0.7)
    paint *= (1 - 0.35 * specks)[..., None]
    bare = soft_step(fractal(rng, shape, 150, 5), 2.75, 0.12)
    if bare.any():
        rim = soft_step(cv2.GaussianBlur(bare, (0, 0), 3), 0.2, 0.3)
        paint *= 1 - 0.25 * rim[..., None]
        rows, columns = (np.flatnonzero(bare.any(axis)) for axis in (1, 0))
        box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        bricks = brick(rng, bare[box].shape, (0.52, 0.33, 0.26))
        paint[box] = mixed(paint[box], bricks, bare[box])
    return paint


def brick(rng: Rng, shape: Shape, color: Color) -> np.ndarray:
    """Paint brick courses of 25 x 7.5 cm with lighter joints."""
    tone, edge, _ = courses(rng, shape, (0.078 * DENSITY, 0.25 * DENSITY), 0.15)
    paint = tinted(color, 0.16 * tone + 0.06 * fractal(rng, shape, 60, 5))
    joint = (1 - soft_step(edge, 0.8, 0.9))[..., None]
    return paint + joint * (np.array((0.66, 0.63, 0.58), np.float32) - paint) * 0.75


def ashlar(rng: Rng, shape: Shape, color: Color) -> np.ndarray:
    """Paint stone blocks of about 60 x 32 cm with dark joints."""
    tone, edge, _ = courses(rng, shape, (0.32 * DENSITY, 0.62 * DENSITY), 0.5)
    rough = fractal(rng, shape, 30, 5, 0.8)
    paint = tinted(color, 0.10 * tone + 0.07 * rough)
    return paint * (0.55 + 0.45 * soft_step(edge, 1.8, 2.0))[..., None]


def half_timber(rng: Rng, shape: Shape, color: Color) -> np.ndarray:
    """Paint plaster panels between dark beams: posts, rails and braces."""
    paint = plaster(rng, shape, color)
    beams = np.zeros(shape, np.float32)
    bay, storey, thick = 1.35 * DENSITY, 1.42 * DENSITY, round(0.17 * DENSITY)
    n_rows, n_cols = round(shape[0] / storey), max(2, round(shape[1] / bay))
    ys = np.linspace(thick / 2, shape[0] - thick / 2, n_rows + 1)
    xs = np.linspace(thick / 2, shape[1] - thick / 2, n_cols + 1)
    lines = [((0, y), (shape[1], y)) for y in ys] + [((x, 0), (x, shape[0])) for x in xs]
    for i in range(n_rows):
        for j in range(n_cols):
            kind = rng.integers(5)
            if kind < 2:
                lines.append(((xs[j + kind], ys[i]), (xs[j + 1 - kind], ys[i + 1])))
    for line in lines:
        a, b = (tuple(int(16 * value) for value in point) for point in line)
        cv2.line(beams, a, b, 1.0, thick, cv2.LINE_AA, 4)
    wood = tinted((0.27, 0.19, 0.13), 0.2 * noise(rng, shape, (3, 40)) + 0.2 * noise(rng, shape, 6))
    paint *= 1 - 0.3 * cv2.GaussianBlur(beams, (0, 0), 4)[..., None]
    return mixed(paint, wood, beams)


MATERIALS = {"plaster": plaster, "brick": brick, "ashlar": ashlar, "half_timber": half_timber}


def roof_tiles(rng: Rng, width: float, height: float, color: Color) -> Texture:
    """Paint rows of clay tiles with moss, for a roof of `width` x `height` metres."""
    density = 64
    shape = (round(height * density), round(width * density))
    tone, edge, ramp = courses(rng, shape, (0.22 * density, 0.19 * density), 0.1)
    paint = tinted(color, 0.13 * tone + 0.08 * fractal(rng, shape, 60, 4))
    paint *= (0.6 + 0.45 * ramp)[..., None] * (0.75 + 0.25 * soft_step(edge, 1, 1))[..., None]
    moss = soft_step(fractal(rng, shape, 50, 5), 1.6, 0.8) * 0.6
    return texture(mixed(paint, (0.30, 0.33, 0.20), moss), density)


def cobbles(rng: Rng, width: float, height: float, stone: tuple[float, float]) -> Texture:
    """Paint cobbled ground of stones of `stone` metres, with worn paths, puddles and litter."""
    density = 72
    shape = (round(height * density), round(width * density))
    tone, edge, _ = courses(rng, shape, (stone[0] * density, stone[1] * density), 0.8)
    paint = tinted((0.60, 0.575, 0.54), 0.13 * tone + 0.06 * fractal(rng, shape, 200, 7, 0.8))
    paint *= (0.5 + 0.5 * soft_step(edge, 1.2, 2.0))[..., None]
    paint *= (1 - 0.25 * soft_step(fractal(rng, shape, 130, 4), 1.4, 0.5))[..., None]
    for _ in range(int(width * height / 2)):  # litter and leaves
        at = rng.uniform((0, 0), shape[::-1])
        spot(rng, paint, at, rng.integers(2, 6, 2), rng.uniform(0.15, 0.75, 3) * (1, 0.9, 0.7))
    return texture(paint, density)


def trim(rng: Rng, color: Color, streak: float = 1.0, density: float = FINE) -> Texture:
    """Paint 160 x 160 texels of stone, wood or metal for ledges, beams and posts."""
    shape = (FINE, FINE)
    tone = 0.06 * noise(rng, shape, (8, 8 * streak)) + 0.05 * noise(rng, shape, (3, 3 * streak))
    return texture(tinted(color, tone + 0.05 * fractal(rng, shape, 60, 3)), density)
