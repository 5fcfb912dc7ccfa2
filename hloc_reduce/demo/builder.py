"""Building blocks: rectangles, boxes and prisms in the local frame of a wall."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .surface import Points, Span, Surface, Texture, Vector

DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True, eq=False)
class Frame:
    """A plane in the world, seen from its front; metres."""

    origin: np.ndarray  # (3,)
    right: np.ndarray  # (3,), unit
    down: np.ndarray  # (3,), unit, orthogonal to right

    @classmethod
    def upright(cls, corner: np.ndarray, right: np.ndarray) -> "Frame":
        """Make a vertical plane with its origin at `corner` (3,) and `right` (2,) or (3,)."""
        right = np.array([right[0], right[1], 0.0])
        return cls(np.asarray(corner, float), right / np.linalg.norm(right), DOWN)

    @classmethod
    def level(cls, x: float, y: float, z: float) -> "Frame":
        """Make a horizontal plane seen from above, `right` along x and `down` against y."""
        return cls(np.array([x, y, z]), np.array([1.0, 0, 0]), np.array([0, -1.0, 0]))

    @property
    def out(self) -> np.ndarray:
        """Unit normal towards the viewer, (3,)."""
        return -np.cross(self.right, self.down)

    def point(self, u: float, v: float, d: float = 0) -> np.ndarray:
        """Return the world point (3,) at `u` right, `v` down and `d` in front of the plane."""
        return self.origin + u * self.right + v * self.down + d * self.out


class Builder:
    """Collects the surfaces and the lamps of the town."""

    def __init__(self, rng: np.random.Generator):
        self.rng = rng
        self.surfaces: list[Surface] = []
        self.lamps: list[tuple[float, ...]] = []  # x, y, z, strength

    def polygon(
        self, frame: Frame, outline: Points, texture: Texture, holes: Sequence[Span] = ()
    ) -> None:
        """Add a polygon (n, 2) in a frame; the texture begins at the frame's origin."""
        axes = np.stack([frame.right, frame.down])
        surface = Surface(frame.origin, axes, np.array(outline, float), texture, holes)
        self.surfaces.append(surface)

    def rectangle(
        self, frame: Frame, size: Vector, texture: Texture, anywhere: bool = False
    ) -> None:
        """Add a rectangle of `size` (width, height) with its upper left corner at the origin.

        `anywhere` cuts it from a random place of the texture, so that the many pieces of one
        stone do not look all the same.
        """
        shift = self.rng.uniform(0, 1, 2) if anywhere else np.zeros(2)
        origin = frame.origin - shift @ np.stack([frame.right, frame.down])
        outline = shift + np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * size
        self.polygon(Frame(origin, frame.right, frame.down), outline, texture)

    def box(
        self, frame: Frame, span: Span, depth: Vector, sides: Texture, front: Texture | None = None
    ) -> None:
        """Add a box on a wall.

        Args:
            frame: of the wall.
            span: of the box on the wall.
            depth: distances of its back and its front from the wall, outwards.
            sides: texture of its sides.
            front: texture of its front; default: `sides`.
        """
        u0, v0, u1, v1 = span
        face = Frame(frame.point(u0, v0, depth[1]), frame.right, frame.down)
        self.rectangle(face, (u1 - u0, v1 - v0), front or sides, front is None)
        self._sides(frame, span, depth, sides)

    def recess(self, frame: Frame, span: Span, depth: float, texture: Texture) -> None:
        """Add the four reveals of an opening `depth` metres deep."""
        self._sides(frame, span, (0, -depth), texture)

    def _sides(self, frame: Frame, span: Span, depth: Vector, texture: Texture) -> None:
        """Add the sides between two depths: of a box if they increase, else of a recess."""
        (u0, v0, u1, v1), (d0, d1) = span, depth
        right, down, deep = frame.right, frame.down, abs(d1 - d0)
        along = frame.out if d1 > d0 else -frame.out
        for corner, across, downwards, size in (
            (frame.point(u0, v0, d0), along, down, (deep, v1 - v0)),
            (frame.point(u1, v0, d1), -along, down, (deep, v1 - v0)),
            (frame.point(u0, v0, d0), right, along, (u1 - u0, deep)),
            (frame.point(u0, v1, d1), right, -along, (u1 - u0, deep)),
        ):
            self.rectangle(Frame(corner, across, downwards), size, texture, True)

    def block(
        self, center: Vector, size: Vector, heights: Vector, texture: Texture, turn: float = 0
    ) -> None:
        """Add an upright box: `center`, `size`, and (bottom, top) in metres, turned by radians."""
        bottom, top = heights
        right = np.array([np.cos(turn), np.sin(turn), 0])
        toward = np.array([np.sin(turn), -np.cos(turn), 0])
        corner = np.array([*center, top]) + (toward * size[1] - right * size[0]) / 2
        frame = Frame.upright(corner, right)
        self.box(frame, (0, 0, size[0], top - bottom), (-size[1], 0), texture)
        back = Frame(frame.point(size[0], 0, -size[1]), -right, DOWN)
        self.rectangle(back, (size[0], top - bottom), texture, True)

    def prism(
        self, center: Vector, radius: float, heights: Vector, sides: list[Texture], lid: Texture
    ) -> None:
        """Add an upright prism, from bottom to top, with a lid and at most 8 sides."""
        (x, y), (bottom, top) = center, heights
        angles = np.arange(len(sides)) * 2 * np.pi / len(sides)
        ring = np.asarray(center) + radius * np.column_stack([np.cos(angles), np.sin(angles)])
        for p, q, texture in zip(ring, np.roll(ring, -1, axis=0), sides, strict=True):
            frame = Frame.upright(np.array([*p, top]), q - p)
            self.rectangle(frame, (float(np.linalg.norm(q - p)), top - bottom), texture)
        self.polygon(Frame.level(x, y, top), (ring - center) * (1, -1), lid)
