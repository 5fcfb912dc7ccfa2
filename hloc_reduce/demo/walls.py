"""Painting of one whole facade: the wall material and its weathering."""

from collections.abc import Sequence

import cv2
import numpy as np

from .fittings import sign
from .surface import Color, Span, Texture, Vector
from .textures import (
    DENSITY,
    MATERIALS,
    Rng,
    as_scalar,
    finish,
    fractal,
    mixed,
    noise,
    soft_step,
    spot,
    tinted,
)


def paint_wall(
    rng: Rng, size: Vector, material: str, color: Color, openings: Sequence[Span], frame: Color
) -> Texture:
    """Paint a facade.

    Args:
        rng: the generator of this wall.
        size: width and height in metres; the lower edge stands on the ground.
        material: a key of `textures.MATERIALS`.
        color: of the material.
        openings: windows and doors, the ground floor last.
        frame: colour of the surrounds.
    """
    shape = (round(size[1] * DENSITY), round(size[0] * DENSITY))
    paint = MATERIALS[material](rng, shape, color)
    for opening in openings:
        _surround(rng, paint, opening, frame)
    _plinth(rng, paint)
    _cracks(rng, paint, int(rng.integers(1, 4)))
    _streaks(rng, paint, openings)
    free = [(u, u + 0.9) for u in np.arange(0.2, size[0] - 1, 0.3)]
    free = [s for s in free if all(s[1] < o[0] - 0.2 or s[0] > o[2] + 0.2 for o in openings[-4:])]
    if free and rng.random() < 0.6:
        _posters(rng, paint, free[rng.integers(len(free))][0])
    if rng.random() < 0.35:
        _graffiti(rng, paint)
    if rng.random() < 0.35:
        _ivy(rng, paint)
    return Texture(finish(paint * _occlusion(shape[0])[:, None, None]), DENSITY)


def _occlusion(rows: int) -> np.ndarray:
    """Return the share of light from the sky in each row: less near the ground and the eaves."""
    down = (np.arange(rows, dtype=np.float32) + 0.5) / DENSITY
    up = rows / DENSITY - down
    return (1 - 0.35 * np.exp(-up / 0.45)) * (1 - 0.35 * np.exp(-down / 0.4))


def _surround(rng: Rng, paint: np.ndarray, opening: Span, frame: Color) -> None:
    """Paint a dressed stone frame around an opening, with its shadow line."""
    u0, v0, u1, v1 = (round(value * DENSITY) for value in opening)
    wide = round(0.13 * DENSITY)
    top, left, right, bottom = max(v0 - wide, 0), max(u0 - wide, 0), u1 + wide, v1 + wide // 2
    part = paint[top:bottom, left:right]
    part[:] = tinted(frame, 0.05 * fractal(rng, part.shape[:2], 24, 4))
    for v in range(top, v1, round(0.3 * DENSITY)):  # joints between its stones
        paint[v : v + 1, left:right] *= 0.75
    cv2.rectangle(paint, (left - 1, top - 1), (right, bottom), as_scalar(frame, 0.5), 1)


def _plinth(rng: Rng, paint: np.ndarray) -> None:
    """Paint a dirtier, splashed band along the ground."""
    height = round(rng.uniform(0.4, 0.9) * DENSITY)
    dirt = fractal(rng, (height, paint.shape[1]), 40, 5)
    paint[-height:] *= (0.78 + 0.07 * dirt)[..., None]
    paint[-height : -height + 2] *= 0.7


def _cracks(rng: Rng, paint: np.ndarray, count: int) -> None:
    """Paint cracks: random walks downwards, thin and dark."""
    for _ in range(count):
        steps = rng.normal((0, 7), (9, 6), (int(rng.integers(15, 60)), 2))
        path = np.cumsum(steps, 0) + rng.uniform((0, 0), paint.shape[1::-1])
        _draw(paint, path, (0.2, 0.17, 0.15), 1)


def _streaks(rng: Rng, paint: np.ndarray, openings: Sequence[Span]) -> None:
    """Paint rain streaks: everywhere faintly, stronger below the sills."""
    shape = paint.shape[:2]
    streaks = noise(rng, shape, (2.2 * DENSITY, 0.07 * DENSITY))
    strength = np.full(shape, 0.035, np.float32)
    for u0, _, u1, v1 in openings:
        a, b, v = (round(value * DENSITY) for value in (u0, u1, v1))
        below = strength[v : v + round(1.2 * DENSITY), a:b]
        below += 0.12 * np.exp(-np.arange(len(below), dtype=np.float32) / 45)[:, None]
    paint *= (1 - strength * np.clip(streaks + 0.6, 0, 3))[..., None]


def _posters(rng: Rng, paint: np.ndarray, at: float) -> None:
    """Glue posters side by side or over each other."""
    for k in range(rng.integers(1, 4)):
        width, height = rng.uniform((0.45, 0.6), (0.7, 1.0))
        poster = sign(rng, width, height, 3).levels[0]
        poster = cv2.resize(poster, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
        u = round((at + 0.5 * k) * DENSITY)
        v = paint.shape[0] - round(rng.uniform(1.7, 2.2) * DENSITY)
        part = paint[v : v + poster.shape[0], u : u + poster.shape[1]]
        glued = 1 - soft_step(fractal(rng, part.shape[:2], 20, 4), 1.7, 0.4)
        part[:] = mixed(part, poster[: part.shape[0], : part.shape[1]] / np.float32(255), glued)


def _graffiti(rng: Rng, paint: np.ndarray) -> None:
    """Spray a tag of thick loops at the height of an arm."""
    color = rng.uniform(0.05, 0.7, 3)
    height, width = paint.shape[:2]
    start = np.array([rng.uniform(0.05, 0.75) * width, height - rng.uniform(0.8, 1.6) * DENSITY])
    t = np.linspace(0, 1, 120)[:, None]
    phases, speeds = rng.uniform(0, 6.28, (4, 2)), rng.uniform(4, 26, (4, 2))
    loops = sum(np.sin(speeds[k] * t + phases[k]) for k in range(4)) * (9, 14)
    path = start + loops + t * (rng.uniform(60, 140), 0)
    _draw(paint, path, color, int(rng.integers(3, 7)))


def _draw(paint: np.ndarray, path: np.ndarray, color: Color, thickness: int) -> None:
    """Draw an open path (n, 2) x, y in texels, with sixteenths of them."""
    points = (path * 16).astype(np.int32)
    cv2.polylines(paint, [points], False, as_scalar(color), thickness, cv2.LINE_AA, 4)


def _ivy(rng: Rng, paint: np.ndarray) -> None:
    """Paint a patch of ivy that grows from the ground, leaf by leaf."""
    height, width = paint.shape[:2]
    root, reach = rng.uniform(0, width), rng.uniform(0.25, 0.7) * height
    for _ in range(int(reach * 4)):
        up = reach * rng.beta(1, 1.6)
        at = root + rng.normal(0, 12 + 0.16 * up), height - up
        green = np.array((0.20, 0.32, 0.11)) * rng.uniform(0.45, 1.5)
        spot(rng, paint, at, rng.integers(3, 8, 2), green)
