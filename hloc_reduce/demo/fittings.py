"""Painting of windows, doors, shop windows and signs.

All sizes are metres, all textures have `textures.FINE` texels per metre.
"""

import cv2
import numpy as np

from .surface import Color, Texture
from .textures import FINE, Rng, Shape, as_scalar, finish, fractal, noise, spot, tinted


def _shape(width: float, height: float) -> Shape:
    return round(height * FINE), round(width * FINE)


def sign(rng: Rng, width: float, height: float, lines: int = 1) -> Texture:
    """Paint a shop sign, or a poster if it has several lines of random letters."""
    shape = _shape(width, height)
    dark, light = rng.uniform(0.05, 0.4, 3), rng.uniform(0.65, 0.95, 3)
    back, front = (dark, light) if rng.random() < 0.5 else (light, dark)
    paint = finish(tinted(back, 0.05 * fractal(rng, shape, 40, 4)))
    color = as_scalar(front, 255)
    if lines > 1:  # pictures between the lines
        for _ in range(rng.integers(3, 7)):
            at = rng.uniform((0, 0), shape[::-1])
            spot(rng, paint, at, rng.uniform(0.08, 0.35, 2) * min(shape), 255 * rng.random(3))
    scale = shape[0] / lines / 22 * 0.55
    thickness = max(1, round(scale * 2))
    for k in range(lines):
        font = int(rng.choice([cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_DUPLEX]))
        count = max(2, int(shape[1] / (21 * scale)))
        text = "".join(rng.choice(list("ABCDEFGHKLMNOPRSTUVWXZ&8 "), count))
        corner = (int(shape[1] * 0.05), int(shape[0] * (k + 0.78) / lines))
        cv2.putText(paint, text, corner, font, scale, color, thickness, cv2.LINE_AA)
    border = max(1, round(0.03 * min(shape)))
    cv2.rectangle(paint, (0, 0), (shape[1] - 1, shape[0] - 1), color, border)
    return Texture(paint, FINE)


def window(
    rng: Rng, width: float, height: float, panes: tuple[int, int], frame: Color
) -> np.ndarray:
    """Paint a window: reflections, curtains and things on the sill behind `panes` panes."""
    shape = _shape(width, height)
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
        color = as_scalar(rng.uniform(0.1, 0.8, 3))
        cv2.rectangle(paint, (int(u - size), int(top)), (int(u + size), shape[0]), color, -1)
    thick = max(2, round(0.05 * FINE))
    wood = tinted(frame, 0.08 * noise(rng, shape, 5))
    bars = np.zeros(shape, bool)
    for axis, count in ((1, panes[0]), (0, panes[1])):
        for k in range(count + 1):
            at = round(k * (shape[axis] - thick) / count)
            np.moveaxis(bars, axis, 0)[at : at + thick] = True
    shade = cv2.GaussianBlur(bars.astype(np.float32), (0, 0), 3)[..., None]
    return np.where(bars[..., None], wood, paint * (1 - 0.5 * shade))


def shop_window(rng: Rng, width: float, height: float, frame: Color) -> np.ndarray:
    """Paint a shop window: shelves with goods of all colours behind a large pane."""
    paint = finish(window(rng, width, height, (1, 1), frame)).astype(np.float32) / 255
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
    return paint


def door(rng: Rng, width: float, height: float, color: Color) -> np.ndarray:
    """Paint a panelled wooden door, worn, with a fanlight and a handle."""
    shape = _shape(width, height)
    paint = tinted(color, 0.10 * noise(rng, shape, (60, 4)) + 0.08 * fractal(rng, shape, 50, 4))
    rows, cols = int(rng.integers(2, 5)), 2 if width > 1 else 1
    top = round(0.16 * shape[0])
    for i in range(rows):
        for j in range(cols):
            y0, y1 = (top + round((i + f) * (shape[0] - top) / rows) for f in (0.13, 0.87))
            x0, x1 = (round((j + f) * shape[1] / cols) for f in (0.14, 0.86))
            paint[y0:y1, x0:x1] *= 0.8
            cv2.rectangle(paint, (x0, y0), (x1, y1), as_scalar(color, 0.45), 3)
            cv2.line(paint, (x0, y1), (x1, y1), as_scalar(color, 1.5), 2)
    paint[6 : top - 4, 6:-6] = (0.14, 0.17, 0.2)
    paint[6 : top - 4, shape[1] // 2 - 3 : shape[1] // 2 + 3] = color
    at = (round(shape[1] * 0.46), round(shape[0] * 0.58))
    cv2.circle(paint, at, 6, (0.8, 0.7, 0.4), -1, cv2.LINE_AA)
    return paint
