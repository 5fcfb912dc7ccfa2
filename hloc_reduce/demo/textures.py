"""Painting: noise, and the materials of walls, roofs and pavements.

A texture is an image, uint8 RGB (H, W, 3), sRGB, with :data:`DENSITY` texels per metre unless
told otherwise; row 0 is its upper edge. Painters work on float32 in [0, 1] and take the random
generator first. An opening is ``(u0, v0, u1, v1)`` in metres from the upper left corner.
"""

from __future__ import annotations

import cv2
import numpy as np

DENSITY = 96  # texels per metre of the walls; small parts (windows, signs) are painted finer
FINE = 160

Opening = tuple[float, float, float, float]


def noise(
    rng: np.random.Generator, shape: tuple[int, int], cell: float | tuple[float, float]
) -> np.ndarray:
    """Smooth noise of zero mean and about unit variance, float32 (H, W); ``cell`` in texels."""
    cell_y, cell_x = (cell, cell) if np.isscalar(cell) else cell
    grid = (int(shape[0] / cell_y) + 3, int(shape[1] / cell_x) + 3)
    coarse = rng.standard_normal(grid, dtype=np.float32) * 1.4
    return cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC)


def fractal(
    rng: np.random.Generator, shape: tuple[int, int], cell: float, octaves: int, decay: float = 0.6
) -> np.ndarray:
    """Sum of ``octaves`` noises, each of half the cell and ``decay`` times the strength."""
    return sum(decay**k * noise(rng, shape, cell / 2**k) for k in range(octaves))


def soft_step(values: np.ndarray, threshold: float, width: float) -> np.ndarray:
    """0 below, 1 above the threshold, linear over ``width`` around it."""
    return np.clip((values - threshold) / width + 0.5, 0, 1)


