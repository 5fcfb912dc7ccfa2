"""Houses: facades with recessed openings and mouldings, roofs and chimneys."""

from dataclasses import dataclass

import numpy as np

from . import fittings
from . import textures as paint
from .builder import DOWN, Builder, Frame
from .surface import Span, Texture, Vector
from .walls import paint_wall

GROUND_FLOOR, FLOOR = 3.3, 2.85  # metres


@dataclass(frozen=True)
class House:
    """Place and shape of a house, in metres."""

    design: int  # seeds its look; houses of one design are alike
    front: tuple[float, float, float, float]  # x0, y0, x1, y1, left to right as seen by the street
    depth: float
    floors: int
    bays: int  # columns of openings of the front
    material: str  # a key of `textures.MATERIALS`
    gabled: bool = False  # the gable is in front
    left: int = 0  # bays of the left side wall; 0 if no street shows it
    right: int = 0


class Design:
    """The look that all facades of a house, and of its twins, share."""

    def __init__(self, rng: np.random.Generator, material: str):
        palette = {
            "plaster": [(0.80, 0.71, 0.50), (0.74, 0.56, 0.45), (0.66, 0.71, 0.66)],
            "brick": [(0.56, 0.31, 0.24), (0.49, 0.33, 0.28)],
            "ashlar": [(0.63, 0.59, 0.50), (0.56, 0.55, 0.53)],
            "half_timber": [(0.86, 0.83, 0.75), (0.80, 0.74, 0.58)],
        }[material]
        frames = [(0.90, 0.90, 0.87), (0.34, 0.24, 0.16), (0.24, 0.34, 0.28), (0.45, 0.15, 0.13)]
        self.material = material
        self.color = np.array(palette[rng.integers(len(palette))]) * rng.uniform(0.9, 1.1)
        self.frame = frames[rng.integers(4)]
        self.stone = np.array((0.66, 0.62, 0.55)) * rng.uniform(0.85, 1.15)
        self.size = rng.uniform(0.9, 1.15), rng.uniform(1.4, 1.7)  # of windows
        self.panes = int(rng.integers(2, 4)), int(rng.integers(2, 4))
        self.shutters = bool(rng.random() < 0.4)
        self.boxes = float(rng.choice([0, 0, 0.6]))  # share of windows with flower boxes
        self.ledge = rng.uniform(0.14, 0.26)
        self.roof = np.array((0.58, 0.30, 0.20)) * rng.uniform(0.75, 1.15, 3)
        self.pitch = rng.uniform(0.85, 1.15)
        self.door = rng.uniform(0.1, 0.45, 3)
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
    trim = paint.trim(rng, design.stone)
    plain = paint.texture(paint.plaster(rng, (384, 384), design.color), 64)
    brick = paint.texture(paint.brick(rng, (192, 192), (0.5, 0.3, 0.25)), 96)
    for frame, size, bays, pointed in (
        (front, width, house.bays, house.gabled),
        (right, depth, house.right, not house.gabled),
        (back, width, 0, house.gabled),
        (left, depth, house.left, not house.gabled),
    ):
        gable = rise if pointed else 0.0
        if bays:
            corner = Frame(frame.point(0, -gable), frame.right, DOWN)
            facade = _Facade(builder, design, trim, corner, size, eaves + gable, gable)
            facade.add(bays, house.floors - 1, frame is front)
        else:
            outline = [(0, 0), (size / 2, -gable), (size, 0), (size, eaves), (0, eaves)]
            builder.polygon(frame, outline, plain)
    _roof(builder, design, front if house.gabled else right, across, along, rise)
    for share in rng.uniform(0.15, 0.85, rng.integers(1, 3)):
        spot = front.point(share * width, 0, -depth * rng.uniform(0.3, 0.7))
        builder.block(spot[:2], rng.uniform(0.5, 0.8, 2), (eaves, eaves + rise + 0.9), brick)


