"""The reference model of the map photos: points on the true surfaces, seen for true."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from ..utils import colmap
from .cameras import Photo
from .render import Scene
from .surface import View

POINTS = 550  # drawn per photo
TOLERANCE = 0.01  # of the depth buffer, relative


def sample_points(
    scene: Scene, view: View, buffers: tuple[np.ndarray, np.ndarray], rng: np.random.Generator
) -> np.ndarray:
    """Draw points evenly over an image and lift them to the surfaces they show.

    Args:
        scene: the town.
        view: the camera, without supersampling.
        buffers: from :func:`~.render.rasterize`.
        rng: the generator of this photo.

    Returns:
        World points, float64 (n, 3), n <= :data:`POINTS` as the sky has none.
    """
    pixels = rng.uniform((2, 2), np.array(view.shape[::-1]) - 2, (POINTS, 2))
    surface = buffers[0][tuple(pixels.astype(int).T[::-1])]
    pixels, surface = pixels[surface >= 0], surface[surface >= 0]
    inverses = np.linalg.inv(scene.homographies(view)[surface])
    plane = inverses @ np.column_stack([pixels, np.ones(len(pixels))])[..., None]
    return (scene.planes[surface] @ (plane / plane[:, 2:]))[..., 0]


def visible(view: View, nearness: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which points a camera sees.

    Args:
        view: the camera.
        nearness: its buffer of inverse depths, float32 (h, w).
        points: in the world, float64 (n, 3).

    Returns:
        The indices of the points that are inside the image and agree with the buffer, (m,), and
        their projections in COLMAP pixel coordinates, float64 (m, 2).
    """
    x, y, z = view.calibration @ (view.rotation @ points.T + view.translation[:, None])
    inside = np.flatnonzero(z > 0.1)
    pixels = (np.stack([x, y]) / z)[:, inside].T
    kept = ((pixels >= 1) & (pixels < np.array(view.shape[::-1]) - 1)).all(axis=1)
    inside, pixels = inside[kept], pixels[kept]
    agreement = nearness[tuple(pixels.astype(int).T[::-1])] * z[inside]
    kept = abs(agreement - 1) < TOLERANCE
    return inside[kept], pixels[kept]


def write_model(
    folder: Path,
    scene: Scene,
    photos: list[Photo],
    buffers: list[tuple[np.ndarray, np.ndarray]],
    seed: int,
) -> None:
    """Write ``cameras.bin``, ``images.bin`` and ``points3D.bin`` of an old COLMAP model.

    Args:
        folder: of the model.
        scene: the town.
        photos: of the map.
        buffers: from :func:`~.render.rasterize` without supersampling, of each photo.
        seed: of the choice of the points.
    """
    views = [View.of(photo.camera, photo.cam_from_world) for photo in photos]
    points = np.concatenate(
        [
            sample_points(scene, view, pair, np.random.default_rng([seed, 40, photo.index]))
            for photo, view, pair in zip(photos, views, buffers, strict=True)
        ]
    )
    seen = [visible(view, pair[1], points) for view, pair in zip(views, buffers, strict=True)]
    counts = np.bincount(np.concatenate([inside for inside, _ in seen]), minlength=len(points))
    well_seen = counts >= 3

    model = pycolmap.Reconstruction()
    tracks = [pycolmap.Track() for _ in points]
    for image_id, (photo, (inside, pixels)) in enumerate(zip(photos, seen, strict=True), start=1):
        kept = well_seen[inside]
        for idx, point in enumerate(inside[kept]):
            tracks[point].add_element(image_id, idx)
        image = pycolmap.Image(
            name=photo.name,
            keypoints=pixels[kept],
            camera_id=photo.camera.camera_id,
            image_id=image_id,
        )
        colmap.add_image(model, photo.camera, image, photo.cam_from_world)
    for point in np.flatnonzero(well_seen):
        model.add_point3D(points[point], tracks[point])
    model.update_point_3d_errors()
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(str(folder))
    for name in ("rigs.bin", "frames.bin"):  # Aachen's own model is older than these
        (folder / name).unlink(missing_ok=True)
