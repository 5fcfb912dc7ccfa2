"""Houses: facades with recessed openings and mouldings, roofs and chimneys."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import fittings
from . import textures as paint
from .builder import DOWN, Builder, Frame
from .surface import Texture
from .walls import paint_wall

GROUND_FLOOR, FLOOR = 3.3, 2.85  # metres


@dataclass(frozen=True)
class House:
    """Where a house stands; ``design`` numbers its looks, so that neighbours can be alike.

    ``front`` is the line ``(x0, y0, x1, y1)`` of its facade from left to right as seen from the
    street; ``left`` and ``right`` are the bays of the side walls that a street shows.
    """

    design: int
    front: tuple[float, float, float, float]
    depth: float
    floors: int
    bays: int
    material: str
    gabled: bool = False
    left: int = 0
    right: int = 0


class Design:
    """What all the facades of one house, and of its twins, have in common."""

    def __init__(self, rng: np.random.Generator, material: str):
        palette = {
            "plaster": [(0.80, 0.71, 0.50), (0.74, 0.56, 0.45), (0.66, 0.71, 0.66)],
            "brick": [(0.56, 0.31, 0.24), (0.49, 0.33, 0.28)],
            "ashlar": [(0.63, 0.59, 0.50), (0.56, 0.55, 0.53)],
            "half_timber": [(0.86, 0.83, 0.75), (0.80, 0.74, 0.58)],
        }[material]
        frames = [(0.90, 0.90, 0.87), (0.34, 0.24, 0.16), (0.24, 0.34, 0.28), (0.45, 0.15, 0.13)]
        self.material = material
        self.color = tuple(np.array(palette[rng.integers(len(palette))]) * rng.uniform(0.9, 1.1))
        self.frame = frames[rng.integers(4)]
        self.stone = tuple(np.array((0.66, 0.62, 0.55)) * rng.uniform(0.85, 1.15))
        self.size = rng.uniform(0.9, 1.15), rng.uniform(1.4, 1.7)
        self.panes = int(rng.integers(2, 4)), int(rng.integers(2, 4))
        self.shutters = bool(rng.random() < 0.4)
        self.boxes = float(rng.choice([0, 0, 0.6]))  # share of windows with flower boxes
        self.ledge = rng.uniform(0.14, 0.26)
        self.roof = tuple(np.array((0.58, 0.30, 0.20)) * rng.uniform(0.75, 1.15, 3))
        self.pitch = rng.uniform(0.85, 1.15)
        self.door = tuple(rng.uniform(0.1, 0.45, 3))
        self.shop = bool(rng.random() < 0.6)


def add_house(builder: Builder, house: House, seed: int, number: int) -> None:
    """Add all surfaces and lamps of a house."""
    design = Design(np.random.default_rng([seed, 1, house.design]), house.material)
    rng = builder.rng = np.random.default_rng([seed, 2, number])
    p, q = np.array(house.front[:2]), np.array(house.front[2:])
    eaves = GROUND_FLOOR + FLOOR * (house.floors - 1) + 0.2
    front = Frame.upright(np.array([*p, eaves]), q - p)
    width, depth = float(np.linalg.norm(q - p)), house.depth
    front = Frame(front.point(0, 0, rng.uniform(-0.15, 0.15)), front.right, DOWN)
    right = Frame(front.point(width, 0), -front.out, DOWN)
    back = Frame(front.point(width, 0, -depth), -front.right, DOWN)
    left = Frame(front.point(0, 0, -depth), front.out, DOWN)
    across, along = (width, depth) if house.gabled else (depth, width)
    rise = across / 2 * design.pitch
    trim = Texture(paint.trim(rng, design.stone), paint.FINE)
    plain = Texture(paint.finish(paint.plaster(rng, (384, 384), design.color)), 64)
    brick = Texture(paint.finish(paint.brick(rng, (192, 192), (0.5, 0.3, 0.25))), 96)
    for frame, size, bays, pointed in (
        (front, width, house.bays, house.gabled),
        (right, depth, house.right, not house.gabled),
        (back, width, 0, house.gabled),
        (left, depth, house.left, not house.gabled),
    ):
        gable = rise if pointed else 0.0
        if bays:
            _facade(builder, design, frame, size, eaves, gable, bays, trim, frame is front)
        else:
            outline = [(0, 0), (size, 0), (size, eaves), (0, eaves), (size / 2, -gable)]
            builder.polygon(frame, outline[:1] + outline[4:] + outline[1:4], plain)
    _roof(builder, design, front if house.gabled else right, across, along, rise)
    for share in rng.uniform(0.15, 0.85, rng.integers(1, 3)):
        spot = front.point(share * width, 0, -depth * rng.uniform(0.3, 0.7))
        size = rng.uniform(0.5, 0.8, 2)
        builder.block(spot[:2], size, eaves, eaves + rise + 0.9, brick)


def _roof(builder: Builder, design: Design, gable: Frame, across, along, rise) -> None:
    """Two slopes over a gable wall of ``across`` metres, ``along`` metres deep."""
    rng = builder.rng
    tiles = Texture(paint.roof_tiles(rng, along + 0.6, 6.0, design.roof), 64)
    wood = Texture(paint.trim(rng, (0.3, 0.22, 0.16), 4), paint.FINE)
    length = np.hypot(across / 2, rise) * (1 + 0.9 / across)
    outline = [(0, 0), (along + 0.6, 0), (along + 0.6, length), (0, length)]
    far, near = gable.point(across / 2, -rise, -along - 0.3), gable.point(across / 2, -rise, 0.3)
    for corner, other, direction, side in (
        (far, near, gable.out, -gable.right),
        (near, far, -gable.out, gable.right),
    ):
        down = side * across / 2 + DOWN * rise
        down /= np.linalg.norm(down)
        lift = np.array([0, 0, 0.12])
        builder.polygon(Frame(corner + lift, direction, down), outline, tiles)
        builder.polygon(Frame(other, -direction, down), outline, wood)  # seen from below


def _facade(builder, design, frame, width, eaves, gable, bays, trim, is_front) -> None:
    """One wall that a street shows, with all that is on it."""
    rng = builder.rng
    top = Frame(frame.point(0, -gable), frame.right, DOWN)
    height = eaves + gable
    outline = [(0, gable), (width, gable), (width, height), (0, height)]
    if gable:
        outline.insert(1, (width / 2, 0))
    openings = _layout(rng, design, width, eaves, gable, bays, is_front)
    spans = [span for _, span in openings]
    wall = paint_wall(rng, (width, height), design.material, design.color, spans, design.stone)
    builder.polygon(top, outline, Texture(wall, paint.DENSITY), spans)
    for kind, span in openings:
        _opening(builder, design, top, kind, span, trim)
    for level in range(1, round((eaves - GROUND_FLOOR) / FLOOR) + 1):  # a ledge below each floor
        v = height - GROUND_FLOOR - FLOOR * (level - 1)
        builder.box(top, (0, v - 0.1, width, v + 0.06), (0, design.ledge / 2), trim)
    builder.box(top, (0, gable, width, gable + 0.14), (0, design.ledge), trim)
    builder.box(top, (0, gable + 0.14, width, gable + 0.24), (0, design.ledge / 2), trim)
    pipe = Texture(paint.trim(rng, (0.38, 0.40, 0.38)), paint.FINE)
    builder.box(top, (width - 0.22, gable + 0.24, width - 0.12, height), (0.03, 0.13), pipe)
    if is_front:
        _dress(builder, design, top, width, height, openings, trim)


def _layout(rng, design, width, eaves, gable, bays, is_front):
    """Kinds and spans of the openings, the ground floor last."""
    openings = []
    height = eaves + gable
    wide, tall = design.size
    centers = (np.arange(bays) + 0.5) * width / bays
    if gable > 2.6:
        v = gable - 0.55
        openings.append(("window", (width / 2 - 0.4, v - 1.1, width / 2 + 0.4, v)))
    for level in range(round((eaves - GROUND_FLOOR) / FLOOR), 0, -1):
        sill = height - GROUND_FLOOR - FLOOR * (level - 1) - 0.75
        for u in centers:
            openings.append(("window", (u - wide / 2, sill - tall, u + wide / 2, sill)))
    entrance = rng.integers(bays) if is_front else -1
    for k, u in enumerate(centers):
        if k == entrance:
            half = min(0.45 * width / bays, rng.uniform(0.55, 0.75))
            openings.append(("door", (u - half, height - 2.5, u + half, height - 0.02)))
        elif is_front and design.shop:
            half = min(0.42 * width / bays, 1.2)
            openings.append(("shop", (u - half, height - 2.55, u + half, height - 0.6)))
        else:
            sill = height - 1.0
            openings.append(("window", (u - wide / 2, sill - tall, u + wide / 2, sill)))
    return openings


def _opening(builder, design, frame, kind, span, trim) -> None:
    """What fills a hole in the wall and hangs around it."""
    rng = builder.rng
    u0, v0, u1, v1 = span
    width, height = u1 - u0, v1 - v0
    glow = 0.0
    if kind == "door":
        deep, filling = 0.30, fittings.door(rng, width, height, design.door)
    elif kind == "shop":
        deep, filling = 0.22, fittings.shop_window(rng, width, height, design.frame)
        if rng.random() < 0.35:
            glow = rng.uniform(1.0, 2.0)
            builder.lamps.append((*frame.point((u0 + u1) / 2, v1 - 0.8, 0.35), 0.5))
    else:
        deep, filling = 0.20, fittings.window(rng, width, height, design.panes, design.frame)
        if rng.random() < 0.12:
            glow = rng.uniform(0.7, 1.6)
    builder.recess(frame, span, deep, trim)
    builder.rectangle(
        frame.point(u0, v0, -deep),
        frame.right,
        DOWN,
        (width, height),
        Texture(filling, paint.FINE),
        glow=glow,
    )
    if kind == "door":
        builder.box(frame, (u0 - 0.15, v1 - 0.14, u1 + 0.15, v1 + 0.02), (0, 0.35), trim)
        return
    builder.box(frame, (u0 - 0.12, v1, u1 + 0.12, v1 + 0.09), (0, 0.16), trim)
    if kind == "shop":
        return
    builder.box(frame, (u0 - 0.13, v0 - 0.2, u1 + 0.13, v0 - 0.1), (0, 0.09), trim)
    if design.shutters:
        board = Texture(fittings.door(rng, width / 2, height, design.door), paint.FINE)
        for left in (u0 - width / 2 - 0.02, u1 + 0.02):
            builder.box(frame, (left, v0, left + width / 2, v1), (0.02, 0.06), trim, board)
    if rng.random() < design.boxes:
        shape = (round(0.35 * paint.FINE), round(width * paint.FINE))
        flowers = paint.tinted((0.22, 0.30, 0.14), 0.3 * paint.fractal(rng, shape, 12, 3))
        for _ in range(int(45 * width)):
            at, color = rng.uniform((0, 0), shape[::-1]), rng.uniform(0.3, 1, 3) * (1, 0.5, 0.7)
            paint.spot(rng, flowers, at, rng.integers(2, 6, 2), color)
        flowers = Texture(paint.finish(flowers), paint.FINE)
        builder.box(frame, (u0, v1 - 0.26, u1, v1 + 0.09), (0.16, 0.36), flowers, flowers)


def _dress(builder, design, frame, width, height, openings, trim) -> None:
    """Signs, a lantern or a balcony on a front."""
    rng = builder.rng
    shops = [span for kind, span in openings if kind == "shop"]
    for u0, v0, u1, _ in shops:
        board = Texture(fittings.sign(rng, u1 - u0, 0.42), paint.FINE)
        builder.box(frame, (u0, v0 - 0.52, u1, v0 - 0.10), (0, 0.07), trim, board)
    if rng.random() < 0.6:  # a sign that hangs over the street
        u = rng.uniform(0.15, 0.85) * width
        side = Frame(frame.point(u, height - 3.9, 0.25), frame.out, DOWN)
        board = Texture(fittings.sign(rng, 0.8, 0.6, int(rng.integers(1, 3))), paint.FINE)
        iron = Texture(paint.trim(rng, (0.12, 0.12, 0.13)), paint.FINE)
        builder.box(side, (0, 0, 0.8, 0.6), (-0.03, 0.03), iron, board)
        back = side.point(0.8, 0, -0.035)
        builder.rectangle(back, -side.right, DOWN, (0.8, 0.6), board)
        builder.box(frame, (u - 0.02, height - 3.98, u + 0.02, height - 3.93), (0, 1.05), iron)
    upper = [span for kind, span in openings if kind == "window" and span[3] < height - 3.5]
    if upper and not design.shutters and rng.random() < 0.5:
        u0, _, u1, v1 = upper[rng.integers(len(upper))]
        _balcony(builder, frame, (u0 - 0.5, v1 + 0.09, u1 + 0.5), trim)


def _balcony(builder, frame, place, trim) -> None:
    """A slab with an iron railing before a window."""
    u0, v, u1 = place
    iron = Texture(paint.trim(builder.rng, (0.10, 0.11, 0.12)), paint.FINE)
    builder.box(frame, (u0, v, u1, v + 0.14), (0, 0.85), trim)
    builder.box(frame, (u0, v - 0.85, u1, v - 0.79), (0.76, 0.82), iron)
    for u in np.linspace(u0, u1 - 0.03, 14):
        builder.box(frame, (u, v - 0.82, u + 0.03, v), (0.775, 0.805), iron)
