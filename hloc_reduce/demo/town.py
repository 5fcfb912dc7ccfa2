"""The town: houses, a market square with three streets, a fountain, a stall and lamps."""

import functools

import numpy as np

from . import textures as paint
from .builder import Builder, Frame
from .fittings import sign
from .houses import House, add_house
from .render import Scene
from .surface import Texture

HOUSES = [
    # north side of the square, with twins, and the street to the north
    House(0, (-12.5, 10, -6.5, 10), 8, 3, 3, "plaster", gabled=True),
    House(1, (-6.5, 10, -1.8, 10), 8, 3, 2, "half_timber", gabled=True),
    House(1, (-1.8, 10, 3, 10), 8, 3, 2, "half_timber", gabled=True, right=3),
    House(2, (9, 10, 15.5, 10), 8, 3, 3, "ashlar", left=3),
    House(3, (3, 18, 3, 27), 7, 2, 4, "brick"),
    House(4, (9, 27, 9, 18), 7, 3, 4, "plaster"),
    House(5, (1, 27, 11, 27), 7, 3, 4, "half_timber", gabled=True),
    # west side and the street to the west
    House(6, (-12, 2, -12, 10.5), 7, 3, 4, "brick", left=3),
    House(7, (-12, -10.5, -12, -4), 7, 2, 3, "plaster", right=3),
    House(8, (-28, 2, -19, 2), 7, 3, 4, "ashlar"),
    House(9, (-19, -4, -28, -4), 7, 2, 4, "half_timber"),
    House(10, (-28, -5.5, -28, 3.5), 7, 3, 3, "plaster", gabled=True),
    # south side, with twins
    House(11, (12, -10, 6.2, -10), 7, 3, 3, "plaster"),
    House(12, (6.2, -10, 0.6, -10), 8, 3, 3, "brick", gabled=True),
    House(12, (0.6, -10, -5, -10), 8, 3, 3, "brick", gabled=True),
    House(13, (-5, -10, -12.5, -10), 7, 2, 4, "half_timber"),
    # the town hall in the east and the street past it
    House(14, (12, 10.5, 12, -4), 8, 3, 6, "ashlar", right=3),
    House(15, (20.5, -10, 12, -10), 7, 3, 4, "plaster"),
    House(16, (28, -10, 20.5, -10), 7, 2, 3, "ashlar"),
    House(17, (20, -4, 27, -4), 7, 3, 3, "brick"),
    House(18, (27, -2.5, 27, -11.5), 7, 3, 4, "half_timber", gabled=True),
]

# Where a camera may stand, (x0, y0, x1, y1), and obstacles there, (x, y, radius).
OPEN_GROUND = [(-10.5, -8.5, 10.5, 8.5), (4, 5, 8, 24), (-25, -3, -5, 1), (5, -9, 24, -5)]
FOUNTAIN, PILLAR, STALL = (-3.5, -1.0, 2.3), (6.0, 4.5, 0.8), (3.6, -4.2, 1.6)
STANDING_LAMPS = [(-7.5, 5.0), (1.2, 5.8), (8.6, -2.5), (-6.8, -7.4), (7.6, 16.5), (-18.0, 0.6)]
OBSTACLES = [FOUNTAIN, PILLAR, STALL, *((x, y, 0.3) for x, y in STANDING_LAMPS)]


@functools.lru_cache(maxsize=1)
def build_town(seed: int) -> Scene:
    """Build and paint the town, the same for the same seed."""
    builder = Builder(np.random.default_rng([seed, 0]))
    _ground(builder)
    _fountain(builder)
    _pillar(builder)
    _stall(builder)
    for spot in [*STANDING_LAMPS, (20.0, -8.6)]:
        _street_lamp(builder, spot)
    _clutter(builder)
    sky = _sky(builder.rng)
    for number, house in enumerate(HOUSES):
        add_house(builder, house, seed, number)
    suns = []
    for azimuth, elevation in ((-2.2, 0.85), (-1.1, 0.95)):  # from the south
        flat = np.cos(elevation)
        suns.append((flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)))
    return Scene(builder.surfaces, builder.lamps, suns, sky, extent=42)


