"""The renderer: planar textured surfaces, a depth buffer, sunlight with shadows, lamps.

World in metres, z up. Pixel coordinates are COLMAP's: the centre of the first pixel is
(0.5, 0.5). For a surface `M = K [R u | R v | R o + t]` maps plane coordinates in metres to
homogeneous pixels, and `M^-1 (x, y, 1) = (u, v, 1) / z`: the texture coordinates and the inverse
depth are linear in the pixel, hence exact at every pixel centre.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from .surface import Points, Surface, View, remap

NEAR_PLANE_METRES = 0.05
SUPERSAMPLING = 2
LAMP_REACH = 8.0  # metres at which the light of a lamp of strength 1 is neglected
LINEAR_LIGHT = ((np.arange(256) / 255) ** 2.2).astype(np.float32)  # sRGB level to linear light


@dataclass(frozen=True)
class Light:
    """Colours in linear light, (3,), of the sun with index `sun`, the sky and the lamps."""

    sun: int
    sun_color: np.ndarray
    sky_color: np.ndarray
    lamp_color: np.ndarray
    sky_shift: float = 0.0  # turns the sky, in [0, 1)


class Scene:
    """All surfaces of the town, with its suns and lamps.

    Args:
        surfaces: the surfaces.
        lamps: their positions and strengths, float (n, 4).
        suns: unit vectors towards the possible suns, float (n, 3).
        sky: uint8 RGB (H, W, 3), from the zenith down to the horizon, all around.
        extent: radius in metres, around the origin, of the region with shadows.
    """

    def __init__(
        self, surfaces: list[Surface], lamps: Points, suns: Points, sky: np.ndarray, extent: float
    ):
        self.surfaces, self.sky = surfaces, sky
        self.lamps, self.suns = np.asarray(lamps), np.asarray(suns)
        self.planes = np.stack([np.column_stack([*s.axes, s.origin]) for s in surfaces])
        self.normals = -np.cross(self.planes[:, :, 0], self.planes[:, :, 1])
        outlines = [s.outline[np.minimum(np.arange(8), len(s.outline) - 1)] for s in surfaces]
        padded = np.dstack([np.array(outlines), np.ones((len(surfaces), 8))])
        self.corners = padded @ self.planes.transpose(0, 2, 1)  # (n, 8, 3)
        self.centers = self.corners.mean(axis=1)
        self.radii = np.linalg.norm(self.corners - self.centers[:, None], axis=2).max(axis=1)
        self.sun_views = [_sun_view(sun, extent) for sun in self.suns]
        # The surfaces are slightly raised, lest they throw shadows on themselves.
        raised = self.planes.copy()
        raised[:, :, 2] += 0.06 * self.normals
        self.sun_homographies = [view.calibration @ _moved(view, raised) for view in self.sun_views]
        self.sun_buffers = [rasterize(self, view)[1] for view in self.sun_views]

    def homographies(self, view: View) -> np.ndarray:
        """Return the maps from plane coordinates to homogeneous pixels, (n, 3, 3)."""
        return view.calibration @ _moved(view, self.planes)


def _moved(view: View, planes: np.ndarray) -> np.ndarray:
    """Transform planes (n, 3, 3) from the world to the camera."""
    moved = view.rotation @ planes
    moved[:, :, 2] += view.translation
    return moved


def _sun_view(sun: np.ndarray, extent: float) -> View:
    """Return the view from a sun, so far away that its rays are nearly parallel."""
    distance, size = 40 * extent, 2048
    right = np.cross(sun, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(-sun, right), -sun])
    focal = size / 2 / extent * distance
    calibration = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return View(calibration, rotation, -rotation @ (sun * distance), (size, size))


def _spans(
    matrix: np.ndarray, outline: np.ndarray, shape: tuple[int, int]
) -> tuple[int, np.ndarray, np.ndarray] | None:
    """Find the pixels whose centres lie in a projected convex outline (n, 2).

    Returns:
        The first row and, for each row from there on, the first column and the end of the columns,
        int32; None if there is no pixel.
    """
    points = np.column_stack([outline, np.ones(len(outline))]) @ matrix.T
    if points[:, 2].min() < NEAR_PLANE_METRES:  # clip, keeping the order of the corners
        kept = []
        for p, q in zip(points, [*points[1:], points[0]], strict=True):
            if p[2] >= NEAR_PLANE_METRES:
                kept.append(p)
            if (p[2] >= NEAR_PLANE_METRES) != (q[2] >= NEAR_PLANE_METRES):
                kept.append(p + (NEAR_PLANE_METRES - p[2]) / (q[2] - p[2]) * (q - p))
        if not kept:
            return None
        points = np.array(kept)
    x, y = (points[:, :2].T / points[:, 2])[..., None]
    first = int(max(np.ceil(y.min() - 0.5), 0))
    last = int(min(np.floor(y.max() - 0.5), shape[0] - 1))
    if last < first:
        return None
    rows = np.arange(first, last + 1) + 0.5
    next_x, next_y = np.roll(x, -1, axis=0), np.roll(y, -1, axis=0)
    dx, dy = next_x - x, next_y - y
    crossing = x + (rows - y) * (dx / np.where(dy == 0, np.inf, dy))
    crossed = (rows >= y) != (rows >= next_y)
    left = np.where(crossed, crossing, np.inf).min(axis=0)
    right = np.where(crossed, crossing, -np.inf).max(axis=0)
    left, right = (
        np.clip(np.ceil(ends - 0.5), 0, shape[1]).astype(np.int32) for ends in (left, right)
    )
    return (first, left, right) if (left < right).any() else None


def _between(columns: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return which columns (n,) lie in the range of each row (m,), bool (m, n)."""
    return (columns >= left[:, None]) & (columns < right[:, None])


