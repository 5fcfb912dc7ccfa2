"""Planar surfaces with their textures, and the cameras that look at them.

World in metres, z up. Pixel coordinates are COLMAP's: the centre of the first pixel is (0.5, 0.5).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap

Vector = Sequence[float] | np.ndarray
Points = Sequence[Vector] | np.ndarray
Color = Sequence[float] | np.ndarray  # RGB in [0, 1]
Span = tuple[float, float, float, float]  # a rectangle in a plane: u0, v0, u1, v1 in metres


class Texture:
    """A mip pyramid of a picture that repeats without end.

    Args:
        image: uint8 RGB (H, W, 3); its upper left corner lies at plane coordinates (0, 0).
        density: texels per metre.
        glow: light it emits at night, times its colours.
    """

    def __init__(self, image: np.ndarray, density: float, glow: float = 0.0):
        self.density, self.glow = density, glow
        self.levels = [image]
        while min(image.shape[:2]) > 1:
            size = (image.shape[1] + 1) // 2, (image.shape[0] + 1) // 2
            # Area averaging keeps corners where they are; cv2.pyrDown shifts by half a texel.
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            self.levels.append(image)

    def sample(self, u: np.ndarray, v: np.ndarray, area: np.ndarray) -> np.ndarray:
        """Look up colours at plane coordinates.

        Args:
            u: float (N,), metres to the right.
            v: float (N,), metres downwards.
            area: float (N,), square metres that the pixel covers, which select the mip level.

        Returns:
            uint8 (N, 3).
        """
        level = np.rint(np.log2(self.density**2 * area) / 2)
        level = np.clip(level, 0, len(self.levels) - 1).astype(np.int8)
        colors = np.empty((len(u), 3), np.uint8)
        height, width = self.levels[0].shape[:2]
        for k in np.flatnonzero(np.bincount(level)):
            chosen = np.flatnonzero(level == k)
            image = self.levels[k]
            # cv2.remap has the centre of the first texel at 0.
            x = u[chosen] * (self.density * image.shape[1] / width) - 0.5
            y = v[chosen] * (self.density * image.shape[0] / height) - 0.5
            colors[chosen] = remap(image, x, y)
        return colors


def remap(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Interpolate an image (H, W, 3), which repeats, bilinearly at (N,) positions."""
    rows = -(-len(x) // 4096)  # cv2.remap takes no map of 32768 columns or more
    maps = np.zeros((2, rows * 4096), np.float32)
    maps[:, : len(x)] = x, y
    map_x, map_y = maps.reshape(2, rows, 4096)
    sampled = cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return sampled.reshape(-1, 3)[: len(x)]


@dataclass(frozen=True, eq=False)
class Surface:
    """A planar convex polygon with rectangular holes.

    Its points are `origin + u * axes[0] + v * axes[1]` in metres; it is visible only from the side
    where `axes[0]` points right and `axes[1]` down.
    """

    origin: np.ndarray  # (3,)
    axes: np.ndarray  # (2, 3), orthonormal
    outline: np.ndarray  # (n, 2), n <= 8
    texture: Texture
    holes: Sequence[Span] = ()


@dataclass(frozen=True)
class View:
    """A pinhole camera in place: calibration (3, 3), R (3, 3) and t (3,) from world, (h, w)."""

    calibration: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    shape: tuple[int, int]

    @classmethod
    def of(
        cls, camera: pycolmap.Camera, cam_from_world: pycolmap.Rigid3d, scale: float = 1
    ) -> "View":
        """Make the view of a camera whose image is magnified by `scale`."""
        calibration = np.diag((scale, scale, 1.0)) @ camera.calibration_matrix()
        pose = cam_from_world.matrix()
        shape = (round(camera.height * scale), round(camera.width * scale))
        return cls(calibration, pose[:, :3], pose[:, 3], shape)

    @property
    def center(self) -> np.ndarray:
        """Projection centre in the world, (3,)."""
        return -self.rotation.T @ self.translation
