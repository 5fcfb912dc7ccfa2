"""Tell queries that networks see turned against the photos of a map.

Hardly any match of these is right. Networks see photos as EXIF data turn them upright, those of
older maps as they are stored.
"""

from pathlib import Path

import numpy as np

from ..confs.features import RECOMMENDED
from ..utils.images import TURNS, orientation, stored_size
from .intrinsics import MapCameras

REMEDY = (
    "which this feature does not match: store all photos the same way up, or build the map with a "
    f"feature such as {RECOMMENDED}"
)

# EXIF orientations of photos whose width is their height when they are upright
QUARTER = {one for one, turns in TURNS.items() if turns % 2}


def reason(image: Path | np.ndarray, of_map: MapCameras, upright: bool = False) -> str | None:
    """Say how a photo is turned against those of a map, and what to do; None if it is not.

    EXIF orientations tell; where these are not known, the shapes of the photos.

    Args:
        image: its file, or its pixels (H, W) or (H, W, 3), whose EXIF data are not known.
        of_map: what the map tells about its photos.
        upright: networks see photos as EXIF data turn them.
    """
    others = of_map.orientations
    own = None if isinstance(image, np.ndarray) else orientation(image)
    if own is not None and others:
        if upright or own in others:
            return None
        theirs = ", ".join(map(str, sorted(others)))
        return (
            f"it is stored turned against the map's photos (EXIF orientation {own}, "
            f"theirs {theirs}), {REMEDY}"
        )
    size = image.shape[1::-1] if isinstance(image, np.ndarray) else stored_size(image)
    if size is None:
        return None
    width, height = size if not (upright and own in QUARTER) else size[::-1]
    shape, theirs = ("landscape", "portrait") if width > height else ("portrait", "landscape")
    sizes = {*of_map.sizes, *of_map.lenses}
    if upright and not QUARTER.isdisjoint(others):
        sizes = {other[::-1] for other in sizes if QUARTER.issuperset(others)}
    if width != height and sizes and all(_is(theirs, *other) for other in sizes):
        return (
            f"it may be stored turned against the map's photos ({shape}, theirs {theirs}), {REMEDY}"
        )
    return None


def options(image: Path | np.ndarray, of_map: MapCameras, preprocessing: dict) -> dict:
    """Return the options of `query.localize` for a photo, none unless `reason` tells one."""
    found = reason(image, of_map, preprocessing.get("upright", False))
    return {} if found is None else {"photo": {"turned": found}}


def _is(shape: str, width: int, height: int) -> bool:
    """Tell whether a photo is landscape or portrait."""
    return width > height if shape == "landscape" else width < height
