"""Intrinsics of queries without a list: those of the map's camera, from EXIF data, or guessed."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from ..utils import colmap
from ..utils.files import replacing
from ..utils.parsers import to_line

GUESSED_FOCAL = 1.2  # times the longer side, as in COLMAP
WELL_KNOWN = 3  # images from which the map knows the intrinsics of their camera
_REFINED = {"refine_focal_length": True}
# source of intrinsics -> options of `localize_sfm.main` that make up for their errors
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
    """What a map tells about the intrinsics of other photos.

    Args:
        known: cameras that took several of its photos, by their `colmap.exif_camera_model`.
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
        The camera and its source, a key of `REFINEMENTS`: "map" for a camera that the map knows,
        else a SIMPLE_RADIAL camera without distortion, from "EXIF" data or guessed. It is a "guess"
        if map photos have the size of the photo, which then is hardly cropped, else "unknown".

    Raises:
        InputError: if the image cannot be read.
    """
    if isinstance(image, np.ndarray):
        height, width = image.shape[:2]
        params = [GUESSED_FOCAL * max(width, height), width / 2, height / 2, 0]
        camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=width, height=height, params=params)
    else:
        camera, has_focal_length = colmap.infer_camera(image)
        if of_map.known and (same := of_map.known.get(colmap.exif_camera_model(image) or "")):
            return same, "map"
        if has_focal_length:
            return camera, "EXIF"
    size = camera.width, camera.height
    return camera, "guess" if {size, size[::-1]} & of_map.sizes else "unknown"


def of_map(reconstruction: pycolmap.Reconstruction, image_dir: Path) -> MapCameras:
    """Return what a map tells about the intrinsics of other photos.

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
    """Return intrinsics as JSON values: model, width, height and parameters."""
    return [camera.model.name, camera.width, camera.height, *camera.params.tolist()]


def to_lists(queries: Sequence[tuple[str, pycolmap.Camera | None]]) -> dict[str, list | None]:
    """Return the intrinsics of queries as JSON values, None if they are not known."""
    return {name: None if camera is None else to_list(camera) for name, camera in queries}


def from_list(values: list) -> pycolmap.Camera:
    """Return the intrinsics in a list from `to_list`."""
    model, width, height, *params = values
    return pycolmap.Camera(model=model, width=width, height=height, params=params)


def write_queries(cameras: Mapping[str, tuple[pycolmap.Camera, str]], path: Path) -> None:
    """Write a query list with intrinsics, and their sources in comments."""
    lines = []
    for name, (camera, source) in cameras.items():
        params = map(repr, camera.params.tolist())
        lines.append(f"# {source}\n")
        lines.append(to_line(name, camera.model.name, camera.width, camera.height, *params))
    with replacing(path) as temporary:
        temporary.write_text("".join(lines), encoding="utf-8")
