"""What the EXIF data of photos tell about their intrinsics."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pycolmap
from PIL import Image

MAKE, MODEL, ORIENTATION, EXIF = 0x010F, 0x0110, 0x0112, 0x8769  # EXIF tags
ZOOM, FOCAL_35MM, FOCAL_LENGTH = 0xA404, 0xA405, 0x920A
WIDTH, HEIGHT = 0xA002, 0xA003  # as the camera wrote it
FOCAL_PLANE, UNIT = 0xA20E, 0xA210  # pixels of the sensor in a unit of length
UNITS = {2: 25.4, 3: 10.0}  # millimetres
ORIENTATIONS = range(1, 9)
MAX_ZOOM = 1.01
RESHAPED = 1.02  # ratio of aspect ratios: a copy of another size differs by rounding only
MAX_RATIO = 10.0  # of width and height in EXIF data: others are nonsense
SAME = 0.01  # relative difference of focal lengths that are the same
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
    return ExifCamera(name, lens, size, zoom > MAX_ZOOM, _is_cropped(size, taken), full_size)


def orientation(image: Path) -> int | None:
    """Return the EXIF orientation of a photo, None if EXIF data do not tell."""
    try:
        with Image.open(image) as opened:
            found = opened.getexif().get(ORIENTATION)
    except Exception:  # Pillow raises many types for broken data
        return None
    return int(found) if found is not None and found in ORIENTATIONS else None


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
    if not abs(camera.mean_focal_length() - focal_length) < SAME * focal_length:
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
    if aspect < RESHAPED or taken is None:
        return aspect < RESHAPED
    shorter, longer = taken
    return not 1 / RESHAPED <= aspect * shorter / longer <= RESHAPED


def of_another_size(image_dir: Path, names: Iterable[str]) -> list[str]:
    """Return photos whose size tells that their intrinsics are unlike those of most of a lens.

    Most are those with one longer side, if they are more than half of the photos of the lens. One
    or two photos with another longer side are smaller copies or were cropped; three are another
    setting of the camera. Photos that were cropped by their EXIF data differ however many there
    are. Digital zooms, which EXIF data tell, do not count.

    Args:
        image_dir: the folder of the photos.
        names: the photos.
    """
    whole: dict[str, dict[int, list[str]]] = {}
    cut: dict[str, list[str]] = {}
    for name in names:
        exif = exif_camera(image_dir / name)
        if exif is not None and exif.cropped:
            cut.setdefault(exif.lens, []).append(name)
        elif exif is not None and not exif.zoomed:
            whole.setdefault(exif.lens, {}).setdefault(max(exif.size), []).append(name)
    found: list[str] = []
    for lens, sides in whole.items():
        most, cropped = max(map(len, sides.values())), cut.get(lens, [])
        if most >= WELL_KNOWN and 2 * most > sum(map(len, sides.values())) + len(cropped):
            few = [named for named in sides.values() if len(named) < WELL_KNOWN]
            found += sum(few, cropped)
    return sorted(found)


def cropped(image_dir: Path, names: Iterable[str]) -> list[str]:
    """Return the photos of a folder that were cropped by their EXIF data or shape, sorted."""
    found = {name: exif_camera(image_dir / name) for name in names}
    return sorted(name for name, exif in found.items() if exif is not None and exif.cropped)
