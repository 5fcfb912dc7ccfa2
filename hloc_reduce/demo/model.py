"""The reference model of the map photos: points on the true surfaces, with their true tracks."""

from pathlib import Path

import numpy as np
import pycolmap

from ..utils import colmap
from .cameras import Photo
from .render import Scene
from .surface import View

Buffers = tuple[np.ndarray, np.ndarray]  # of `rasterize`: surface, inverse depth
POINTS_PER_PHOTO = 550  # at most
DEPTH_TOLERANCE = 0.01  # of the depth buffer, relative


def write_model(
    folder: Path, scene: Scene, photos: list[Photo], buffers: list[Buffers], seed: int
) -> None:
    """Write `cameras.bin`, `images.bin` and `points3D.bin`, as older COLMAPs do.

    Args:
        folder: of the model.
        scene: the town.
        photos: of the map.
        buffers: of each photo, without supersampling.
        seed: of the choice of the points.
    """
    views = [View.of(photo.camera, photo.cam_from_world) for photo in photos]
    points = np.concatenate(
        [
            _sample_points(scene, view, pair[0], np.random.default_rng([seed, 40, photo.index]))
            for photo, view, pair in zip(photos, views, buffers, strict=True)
        ]
    )
    seen = [_visible(view, pair[1], points) for view, pair in zip(views, buffers, strict=True)]
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


def _sample_points(
    scene: Scene, view: View, surface: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Draw pixels evenly and lift them to the surfaces they show, world (n, 3)."""
    pixels = rng.uniform((2, 2), np.array(view.shape[::-1]) - 2, (POINTS_PER_PHOTO, 2))
    shown = surface[tuple(pixels.astype(int).T[::-1])]
    pixels, shown = pixels[shown >= 0], shown[shown >= 0]
    inverses = np.linalg.inv(scene.homographies(view)[shown])
    plane = inverses @ np.column_stack([pixels, np.ones(len(pixels))])[..., None]
    return (scene.planes[shown] @ (plane / plane[:, 2:]))[..., 0]


def _visible(view: View, nearness: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the points (n, 3) that a camera sees, by its buffer of inverse depths (h, w).

    Returns:
        Their indices (m,) and their projections in COLMAP's pixels, float64 (m, 2).
    """
    x, y, z = view.calibration @ (view.rotation @ points.T + view.translation[:, None])
    inside = np.flatnonzero(z > 0.1)
    pixels = (np.stack([x, y]) / z)[:, inside].T
    kept = ((pixels >= 1) & (pixels < np.array(view.shape[::-1]) - 1)).all(axis=1)
    inside, pixels = inside[kept], pixels[kept]
    agreement = nearness[tuple(pixels.astype(int).T[::-1])] * z[inside]
    kept = abs(agreement - 1) < DEPTH_TOLERANCE
    return inside[kept], pixels[kept]