def _roof(
    builder: Builder, design: Design, gable: Frame, across: float, along: float, rise: float
) -> None:
    """Add two slopes over a gable wall of `across` metres, `along` metres deep."""
    rng = builder.rng
    tiles = paint.roof_tiles(rng, along + 0.6, 6.0, design.roof)
    wood = paint.trim(rng, (0.3, 0.22, 0.16), 4)
    size = along + 0.6, np.hypot(across / 2, rise) * (1 + 0.9 / across)
    far, near = gable.point(across / 2, -rise, -along - 0.3), gable.point(across / 2, -rise, 0.3)
    for corner, other, direction, side in (
        (far, near, gable.out, -gable.right),
        (near, far, -gable.out, gable.right),
    ):
        down = side * across / 2 + DOWN * rise
        down /= np.linalg.norm(down)
        builder.rectangle(Frame(corner + (0, 0, 0.12), direction, down), size, tiles)
        builder.rectangle(Frame(other, -direction, down), size, wood)  # seen from below


@dataclass
class _Facade:
    """A wall that a street shows, with its openings, mouldings, signs and balconies."""

    builder: Builder
    design: Design
    trim: Texture  # of the mouldings
    frame: Frame  # of the wall, with the top of the gable at v = 0
    width: float
    height: float  # with the gable
    gable: float  # height above the eaves

    @property
    def rng(self) -> np.random.Generator:
        return self.builder.rng

    def add(self, bays: int, upper_floors: int, is_front: bool) -> None:
        """Add all surfaces and lamps."""
        design, width, height, gable = self.design, self.width, self.height, self.gable
        floors = [height - GROUND_FLOOR - FLOOR * k for k in range(upper_floors)]
        outline = [(0, gable), (width, gable), (width, height), (0, height)]
        if gable:
            outline.insert(1, (width / 2, 0))
        openings = self._layout(bays, floors, is_front)
        spans = [span for _, span in openings]
        size = (width, height)
        wall = paint_wall(self.rng, size, design.material, design.color, spans, design.stone)
        self.builder.polygon(self.frame, outline, wall, spans)
        for kind, span in openings:
            self._opening(kind, span)
        for v in floors:  # a ledge below each
            self._box((0, v - 0.1, width, v + 0.06), (0, design.ledge / 2))
        self._box((0, gable, width, gable + 0.14), (0, design.ledge))
        self._box((0, gable + 0.14, width, gable + 0.24), (0, design.ledge / 2))
        pipe = paint.trim(self.rng, (0.38, 0.40, 0.38))
        self._box((width - 0.22, gable + 0.24, width - 0.12, height), (0.03, 0.13), pipe)
        if is_front:
            self._dress(openings)

    def _box(self, span: Span, depth: Vector, texture: Texture | None = None) -> None:
        self.builder.box(self.frame, span, depth, texture or self.trim)

    def _layout(self, bays: int, floors: list[float], is_front: bool) -> list[tuple[str, Span]]:
        """Return kinds and spans of the openings, from the top to the ground floor."""
        rng, design, width, height = self.rng, self.design, self.width, self.height
        openings: list[tuple[str, Span]] = []
        wide, tall = design.size[0] / 2, design.size[1]
        centers = (np.arange(bays) + 0.5) * width / bays
        if self.gable > 2.6:
            v = self.gable - 0.55
            openings.append(("window", (width / 2 - 0.4, v - 1.1, width / 2 + 0.4, v)))
        for floor in reversed(floors):
            sill = floor - 0.75
            openings += [("window", (u - wide, sill - tall, u + wide, sill)) for u in centers]
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
                openings.append(("window", (u - wide, sill - tall, u + wide, sill)))
        return openings

    def _opening(self, kind: str, span: Span) -> None:
        """Fill a hole in the wall, and add its mouldings, shutters and flowers."""
        rng, design = self.rng, self.design
        u0, v0, u1, v1 = span
        width, height = u1 - u0, v1 - v0
        glow = 0.0
        if kind == "door":
            deep, filling = 0.30, fittings.door(rng, width, height, design.door)
        elif kind == "shop":
            deep, filling = 0.22, fittings.shop_window(rng, width, height, design.frame)
            if rng.random() < 0.35:
                glow = rng.uniform(1.0, 2.0)
                lamp = self.frame.point((u0 + u1) / 2, v1 - 0.8, 0.35)
                self.builder.lamps.append((*lamp, 0.5))
        else:
            deep, filling = 0.20, fittings.window(rng, width, height, design.panes, design.frame)
            if rng.random() < 0.12:
                glow = rng.uniform(0.7, 1.6)
        self.builder.recess(self.frame, span, deep, self.trim)
        frame = Frame(self.frame.point(u0, v0, -deep), self.frame.right, DOWN)
        self.builder.rectangle(frame, (width, height), paint.texture(filling, glow=glow))
        if kind == "door":
            self._box((u0 - 0.15, v1 - 0.14, u1 + 0.15, v1 + 0.02), (0, 0.35))  # a step
            return
        self._box((u0 - 0.12, v1, u1 + 0.12, v1 + 0.09), (0, 0.16))
        if kind == "window":
            self._box((u0 - 0.13, v0 - 0.2, u1 + 0.13, v0 - 0.1), (0, 0.09))
            self._decorate(span)

    def _decorate(self, window: Span) -> None:
        """Add shutters and a flower box to a window."""
        rng, design = self.rng, self.design
        u0, v0, u1, v1 = window
        width = u1 - u0
        if design.shutters:
            board = paint.texture(fittings.door(rng, width / 2, v1 - v0, design.door))
            for left in (u0 - width / 2 - 0.02, u1 + 0.02):
                shutter = (left, v0, left + width / 2, v1)
                self.builder.box(self.frame, shutter, (0.02, 0.06), self.trim, board)
        if rng.random() < design.boxes:
            shape = (round(0.35 * paint.FINE), round(width * paint.FINE))
            flowers = paint.tinted((0.22, 0.30, 0.14), 0.3 * paint.fractal(rng, shape, 12, 3))
            for _ in range(int(45 * width)):
                at, color = rng.uniform((0, 0), shape[::-1]), rng.uniform(0.3, 1, 3) * (1, 0.5, 0.7)
                paint.spot(rng, flowers, at, rng.integers(2, 6, 2), color)
            box, texture = (u0, v1 - 0.26, u1, v1 + 0.09), paint.texture(flowers)
            self.builder.box(self.frame, box, (0.16, 0.36), texture, texture)

    def _dress(self, openings: list[tuple[str, Span]]) -> None:
        """Add signs and a balcony to a front."""
        rng, frame, height = self.rng, self.frame, self.height
        for kind, (u0, v0, u1, _) in openings:
            if kind == "shop":
                board = fittings.sign(rng, u1 - u0, 0.42)
                above = (u0, v0 - 0.52, u1, v0 - 0.10)
                self.builder.box(frame, above, (0, 0.07), self.trim, board)
        if rng.random() < 0.6:  # a sign that hangs over the street
            u = rng.uniform(0.15, 0.85) * self.width
            side = Frame(frame.point(u, height - 3.9, 0.25), frame.out, DOWN)
            board = fittings.sign(rng, 0.8, 0.6, int(rng.integers(1, 3)))
            iron = paint.trim(rng, (0.12, 0.12, 0.13))
            self.builder.box(side, (0, 0, 0.8, 0.6), (-0.03, 0.03), iron, board)
            back = Frame(side.point(0.8, 0, -0.035), -side.right, DOWN)
            self.builder.rectangle(back, (0.8, 0.6), board)
            self._box((u - 0.02, height - 3.98, u + 0.02, height - 3.93), (0, 1.05), iron)
        upper = [span for kind, span in openings if kind == "window" and span[3] < height - 3.5]
        if upper and not self.design.shutters and rng.random() < 0.5:
            self._balcony(upper[rng.integers(len(upper))])

    def _balcony(self, window: Span) -> None:
        """Add a slab with an iron railing below a window."""
        u0, v, u1 = window[0] - 0.5, window[3] + 0.09, window[2] + 0.5
        iron = paint.trim(self.rng, (0.10, 0.11, 0.12))
        self._box((u0, v, u1, v + 0.14), (0, 0.85))
        self._box((u0, v - 0.85, u1, v - 0.79), (0.76, 0.82), iron)
        for u in np.linspace(u0, u1 - 0.03, 14):
            self._box((u, v - 0.82, u + 0.03, v), (0.775, 0.805), iron)
