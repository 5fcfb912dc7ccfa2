"""What the EXIF data of photos tell about their intrinsics."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pycolmap
from PIL import Image

MAKE, MODEL, EXIF = 0x010F, 0x0110, 0x8769  # EXIF tags
ZOOM, FOCAL_35MM, FOCAL_LENGTH = 0xA404, 0xA405, 0x920A
WIDTH, HEIGHT = 0xA002, 0xA003  # as the camera wrote it
FOCAL_PLANE, UNIT = 0xA20E, 0xA210  # pixels of the sensor in a unit of length
UNITS = {2: 25.4, 3: 10.0}  # millimetres
ROUNDED = 0.02  # relative difference of zooms, shapes and focal lengths that are the same
MAX_RATIO = 10.0  # of width and height in EXIF data: others are nonsense
WELL_KNOWN = 3  # images from which the map knows the intrinsics of their camera


class ExifCamera(NamedTuple):
    """The camera that took a photo, by its EXIF data.

    Args:
        model: make and model.
        lens: make, model and focal length.
        size: (width, height) of the photo, which determines its intrinsics together with the lens.
        zoomed: digitally, which changes the intrinsics but not always the focal length in EXIF.
        cropped: or stretched: the photo has another ratio of width and height than its EXIF data
            say, or is square, which hardly any camera takes.
        full_size: the longer side of the photo as the camera wrote it, and its focal length, both
            in pixels, if EXIF data give the size of the sensor's pixels; else 0.
    """

    model: str
    lens: str
    size: tuple[int, int]
    zoomed: bool
    cropped: bool = False
    full_size: tuple[float, float] = (0.0, 0.0)

    @property
    def name(self) -> str:
        """The lens and the size."""
        return f"{self.lens} {self.size[0]}x{self.size[1]}"

    @property
    def is_original(self) -> bool:
        """Whether the lens and the size determine the intrinsics."""
        return not (self.zoomed or self.cropped)


def exif_camera(image: Path) -> ExifCamera | None:
    """Return the camera that took a photo, None if EXIF data do not tell."""
    try:
        with Image.open(image) as opened:
            size, exif = opened.size, opened.getexif()
        more = exif.get_ifd(EXIF)
        make, model = (str(exif.get(tag, "")).strip("\0 ") for tag in (MAKE, MODEL))
        focal_length = float(more.get(FOCAL_35MM) or more.get(FOCAL_LENGTH) or 0)
        zoom = float(more.get(ZOOM) or 1)
        taken = _sides([more.get(tag) for tag in (WIDTH, HEIGHT)])
    except Exception:  # Pillow raises many types for broken data
        return None
    if not (model and focal_length > 0):
        return None
    name, lens = f"{make} {model}", f"{make} {model} {focal_length:g} mm"
    full_size = (taken[1], _in_pixels(more)) if taken else (0.0, 0.0)
    return ExifCamera(name, lens, size, zoom > 1 + ROUNDED, _is_cropped(size, taken), full_size)


def _in_pixels(more: Mapping[int, Any]) -> float:
    """Return the focal length in pixels of the sensor, 0 if EXIF data do not tell."""
    try:
        return float(more[FOCAL_LENGTH]) * float(more[FOCAL_PLANE]) / UNITS[more[UNIT]]
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return 0.0


def correct(camera: pycolmap.Camera, exif: ExifCamera) -> bool:
    """Correct the focal length that COLMAP inferred for a photo that was made smaller.

    If EXIF data give no focal length in 35 mm film, COLMAP may take the size of the sensor's pixels
    for that of the photo's, which are larger.

    Args:
        camera: of the photo, changed in place.
        exif: of the photo.

    Returns:
        Whether it was wrong.
    """
    side, focal_length = exif.full_size
    if not (camera.has_prior_focal_length and exif.is_original and max(exif.size) < side):
        return False
    if not abs(camera.mean_focal_length() - focal_length) < ROUNDED * focal_length:
        return False
    params = camera.params.copy()
    params[list(camera.focal_length_idxs())] *= max(exif.size) / side
    camera.params = params.tolist()
    return True


def _sides(taken: Sequence[object]) -> tuple[float, float] | None:
    """Return the shorter and the longer side in EXIF data, None if they cannot be right.

    Photos may have been turned.
    """
    try:
        shorter, longer = sorted(float(value) for value in taken)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return (shorter, longer) if 0 < longer <= MAX_RATIO * shorter else None


def _is_cropped(size: tuple[int, int], taken: tuple[float, float] | None) -> bool:
    """Tell whether a size is square or has another aspect ratio than one in EXIF data, if known."""
    aspect = max(size) / min(size)
    if aspect < 1 + ROUNDED or taken is None:
        return aspect < 1 + ROUNDED
    shorter, longer = taken
    return not 1 / (1 + ROUNDED) <= aspect * shorter / longer <= 1 + ROUNDED
