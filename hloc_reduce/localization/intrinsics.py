"""Intrinsics of queries that no list gives: the map's, from EXIF data, or guessed."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from ..utils import colmap
from ..utils.files import replacing
from ..utils.parsers import to_line

GUESSED_FOCAL = 1.2  # times the longer side, as in COLMAP
WELL_KNOWN = 3  # map images that tell the intrinsics of their camera
_REFINED = {"refine_focal_length": True}
# where intrinsics come from -> options of `localize_sfm.main` that make up for their errors
REFINEMENTS = {
    "list": {},
    "map": {},
    "EXIF": {"refinement": _REFINED},
    "guess": {"estimation": {"estimate_focal_length": True}, "refinement": _REFINED},
    "unknown": {
        "estimation": {"estimate_focal_length": True},
        "refinement": _REFINED,
        "photo": {"cropped": True},
    },
}


class MapCameras(NamedTuple):
    """What a map tells of the intrinsics of other photos.

    Args:
        known: cameras that took several of its photos, by `colmap.exif_camera_model`.
        sizes: (width, height) of its photos.
    """

    known: dict[str, pycolmap.Camera]
    sizes: set[tuple[int, int]]


def infer(image: Path | np.ndarray, of_map: MapCameras) -> tuple[pycolmap.Camera, str]:
    """Infer the intrinsics of a photo.

    Args:
        image: its file, or its pixels (H, W) or (H, W, 3).
        of_map: cameras and photo sizes of the map.

    Returns:
        The camera and a key of `REFINEMENTS`: "map" for one that is known, else a SIMPLE_RADIAL
        camera without distortion, of "EXIF" data or guessed: a "guess" if the photo has the size
        of photos of the map, so that it was hardly cropped, else "unknown".

    Raises:
        InputError: when the image cannot be read.
    """
    if isinstance(image, np.ndarray):
        height, width = image.shape[:2]
        params = [GUESSED_FOCAL * max(width, height), width / 2, height / 2, 0]
        camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=width, height=height, params=params)
    else:
        camera, has_focal_length = colmap.infer_camera(image)
        if of_map.known and (same := of_map.known.get(colmap.exif_camera_model(image))):
            return same, "map"
        if has_focal_length:
            return camera, "EXIF"
    size = camera.width, camera.height
    return camera, "guess" if {size, size[::-1]} & of_map.sizes else "unknown"


def of_map(reconstruction: pycolmap.Reconstruction, image_dir: Path) -> MapCameras:
    """Return what a map tells of the intrinsics of other photos.

    Args:
        reconstruction: the map.
        image_dir: the folder of its photos.
    """
    sizes = {(camera.width, camera.height) for camera in reconstruction.cameras.values()}
    found: dict[str, list[int]] = {}
    for image in reconstruction.images.values():
        if (name := colmap.exif_camera_model(image_dir / image.name)) is not None:
            found.setdefault(name, []).append(image.camera_id)
    known = {
        name: reconstruction.cameras[ids[0]]
        for name, ids in found.items()
        if len(ids) >= WELL_KNOWN and len(set(ids)) == 1
    }
    return MapCameras(known, sizes)


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
