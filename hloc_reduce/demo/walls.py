"""Painting of one whole facade: the wall material and what years have left on it."""

from __future__ import annotations

import cv2
import numpy as np

from .fittings import sign
from .textures import DENSITY, MATERIALS, Opening, finish, fractal, noise, soft_step, spot, tinted


def paint_wall(
    rng: np.random.Generator,
    size: tuple[float, float],
    material: str,
    color: tuple[float, float, float],
    openings: list[Opening],
    frame: tuple[float, float, float],
) -> np.ndarray:
    """Paint a facade.

    Args:
        rng: the generator of this wall.
        size: width and height in metres; the lower edge stands on the ground.
        material: a key of :data:`~.textures.MATERIALS`.
        color: of the material, RGB in [0, 1].
        openings: the windows and doors, which get surrounds, and stains below them.
        frame: colour of the surrounds.

    Returns:
        The texture, uint8 (H, W, 3).
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
    return finish(paint * _occlusion(shape)[..., None])


def _occlusion(shape: tuple[int, int]) -> np.ndarray:
    """Less light from the sky near the ground and beneath the eaves."""
    down = (np.arange(shape[0], dtype=np.float32) + 0.5) / DENSITY
    up = shape[0] / DENSITY - down
    shade = (1 - 0.35 * np.exp(-up / 0.45)) * (1 - 0.35 * np.exp(-down / 0.4))
    return np.broadcast_to(shade[:, None], shape)


def _surround(rng, paint: np.ndarray, opening: Opening, frame) -> None:
    """A dressed stone frame around an opening, with its shadow line."""
    u0, v0, u1, v1 = (round(value * DENSITY) for value in opening)
    wide = round(0.13 * DENSITY)
    top, left = max(v0 - wide, 0), max(u0 - wide, 0)
    part = paint[top : v1 + wide // 2, left : u1 + wide]
    part[:] = tinted(frame, 0.05 * fractal(rng, part.shape[:2], 24, 4))
    for v in range(top, v1, round(0.3 * DENSITY)):  # joints between its stones
        paint[v : v + 1, left : u1 + wide] *= 0.75
    cv2.rectangle(
        paint,
        (left - 1, top - 1),
        (u1 + wide, v1 + wide // 2),
        tuple(float(value) * 0.5 for value in frame),
        1,
    )


def _plinth(rng, paint: np.ndarray) -> None:
    """A dirtier, splashed band along the ground."""
    height = round(rng.uniform(0.4, 0.9) * DENSITY)
    dirt = fractal(rng, (height, paint.shape[1]), 40, 5)
    paint[-height:] *= (0.78 + 0.07 * dirt)[..., None]
    paint[-height : -height + 2] *= 0.7


def _cracks(rng, paint: np.ndarray, count: int) -> None:
    """Random walks downwards, thin and dark."""
    for _ in range(count):
        steps = rng.normal((0, 7), (9, 6), (int(rng.integers(15, 60)), 2))
        path = np.cumsum(steps, 0) + rng.uniform((0, 0), paint.shape[1::-1])
        cv2.polylines(paint, [np.int32(path * 16)], False, (0.2, 0.17, 0.15), 1, cv2.LINE_AA, 4)


def _streaks(rng, paint: np.ndarray, openings: list[Opening]) -> None:
    """Rain streaks: everywhere faintly, stronger below the sills."""
    shape = paint.shape[:2]
    streaks = noise(rng, shape, (2.2 * DENSITY, 0.07 * DENSITY))
    strength = np.full(shape, 0.035, np.float32)
    for u0, _, u1, v1 in openings:
        a, b, v = (round(value * DENSITY) for value in (u0, u1, v1))
        below = strength[v : v + round(1.2 * DENSITY), a:b]
        below += 0.12 * np.exp(-np.arange(len(below), dtype=np.float32) / 45)[:, None]
    paint *= (1 - strength * np.clip(streaks + 0.6, 0, 3))[..., None]


def _posters(rng, paint: np.ndarray, at: float) -> None:
    """Posters glued side by side or over each other."""
    for k in range(rng.integers(1, 4)):
        width, height = rng.uniform((0.45, 0.6), (0.7, 1.0))
        poster = sign(rng, width, height, 3)
        poster = cv2.resize(poster, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
        u = round((at + 0.5 * k) * DENSITY)
        v = paint.shape[0] - round(rng.uniform(1.7, 2.2) * DENSITY)
        part = paint[v : v + poster.shape[0], u : u + poster.shape[1]]
        worn = 1 - soft_step(fractal(rng, part.shape[:2], 20, 4), 1.7, 0.4)[..., None]
        part += worn * (poster[: part.shape[0], : part.shape[1]] / np.float32(255) - part)


def _graffiti(rng, paint: np.ndarray) -> None:
    """A tag of thick loops at the height of an arm."""
    color = tuple(float(v) for v in rng.uniform(0.05, 0.7, 3))
    height, width = paint.shape[:2]
    start = np.array([rng.uniform(0.05, 0.75) * width, height - rng.uniform(0.8, 1.6) * DENSITY])
    t = np.linspace(0, 1, 120)[:, None]
    phases, speeds = rng.uniform(0, 6.28, (4, 2)), rng.uniform(4, 26, (4, 2))
    loops = sum(np.sin(speeds[k] * t + phases[k]) for k in range(4)) * (9, 14)
    path = start + loops + t * (rng.uniform(60, 140), 0)
    width = int(rng.integers(3, 7))
    cv2.polylines(paint, [np.int32(path * 16)], False, color, width, cv2.LINE_AA, 4)


def _ivy(rng, paint: np.ndarray) -> None:
    """A patch of ivy growing from the ground, leaf by leaf."""
    height, width = paint.shape[:2]
    root, reach = rng.uniform(0, width), rng.uniform(0.25, 0.7) * height
    for _ in range(int(reach * 4)):
        up = reach * rng.beta(1, 1.6)
        at = root + rng.normal(0, 12 + 0.16 * up), height - up
        green = np.array((0.20, 0.32, 0.11)) * rng.uniform(0.45, 1.5)
        spot(rng, paint, at, rng.integers(3, 8, 2), green)