def _ground(builder: Builder) -> None:
    """Add cobbles in the square and in the streets, pavements along the fronts."""
    rng = builder.rng
    for (x0, y0, x1, y1), stone in (
        ((-12, -10, 12, 10), (0.13, 0.17)),
        ((3, 10, 9, 27), (0.11, 0.12)),
        ((-28, -4, -12, 2), (0.11, 0.12)),
        ((12, -10, 27, -4), (0.15, 0.26)),
    ):
        cobbles = paint.cobbles(rng, x1 - x0, y1 - y0, stone)
        builder.rectangle(Frame.level(x0, y1, 0.0), (x1 - x0, y1 - y0), cobbles)
    earth = paint.trim(rng, (0.35, 0.32, 0.27), density=20)
    builder.rectangle(Frame.level(-60, 60, -0.05), (120, 120), earth)
    kerb = paint.trim(rng, (0.55, 0.54, 0.52))
    for number, house in enumerate(HOUSES):
        p, q = np.array(house.front[:2]), np.array(house.front[2:])
        frame = Frame.upright(np.array([*p, 0.12 + 0.004 * number]), q - p)
        width = float(np.linalg.norm(q - p))
        slabs = paint.ashlar(rng, (115, round(width * 96)), (0.50, 0.49, 0.47))
        pavement = Frame(frame.origin, frame.right, frame.out)
        builder.rectangle(pavement, (width, 1.05), paint.texture(slabs, paint.DENSITY))
        builder.box(frame, (0, 0, width, 0.3), (1.05, 1.2), kerb)


def _fountain(builder: Builder) -> None:
    """Add an octagonal basin with a statue, of a kind, on a pedestal."""
    rng, center = builder.rng, np.array(FOUNTAIN[:2])
    sides = []
    for _ in range(8):
        side = paint.ashlar(rng, (112, 200), (0.58, 0.55, 0.48))
        paint.spot(rng, side, rng.uniform((30, 20), (170, 80)), (16, 11), (0.4, 0.38, 0.33))
        sides.append(paint.texture(side, 120))
    stone = paint.trim(rng, (0.60, 0.57, 0.50))
    water = paint.trim(rng, (0.16, 0.24, 0.24), 3, density=60)
    builder.prism(center, 1.9, (0, 0.75), sides, water)
    for k in range(8):
        angle = (k + 0.5) * np.pi / 4
        spot = center + 1.74 * np.array([np.cos(angle), np.sin(angle)])
        heights = (0.7, 0.86 + 0.003 * k)
        builder.block(spot, (1.4, 0.24), heights, stone, angle + np.pi / 2)
    for size, heights in ((1.1, (0.7, 1.1)), (0.8, (1.1, 2.3)), (0.95, (2.3, 2.45))):
        carved = sign(rng, 1, 1, 5) if size == 0.8 else stone
        builder.block(center, (size, size), heights, carved, 0.3)
    bronze = paint.trim(rng, (0.25, 0.36, 0.31))
    builder.block(center, (0.5, 0.35), (2.45, 3.2), bronze, 0.5)
    builder.block(center, (0.62, 0.3), (3.2, 3.75), bronze, 0.8)
    builder.block(center, (0.28, 0.28), (3.75, 4.1), bronze, 1.1)
    builder.block(center, (0.9, 0.12), (3.55, 3.68), bronze, 0.2)


def _pillar(builder: Builder) -> None:
    """Add a round advertising pillar, pasted with posters."""
    rng, center = builder.rng, PILLAR[:2]
    sides = [sign(rng, 0.55, 2.6, int(rng.integers(4, 8))) for _ in range(8)]
    wood = paint.trim(rng, (0.22, 0.30, 0.24))
    builder.prism(center, 0.7, (0.25, 2.8), sides, wood)
    builder.prism(center, 0.8, (0, 0.25), [wood] * 8, wood)
    builder.prism(center, 0.85, (2.8, 3.0), [wood] * 8, wood)