def rasterize(scene: Scene, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Find the surface seen at every pixel centre.

    Returns:
        Its index, int16 (h, w), -1 for the sky; its inverse depth, float32 (h, w), 0 for the sky.
    """
    surface = np.full(view.shape, -1, np.int16)
    nearness = np.zeros(view.shape, np.float32)
    homographies = scene.homographies(view)
    candidates = _candidates(scene, view)
    inverses = np.linalg.inv(homographies[candidates])
    for k, inverse in zip(candidates, inverses, strict=True):
        spans = _spans(homographies[k], scene.surfaces[k].outline, view.shape)
        if spans is None:
            continue
        first, left, right = spans
        columns = np.arange(left.min(), right.max())
        mask = _between(columns, left, right)
        for u0, v0, u1, v1 in scene.surfaces[k].holes:
            corners = np.array([(u0, v0), (u1, v0), (u1, v1), (u0, v1)])
            hole = _spans(homographies[k], corners, view.shape)
            if hole is not None:
                top = hole[0] - first
                mask[top : top + len(hole[1])] &= ~_between(columns, *hole[1:])
        a, b, c = inverse[2]
        rows = np.arange(first, first + len(left))
        depth = (b * (rows + 0.5) + c).astype(np.float32)[:, None]
        depth = depth + (a * (columns + 0.5)).astype(np.float32)
        box = slice(first, first + len(left)), slice(columns[0], columns[-1] + 1)
        mask &= depth > nearness[box]
        np.copyto(nearness[box], depth, where=mask)
        np.copyto(surface[box], np.int16(k), where=mask)
    return surface, nearness


def _candidates(scene: Scene, view: View) -> np.ndarray:
    """Return the indices of surfaces that face the camera and may be in its image."""
    facing = ((view.center - scene.planes[:, :, 2]) * scene.normals).sum(axis=1) > 1e-6
    points = (scene.corners @ view.rotation.T + view.translation) @ view.calibration.T
    x, y, z = np.moveaxis(points, 2, 0)
    outside = (z < NEAR_PLANE_METRES).all(1) | (x < 0).all(1) | (y < 0).all(1)
    outside |= (x > view.shape[1] * z).all(1) | (y > view.shape[0] * z).all(1)
    return np.flatnonzero(facing & ~outside)


def render(scene: Scene, view: View, light: Light) -> np.ndarray:
    """Compute the linear light at every pixel, float32 RGB (h, w, 3)."""
    surface, _ = rasterize(scene, view)
    order = np.argsort(surface, axis=None, kind="stable").astype(np.int32)
    ends = np.cumsum(np.bincount(surface.ravel() + 1, minlength=len(scene.surfaces) + 1))
    image = np.empty((surface.size, 3), np.float32)
    if ends[0]:
        image[order[: ends[0]]] = _sky(scene, view, light, order[: ends[0]])
    seen = np.flatnonzero(np.diff(ends))
    inverses = np.linalg.inv(scene.homographies(view)[seen])
    scales = abs(np.linalg.det(inverses))
    for k, inverse, scale in zip(seen, inverses, scales, strict=True):
        pixels = order[ends[k] : ends[k + 1]]
        row, column = np.divmod(pixels, view.shape[1])
        x, y = column + 0.5, row + 0.5
        z = 1 / (inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2])
        u = (inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]) * z
        v = (inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]) * z
        color = scene.surfaces[k].texture.sample(u, v, scale * z**3)
        image[pixels] = LINEAR_LIGHT.take(color) * _irradiance(scene, k, u, v, light)
    return image.reshape(*view.shape, 3)


def _sky(scene: Scene, view: View, light: Light, pixels: np.ndarray) -> np.ndarray:
    """Return the linear light of the sky at pixels (N,), (N, 3)."""
    y, x = np.divmod(pixels, view.shape[1])
    rays = np.stack([x + 0.5, y + 0.5, np.ones(len(x))])
    rays = view.rotation.T @ np.linalg.inv(view.calibration) @ rays
    height, width = scene.sky.shape[:2]
    azimuth = np.arctan2(rays[1], rays[0]) / (2 * np.pi) + light.sky_shift
    elevation = np.arctan2(rays[2], np.hypot(rays[0], rays[1])) / (np.pi / 2)
    row = (1 - np.clip(elevation, 0, 1)) * (height - 1)
    return LINEAR_LIGHT[remap(scene.sky, azimuth * width, row)] * (1.6 * light.sky_color)


def _irradiance(scene: Scene, k: np.intp, u: np.ndarray, v: np.ndarray, light: Light) -> np.ndarray:
    """Return the light that falls on points of surface `k` or that it emits, float32 (N, 3)."""
    normal, (right, down, origin) = scene.normals[k], scene.planes[k].T
    total = np.broadcast_to((0.72 + 0.28 * normal[2]) * light.sky_color, (len(u), 3))
    total = total.astype(np.float32)
    slope = normal @ scene.suns[light.sun]
    if slope > 0 and light.sun_color.any():
        lit = _sunlit(scene, k, u, v, light.sun)
        total += lit[:, None] * (slope * light.sun_color).astype(np.float32)
    if light.lamp_color.any():
        received = np.full(len(u), scene.surfaces[k].texture.glow, np.float32)
        u, v = u.astype(np.float32), v.astype(np.float32)
        distances = np.linalg.norm(scene.lamps[:, :3] - scene.centers[k], axis=1)
        near = distances < scene.radii[k] + LAMP_REACH * np.sqrt(scene.lamps[:, 3])
        for *position, strength in scene.lamps[near]:
            offset = position - origin
            height, across, along = map(float, (offset @ normal, offset @ right, offset @ down))
            if height > 0:
                squared = (u - across) ** 2 + (v - along) ** 2 + (height**2 + 0.05)
                received += strength * height / (squared * np.sqrt(squared))
        total += received[:, None] * light.lamp_color.astype(np.float32)
    return total


def _sunlit(scene: Scene, k: np.intp, u: np.ndarray, v: np.ndarray, sun: int) -> np.ndarray:
    """Return the share of the sun that points of surface `k` see, float32 (N,)."""
    view, buffer = scene.sun_views[sun], scene.sun_buffers[sun]
    (a, b, c), (d, e, f), (g, h, i) = scene.sun_homographies[sun][k]
    z = g * u + h * v + i
    x, y = (a * u + b * v + c) / z, (d * u + e * v + f) / z
    nearness = (1 / z).astype(np.float32)
    column = np.clip(x, 1, view.shape[1] - 2).astype(np.float32)
    row = np.clip(y, 1, view.shape[0] - 2).astype(np.float32)
    lit = np.zeros(len(u), np.float32)
    for dx, dy in ((-0.7, -0.3), (0.3, -0.7), (0.7, 0.3), (-0.3, 0.7)):  # softens the edge
        texel = (row + np.float32(dy)).astype(np.int32) * view.shape[1]
        texel += (column + np.float32(dx)).astype(np.int32)
        lit += buffer.take(texel) <= nearness
    return lit / 4


def downsample(image: np.ndarray) -> np.ndarray:
    """Average every block of supersampled pixels; centres map to centres."""
    size = image.shape[1] // SUPERSAMPLING, image.shape[0] // SUPERSAMPLING
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