def courses(
    rng: np.random.Generator, shape: tuple[int, int], stone: tuple[float, float], wild: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lay courses of stones of ``stone = (height, length)`` texels, ``wild`` in [0, 1] irregular.

    Returns three float32 (H, W): the random tone of each stone, ~N(0, 1); the distance to the
    stone's edge in texels; the position in the course, 0 at its top and 1 at its bottom.
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


def tinted(color: tuple[float, float, float], tone: np.ndarray) -> np.ndarray:
    """The colour times ``1 + tone``, float32 (H, W, 3)."""
    tone = np.float32(1) + tone.astype(np.float32)
    return cv2.merge([tone * np.float32(channel) for channel in color])


def spot(rng: np.random.Generator, paint: np.ndarray, at, axes, color) -> None:
    """Draw an ellipse of any orientation in place; ``at`` (x, y) and ``axes`` in texels."""
    at, axes = (tuple(int(value) for value in pair) for pair in (at, axes))
    color = tuple(float(value) for value in color)
    cv2.ellipse(paint, at, axes, rng.uniform(0, 180), 0, 360, color, -1, cv2.LINE_AA)


def finish(paint: np.ndarray) -> np.ndarray:
    """From float in [0, 1] to uint8."""
    return (np.clip(paint, 0, 1) * 255 + 0.5).astype(np.uint8)


def plaster(rng, shape, color) -> np.ndarray:
    """Plaster with stains of all sizes, fallen off in places over the bricks."""
    blotches = fractal(rng, shape, 90, 6, 0.75)
    grain = noise(rng, shape, 2.2)
    paint = tinted(color, 0.045 * blotches + 0.025 * grain)
    specks = soft_step(fractal(rng, shape, 14, 3), 2.1, 0.7)
    paint *= (1 - 0.35 * specks)[..., None]
    bare = soft_step(fractal(rng, shape, 150, 5), 2.75, 0.12)[..., None]
    if bare.any():
        rim = soft_step(cv2.GaussianBlur(bare, (0, 0), 3), 0.2, 0.3)[..., None]
        paint *= 1 - 0.25 * rim
        rows, columns = (np.flatnonzero(bare[..., 0].any(axis)) for axis in (1, 0))
        box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        bricks = brick(rng, bare[box].shape[:2], (0.52, 0.33, 0.26))
        paint[box] += bare[box] * (bricks - paint[box])
    return paint


def brick(rng, shape, color) -> np.ndarray:
    """Brick courses of 25 x 7.5 cm with lighter joints."""
    tone, edge, _ = courses(rng, shape, (0.078 * DENSITY, 0.25 * DENSITY), 0.15)
    paint = tinted(color, 0.16 * tone + 0.06 * fractal(rng, shape, 60, 5))
    joint = (1 - soft_step(edge, 0.8, 0.9))[..., None]
    return paint + joint * (np.float32((0.66, 0.63, 0.58)) - paint) * 0.75


def ashlar(rng, shape, color) -> np.ndarray:
    """Stone blocks of about 60 x 32 cm with dark joints."""
    tone, edge, _ = courses(rng, shape, (0.32 * DENSITY, 0.62 * DENSITY), 0.5)
    rough = fractal(rng, shape, 30, 5, 0.8)
    paint = tinted(color, 0.10 * tone + 0.07 * rough)
    return paint * (0.55 + 0.45 * soft_step(edge, 1.8, 2.0))[..., None]


def half_timber(rng, shape, color) -> np.ndarray:
    """Plaster panels between dark beams: posts, rails and braces."""
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
                ends = (xs[j + kind], xs[j + 1 - kind])
                lines.append(((ends[0], ys[i]), (ends[1], ys[i + 1])))
    for a, b in lines:
        a, b = (tuple(int(16 * value) for value in point) for point in (a, b))
        cv2.line(beams, a, b, 1.0, thick, cv2.LINE_AA, 4)
    wood = tinted((0.27, 0.19, 0.13), 0.2 * noise(rng, shape, (3, 40)) + 0.2 * noise(rng, shape, 6))
    shadow = cv2.GaussianBlur(beams, (0, 0), 4)[..., None]
    paint *= 1 - 0.3 * shadow
    return paint + beams[..., None] * (wood - paint)


MATERIALS = {"plaster": plaster, "brick": brick, "ashlar": ashlar, "half_timber": half_timber}


def roof_tiles(rng: np.random.Generator, width: float, height: float, color) -> np.ndarray:
    """Rows of clay tiles with moss, for a roof of ``width`` x ``height`` metres."""
    density = 64
    shape = (round(height * density), round(width * density))
    tone, edge, ramp = courses(rng, shape, (0.22 * density, 0.19 * density), 0.1)
    paint = tinted(color, 0.13 * tone + 0.08 * fractal(rng, shape, 60, 4))
    paint *= (0.6 + 0.45 * ramp)[..., None] * (0.75 + 0.25 * soft_step(edge, 1, 1))[..., None]
    moss = soft_step(fractal(rng, shape, 50, 5), 1.6, 0.8)[..., None] * 0.6
    return finish(paint + moss * (np.float32((0.30, 0.33, 0.20)) - paint))


def cobbles(
    rng: np.random.Generator, width: float, height: float, stone: tuple[float, float]
) -> np.ndarray:
    """Cobbled ground of stones of ``stone`` metres, with worn paths, puddle stains and litter."""
    density = 72
    shape = (round(height * density), round(width * density))
    tone, edge, _ = courses(rng, shape, (stone[0] * density, stone[1] * density), 0.8)
    paint = tinted((0.60, 0.575, 0.54), 0.13 * tone + 0.06 * fractal(rng, shape, 200, 7, 0.8))
    paint *= (0.5 + 0.5 * soft_step(edge, 1.2, 2.0))[..., None]
    paint *= (1 - 0.25 * soft_step(fractal(rng, shape, 130, 4), 1.4, 0.5))[..., None]
    for _ in range(int(width * height / 2)):  # litter and leaves
        at = rng.uniform((0, 0), shape[::-1])
        spot(rng, paint, at, rng.integers(2, 6, 2), rng.uniform(0.15, 0.75, 3) * (1, 0.9, 0.7))
    return finish(paint)


def trim(rng: np.random.Generator, color, streak: float = 1.0) -> np.ndarray:
    """One square metre of stone, wood or metal for ledges, beams and posts; it tiles."""
    shape = (FINE, FINE)
    tone = 0.06 * noise(rng, shape, (8, 8 * streak)) + 0.05 * noise(rng, shape, (3, 3 * streak))
    return finish(tinted(color, tone + 0.05 * fractal(rng, shape, 60, 3)))
