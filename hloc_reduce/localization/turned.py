"""Tell queries that are stored turned against the photos of a map.

Networks describe what they see the way up that it is stored, so that hardly any match of such a
query is right. Photos are read as they are stored: EXIF data only tell which way up that is.
"""

from pathlib import Path

import numpy as np

from ..confs.features import RECOMMENDED
from ..utils.images import stored_size
from .exif import orientation
from .intrinsics import MapCameras

REMEDY = (
    "which this feature does not match: store all photos the same way up, or build the map with a "
    f"feature such as {RECOMMENDED}"
)


def reason(image: Path | np.ndarray, of_map: MapCameras) -> str | None:
    """Say how a photo is stored turned against those of a map, and what to do; None if it is not.

    EXIF orientations tell; where these are not known, the shapes of the photos.

    Args:
        image: its file, or its pixels (H, W) or (H, W, 3), whose EXIF data are not known.
        of_map: what the map tells about its photos.
    """
    others = of_map.orientations
    own = None if isinstance(image, np.ndarray) or not others else orientation(image)
    if own is not None:
        if own in others:
            return None
        theirs = ", ".join(map(str, sorted(others)))
        return (
            f"it is stored turned against the map's photos (EXIF orientation {own}, "
            f"theirs {theirs}), {REMEDY}"
        )
    size = image.shape[1::-1] if isinstance(image, np.ndarray) else stored_size(image)
    if size is None:
        return None
    width, height = size
    shape, theirs = ("landscape", "portrait") if width > height else ("portrait", "landscape")
    sizes = {*of_map.sizes, *of_map.lenses}
    if width != height and sizes and all(_is(theirs, *other) for other in sizes):
        return (
            f"it may be stored turned against the map's photos ({shape}, theirs {theirs}), {REMEDY}"
        )
    return None


def options(image: Path | np.ndarray, of_map: MapCameras) -> dict:
    """Return the options of `query.localize` for a photo, none unless `reason` tells one."""
    found = reason(image, of_map)
    return {} if found is None else {"photo": {"turned": found}}


def _is(shape: str, width: int, height: int) -> bool:
    """Tell whether a photo is landscape or portrait."""
    return width > height if shape == "landscape" else width < height
