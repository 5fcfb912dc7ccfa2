"""What the EXIF data of photos tell about their intrinsics."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from PIL import Image

MAKE, MODEL, EXIF = 0x010F, 0x0110, 0x8769  # EXIF tags
ZOOM, FOCAL_35MM, FOCAL_LENGTH = 0xA404, 0xA405, 0x920A
WIDTH, HEIGHT = 0xA002, 0xA003  # as the camera wrote it
FOCAL_PLANE = 0xA20E  # its pixels in a unit of length, which say how large they are
MAX_ZOOM = 1.01
RESHAPED = 1.02  # ratio of aspect ratios: a copy of another size differs by rounding only
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
        scale: by which COLMAP's focal length in pixels is to be multiplied. COLMAP computes it from
            the size of the camera's pixels, if EXIF data give that and no focal length in 35 mm
            film. Those of a photo that was made smaller are larger.
    """

    model: str
    lens: str
    size: tuple[int, int]
    zoomed: bool
    cropped: bool = False
    scale: float = 1.0

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
        by_pixels = not more.get(FOCAL_35MM) and float(more.get(FOCAL_PLANE) or 0) > 0
    except Exception:  # Pillow raises many types for broken data
        return None
    if not (model and focal_length > 0):
        return None
    name, lens = f"{make} {model}", f"{make} {model} {focal_length:g} mm"
    scale = max(size) / taken[1] if by_pixels and taken else 1.0
    return ExifCamera(name, lens, size, zoom > MAX_ZOOM, _is_cropped(size, taken), scale)


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
