"""Intrinsics of queries that no list gives: from EXIF data, or guessed, and how to refine them."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap

from ..utils import colmap
from ..utils.files import replacing
from ..utils.parsers import to_line

GUESSED_FOCAL = 1.2  # times the longer side, as in COLMAP
_REFINED = {"refine_focal_length": True}
# where intrinsics come from -> options of `localize_sfm.main` that make up for their errors
REFINEMENTS = {
    "list": {},
    "EXIF": {"refinement": _REFINED},
    "guess": {"estimation": {"estimate_focal_length": True}, "refinement": _REFINED},
}


def infer(image: Path | np.ndarray) -> tuple[pycolmap.Camera, str]:
    """Infer the intrinsics of a photo.

    Args:
        image: its file, or its pixels (H, W) or (H, W, 3).

    Returns:
        A SIMPLE_RADIAL camera without distortion, and a key of `REFINEMENTS`: "EXIF" or "guess".

    Raises:
        InputError: when the image cannot be read.
    """
    if isinstance(image, np.ndarray):
        height, width = image.shape[:2]
        params = [GUESSED_FOCAL * max(width, height), width / 2, height / 2, 0]
        camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=width, height=height, params=params)
        return camera, "guess"
    camera, has_focal_length = colmap.infer_camera(image)
    return camera, "EXIF" if has_focal_length else "guess"


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
