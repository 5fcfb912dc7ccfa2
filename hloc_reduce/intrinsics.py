"""Intrinsics of queries that no list gives: the map's, from EXIF data, or guessed."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap

from . import colmap
from .io import replacing
from .parsers import to_line

GUESSED_FOCAL = 1.2  # times the longer side, as in COLMAP
WELL_KNOWN = 3  # map images that tell the intrinsics of their camera
_REFINED = {"refine_focal_length": True}
# where intrinsics come from -> options of `localize_sfm.main` that make up for their errors
REFINEMENTS = {
    "list": {},
    "map": {},
    "EXIF": {"refinement": _REFINED},
    "guess": {"estimation": {"estimate_focal_length": True}, "refinement": _REFINED},
}


def infer(
    image: Path | np.ndarray, known: Mapping[str, pycolmap.Camera] | None = None
) -> tuple[pycolmap.Camera, str]:
    """Infer the intrinsics of a photo.

    Args:
        image: its file, or its pixels (H, W) or (H, W, 3).
        known: cameras of the map, by `colmap.exif_camera_model`.

    Returns:
        The camera and a key of `REFINEMENTS`: "map" for one that is known, else a SIMPLE_RADIAL
        camera without distortion of "EXIF" data or a "guess".

    Raises:
        InputError: when the image cannot be read.
    """
    if isinstance(image, np.ndarray):
        height, width = image.shape[:2]
        params = [GUESSED_FOCAL * max(width, height), width / 2, height / 2, 0]
        camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=width, height=height, params=params)
        return camera, "guess"
    camera, has_focal_length = colmap.infer_camera(image)
    if known and (same := known.get(colmap.exif_camera_model(image))):
        return same, "map"
    return camera, "EXIF" if has_focal_length else "guess"


def of_map(reconstruction: pycolmap.Reconstruction, image_dir: Path) -> dict[str, pycolmap.Camera]:
    """Return the cameras that took several photos of a map, by `colmap.exif_camera_model`.

    Args:
        reconstruction: the map.
        image_dir: the folder of its photos.
    """
    found: dict[str, list[int]] = {}
    for image in reconstruction.images.values():
        if (name := colmap.exif_camera_model(image_dir / image.name)) is not None:
            found.setdefault(name, []).append(image.camera_id)
    return {
        name: reconstruction.cameras[ids[0]]
        for name, ids in found.items()
        if len(ids) >= WELL_KNOWN and len(set(ids)) == 1
    }


def to_list(camera: pycolmap.Camera) -> list:
    """Return intrinsics as JSON has them: model, width, height and parameters."""
    return [camera.model.name, camera.width, camera.height, *camera.params.tolist()]


def from_list(values: list) -> pycolmap.Camera:
    """Return the intrinsics that `to_list` made a list of."""
    model, width, height, *params = values
    return pycolmap.Camera(model=model, width=width, height=height, params=params)


def write_queries(cameras: Mapping[str, tuple[pycolmap.Camera, str]], path: Path) -> None:
    """Write a query list with intrinsics; comments say where they come from."""
    lines = []
    for name, (camera, source) in cameras.items():
        params = map(repr, camera.params.tolist())
        lines.append(f"# {source}\n")
        lines.append(to_line(name, camera.model.name, camera.width, camera.height, *params))
    text = "".join(lines)
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
