"""Building blocks: rectangles, boxes and prisms in the local frame of a wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .surface import Surface, Texture

DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True, eq=False)
class Frame:
    """A plane in the world: ``right`` and ``down`` as seen by who looks at it, metres."""

    origin: np.ndarray  # (3,)
    right: np.ndarray  # (3,), unit
    down: np.ndarray  # (3,), unit, orthogonal to right

    @classmethod
    def upright(cls, corner: np.ndarray, right: np.ndarray) -> Frame:
        """A vertical plane with its origin at ``corner`` (3,) and ``right`` (2,) or (3,)."""
        right = np.array([right[0], right[1], 0.0])
        return cls(np.asarray(corner, float), right / np.linalg.norm(right), DOWN)

    @property
    def out(self) -> np.ndarray:
        """Unit normal towards the viewer, (3,)."""
        return -np.cross(self.right, self.down)

    def point(self, u: float, v: float, d: float = 0) -> np.ndarray:
        """World point (3,) at ``u`` right, ``v`` down and ``d`` in front of the plane."""
        return self.origin + u * self.right + v * self.down + d * self.out


class Builder:
    """Collects the surfaces and the lamps of the town."""

    def __init__(self, rng: np.random.Generator):
        self.rng = rng
        self.surfaces: list[Surface] = []
        self.lamps: list[tuple[float, float, float, float]] = []

    def polygon(self, frame: Frame, outline, texture: Texture, holes=(), glow: float = 0) -> None:
        """A polygon in a frame, painted from the frame's origin on."""
        axes = np.stack([frame.right, frame.down])
        outline = np.asarray(outline, float)
        self.surfaces.append(Surface(frame.origin, axes, outline, texture, list(holes), glow))

    def rectangle(
        self, corner, right, down, size, texture: Texture, anywhere: bool = False, glow: float = 0
    ) -> None:
        """A rectangle of ``size`` (width, height) metres from its upper left ``corner`` (3,).

        ``anywhere`` cuts it from a random place of the texture, so that the many pieces of one
        stone do not look all the same.
        """
        shift = self.rng.uniform(0, 1, 2) if anywhere else np.zeros(2)
        outline = shift + np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * size
        axes = np.stack([right, down])
        self.surfaces.append(Surface(corner - shift @ axes, axes, outline, texture, glow=glow))

    def box(self, frame: Frame, span, depth, texture: Texture, front: Texture | None = None):
        """A box on a wall.

        Args:
            frame: of the wall.
            span: ``(u0, v0, u1, v1)`` on the wall.
            depth: how far its back and its front are before the wall.
            texture: of its sides.
            front: of its front, else as the sides.
        """
        (u0, v0, u1, v1), (d0, d1) = span, depth
        right, down, out = frame.right, frame.down, frame.out
        width, height, deep = u1 - u0, v1 - v0, d1 - d0
        self.rectangle(
            frame.point(u0, v0, d1), right, down, (width, height), front or texture, front is None
        )
        for corner, across, along, size in (
            (frame.point(u0, v0, d0), out, down, (deep, height)),
            (frame.point(u1, v0, d1), -out, down, (deep, height)),
            (frame.point(u0, v0, d0), right, out, (width, deep)),
            (frame.point(u0, v1, d1), right, -out, (width, deep)),
        ):
            self.rectangle(corner, across, along, size, texture, True)

    def recess(self, frame: Frame, span, depth: float, texture: Texture) -> None:
        """The four reveals of an opening ``depth`` metres deep."""
        u0, v0, u1, v1 = span
        right, down, out = frame.right, frame.down, frame.out
        for corner, across, along, size in (
            (frame.point(u0, v0), -out, down, (depth, v1 - v0)),
            (frame.point(u1, v0, -depth), out, down, (depth, v1 - v0)),
            (frame.point(u0, v0), right, -out, (u1 - u0, depth)),
            (frame.point(u0, v1, -depth), right, out, (u1 - u0, depth)),
        ):
            self.rectangle(corner, across, along, size, texture, True)

    def block(self, center, size, bottom: float, top: float, texture: Texture, turn: float = 0):
        """An upright box: ``center`` (2,), ``size`` (2,) metres, turned by radians."""
        right = np.array([np.cos(turn), np.sin(turn), 0])
        toward = np.array([np.sin(turn), -np.cos(turn), 0])
        corner = np.array([*center, top]) + (toward * size[1] - right * size[0]) / 2
        frame = Frame.upright(corner, right)
        self.box(frame, (0, 0, size[0], top - bottom), (-size[1], 0), texture)
        back = frame.point(size[0], 0, -size[1])
        self.rectangle(back, -right, DOWN, (size[0], top - bottom), texture, True)

    def prism(
        self,
        center,
        radius: float,
        bottom: float,
        top: float,
        sides: list[Texture],
        lid: Texture | None,
    ) -> None:
        """An upright prism with one side per texture (at most 8) and a lid unless None."""
        angles = np.arange(len(sides)) * 2 * np.pi / len(sides)
        ring = np.asarray(center) + radius * np.column_stack([np.cos(angles), np.sin(angles)])
        for p, q, texture in zip(ring, np.roll(ring, -1, axis=0), sides, strict=True):
            frame = Frame.upright(np.array([*p, top]), q - p)
            width = np.linalg.norm(q - p)
            self.polygon(
                frame, [(0, 0), (width, 0), (width, top - bottom), (0, top - bottom)], texture
            )
        if lid is not None:
            frame = Frame(np.array([*center, top]), np.array([1.0, 0, 0]), np.array([0, -1.0, 0]))
            self.polygon(frame, (ring - center) * (1, -1), lid)