def _stall(builder: Builder) -> None:
    """Add a market stall under a striped awning, with crates of fruit."""
    rng, (x, y) = builder.rng, STALL[:2]
    wood = paint.trim(rng, (0.45, 0.33, 0.22), 5)
    for dx in (-1.3, 1.3):
        for dy in (-0.8, 0.8):
            builder.block((x + dx, y + dy), (0.09, 0.09), (0, 2.2), wood)
    builder.block((x, y), (2.5, 1.3), (0.1, 0.85), wood)
    cloth = paint.tinted((0.75, 0.72, 0.66), 0.06 * paint.fractal(rng, (160, 480), 50, 5))
    cloth[:, np.arange(480) // 30 % 2 == 1] *= np.array((0.8, 0.25, 0.22), np.float32)  # stripes
    awning = paint.texture(cloth)
    for side in (-1, 1):
        right = np.array([-side * 1.0, 0, 0])
        corner = np.array([x + side * 1.5, y, 2.85])
        down = np.array([0, side * 1.0, -0.6]) / np.hypot(1, 0.6)
        builder.rectangle(Frame(corner, right, down), (3.0, 1.25), awning)
        builder.rectangle(Frame(corner + 3 * right, -right, down), (3.0, 1.25), awning)
    for k in range(5):
        goods = paint.tinted((0.4, 0.3, 0.2), 0.2 * paint.fractal(rng, (64, 64), 20, 3))
        color = rng.uniform(0.2, 0.9, 3)
        for _ in range(40):
            paint.spot(rng, goods, rng.uniform(0, 64, 2), (6, 6), color * rng.uniform(0.6, 1.1))
        heights = (0.85, rng.uniform(1.0, 1.15))
        builder.block((x - 1 + 0.5 * k, y), (0.42, 1.0), heights, paint.texture(goods))


def _street_lamp(builder: Builder, spot: tuple[float, float]) -> None:
    """Add a lamp post."""
    iron = paint.trim(builder.rng, (0.10, 0.13, 0.12))
    builder.prism(spot, 0.17, (0, 0.7), [iron] * 8, iron)
    builder.prism(spot, 0.06, (0.7, 3.5), [iron] * 8, iron)
    glass = Texture(np.full((16, 16, 3), (255, 240, 205), np.uint8), 16, glow=25.0)
    builder.block(spot, (0.3, 0.3), (3.5, 3.95), glass, 0.4)
    builder.block(spot, (0.42, 0.42), (3.95, 4.05), iron, 0.4)
    builder.lamps.append((*spot, 3.72, 6.0))


def _clutter(builder: Builder) -> None:
    """Add barrels and stacks of crates along the walls."""
    rng = builder.rng
    spots = [(-11, 6), (-10.2, -9), (-9, 9), (10.8, 8.6), (10.9, 0.5), (-1, -9), (8, -9)]
    spots += [(3.6, 20), (8.5, 22.5), (8.4, 12), (-20, 1.5), (-15, -3.5), (18, -9.3), (22, -4.7)]
    for spot in spots:
        wood = paint.trim(rng, rng.uniform(0.2, 0.5) * np.array((1.3, 1.0, 0.75)), 4)
        if rng.random() < 0.4:
            builder.prism(spot, 0.36, (0, 0.95), [wood] * 8, wood)
        else:
            for k in range(rng.integers(1, 4)):
                label = sign(rng, 0.7, 0.5, 2)
                size, turn = rng.uniform(0.5, 0.7), rng.uniform(0, 1.5)
                builder.block(spot, (size, size), (0.5 * k, 0.5 * k + 0.48), label, turn)


def _sky(rng: np.random.Generator) -> np.ndarray:
    """Paint soft clouds on blue, uint8 (256, 2048, 3), from the zenith to the horizon."""
    shape = (256, 2048)
    y = np.linspace(0, 1, shape[0], dtype=np.float32)[:, None, None]
    zenith, horizon = np.array([(0.38, 0.55, 0.80), (0.74, 0.81, 0.88)], np.float32)
    clouds = paint.fractal(rng, shape, (60, 160), 5, 0.55)
    cover = 0.9 * paint.soft_step(clouds, 0.3, 2.2)
    fade = np.linspace(0, 1, 256, dtype=np.float32)  # closes the circle
    cover[:, :256] = fade * cover[:, :256] + (1 - fade) * cover[:, -1:]
    return paint.finish(paint.mixed((1 - y) * zenith + y * horizon, (0.95, 0.95, 0.96), cover))
