"""Painting of what fills and hangs on the walls: windows, doors, shop windows and signs.

As in :mod:`.textures`, but all with :data:`~.textures.FINE` texels per metre; sizes in metres.
"""

from __future__ import annotations

import cv2
import numpy as np

from .textures import FINE, finish, fractal, noise, spot, tinted


def glyphs(rng: np.random.Generator, paint: np.ndarray, color, lines: int = 1) -> None:
    """Write ``lines`` lines of random capitals over the whole of ``paint``, uint8, in place."""
    height, width = paint.shape[:2]
    for k in range(lines):
        font = int(rng.choice([cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_DUPLEX]))
        scale = height / lines / 22 * 0.55
        count = max(2, int(width / (21 * scale)))
        text = "".join(rng.choice(list("ABCDEFGHKLMNOPRSTUVWXZ&8 "), count))
        at = (int(width * 0.05), int(height * (k + 0.78) / lines))
        cv2.putText(paint, text, at, font, scale, color, max(1, round(scale * 2)), cv2.LINE_AA)


def sign(rng: np.random.Generator, width: float, height: float, lines: int = 1) -> np.ndarray:
    """A painted shop sign or poster with a border, shapes and random letters."""
    shape = (max(8, round(height * FINE)), max(8, round(width * FINE)))
    dark, light = rng.uniform(0.05, 0.4, 3), rng.uniform(0.65, 0.95, 3)
    back, front = (dark, light) if rng.random() < 0.5 else (light, dark)
    paint = finish(tinted(back, 0.05 * fractal(rng, shape, 40, 4)))
    front = tuple(255 * float(v) for v in front)
    if lines > 1:  # a poster: pictures between the lines
        for _ in range(rng.integers(3, 7)):
            at = rng.uniform((0, 0), shape[::-1])
            spot(rng, paint, at, rng.uniform(0.08, 0.35, 2) * min(shape), 255 * rng.random(3))
    glyphs(rng, paint, front, lines)
    border = max(1, round(0.03 * min(shape)))
    cv2.rectangle(paint, (0, 0), (shape[1] - 1, shape[0] - 1), front, border)
    return paint


def window(
    rng: np.random.Generator, width: float, height: float, panes: tuple[int, int], frame
) -> np.ndarray:
    """A window: reflections, curtains and things on the sill behind ``panes`` glazing."""
    shape = (round(height * FINE), round(width * FINE))
    y = np.linspace(0, 1, shape[0], dtype=np.float32)[:, None]
    x = np.linspace(0, 1, shape[1], dtype=np.float32)[None]
    paint = tinted((0.16, 0.19, 0.23), 0.5 * (1 - y) + 0.25 * fractal(rng, shape, 70, 4))
    drawn = rng.uniform(0.05, 0.5, 2)  # how far each curtain is drawn
    folds = 0.12 * np.sin(x * rng.uniform(25, 45) + 2 * noise(rng, shape, (300, 30)))
    cloth = tinted(rng.uniform(0.55, 0.85, 3), folds + 0.05 * noise(rng, shape, 8))
    hem = drawn[:, None, None] * (0.7 + 0.5 * y)
    curtain = (x < hem[0]) | (x > 1 - hem[1]) | (y < rng.uniform(0, 0.25))
    paint = np.where(curtain[..., None], 0.8 * cloth, paint)
    for _ in range(rng.integers(0, 4)):  # pots and books
        u, size = rng.uniform(0.1, 0.9) * shape[1], rng.uniform(0.06, 0.16) * shape[1]
        top = shape[0] * rng.uniform(0.6, 0.85)
        color = tuple(float(v) for v in rng.uniform(0.1, 0.8, 3))
        cv2.rectangle(paint, (int(u - size), int(top)), (int(u + size), shape[0]), color, -1)
    thick = max(2, round(0.05 * FINE))
    wood = tinted(frame, 0.08 * noise(rng, shape, 5))
    bars = np.zeros(shape, bool)
    for k in range(panes[0] + 1):
        at = round(k * (shape[1] - thick) / panes[0])
        bars[:, at : at + thick] = True
    for k in range(panes[1] + 1):
        at = round(k * (shape[0] - thick) / panes[1])
        bars[at : at + thick] = True
    shade = cv2.GaussianBlur(bars.astype(np.float32), (0, 0), 3)[..., None]
    return finish(np.where(bars[..., None], wood, paint * (1 - 0.5 * shade)))


def shop_window(rng: np.random.Generator, width: float, height: float, frame) -> np.ndarray:
    """A shop window: shelves with goods of all colours behind large panes."""
    paint = window(rng, width, height, (1, 1), frame).astype(np.float32) / 255
    margin, shelf = round(0.07 * FINE), round(0.42 * FINE)
    paint[margin:-margin, margin:-margin] *= 0.55
    for bottom in range(paint.shape[0] - margin, shelf, -shelf):
        u = margin + 4
        while u < paint.shape[1] - margin - 30:
            wide, tall = (int(v) for v in rng.uniform((9, 10), (34, shelf * 0.8)))
            goods = rng.uniform(0.1, 0.9, 3) * (1 + 0.12 * noise(rng, (tall, wide), 6))[..., None]
            paint[bottom - tall : bottom, u : u + wide] = goods
            u += wide + int(rng.integers(0, 14))
        paint[bottom - 3 : bottom + 3, margin:-margin] = 0.3
    return finish(paint)


def door(rng: np.random.Generator, width: float, height: float, color) -> np.ndarray:
    """A panelled wooden door, worn, with a fanlight and a handle."""
    shape = (round(height * FINE), round(width * FINE))
    paint = tinted(color, 0.10 * noise(rng, shape, (60, 4)) + 0.08 * fractal(rng, shape, 50, 4))
    rows, cols = int(rng.integers(2, 5)), 2 if width > 1 else 1
    top = round(0.16 * shape[0])
    for i in range(rows):
        for j in range(cols):
            y0 = top + round((i + 0.13) * (shape[0] - top) / rows)
            y1 = top + round((i + 0.87) * (shape[0] - top) / rows)
            x0, x1 = (round((j + f) * shape[1] / cols) for f in (0.14, 0.86))
            paint[y0:y1, x0:x1] *= 0.8
            cv2.rectangle(paint, (x0, y0), (x1, y1), [float(v) * 0.45 for v in color], 3)
            cv2.line(paint, (x0, y1), (x1, y1), [float(v) * 1.5 for v in color], 2)
    paint[6 : top - 4, 6:-6] = (0.14, 0.17, 0.2)
    paint[6 : top - 4, shape[1] // 2 - 3 : shape[1] // 2 + 3] = color
    at = (round(shape[1] * 0.46), round(shape[0] * 0.58))
    cv2.circle(paint, at, 6, (0.8, 0.7, 0.4), -1, cv2.LINE_AA)
    return finish(paint)
