"""Images: their names and their pixels."""

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from .. import logger
from .cli import InputError, no_folder, some
from .parsers import check_names, image_names

IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png"}
# photos and videos of other types, which are named and ignored
_OTHERS = (
    "arw avif bmp cr2 cr3 dng gif heic heif jp2 nef orf ppm raf rw2 tif tiff webp "
    "3gp avi m4v mkv mov mp4 mpeg mpg mts webm wmv"
)
OTHER_SUFFIXES = {f".{name}" for name in _OTHERS.split()}


def list_images(
    image_dir: Path, image_list: Path | str | Iterable[str] | None = None, folder: str = ""
) -> list[str]:
    """Return the names of the images in a folder or in a list.

    Args:
        image_dir: the folder that names are relative to.
        image_list: names, or a text file of them; default: every image in `folder`.
        folder: a folder in `image_dir`.

    Raises:
        InputError: when there is no image, or an image of the list is missing.
    """
    within = Path(image_dir, folder)
    if not within.is_dir():
        raise no_folder(within)
    if image_list is None:
        files = sorted(p.relative_to(image_dir) for p in within.rglob("*") if not p.is_dir())
        names = [file.as_posix() for file in files if file.suffix.lower() in IMAGE_SUFFIXES]
        others = [str(file) for file in files if file.suffix.lower() in OTHER_SUFFIXES]
        read = ", ".join(sorted(IMAGE_SUFFIXES))
        if not names:
            there_are = f" It has {some(others)}, but only {read} are read." if others else ""
            raise InputError(f"There is no image in {within}.{there_are}")
        if others:
            logger.warning(
                "%d photos and videos in %s are ignored, as only %s are read: %s.",
                *(len(others), within, read, some(others)),
            )
        return check_names(names, within)
    names = image_names(image_list)
    missing = [name for name in names if not (image_dir / name).is_file()]
    if missing:
        raise InputError(
            f"{len(missing)} of {len(names)} images are not in {image_dir}: {some(missing)}"
        )
    return names


def convert(image: np.ndarray, grayscale: bool) -> np.ndarray:
    """Convert pixels (H, W) or (H, W, 3) RGB, uint8, to (H, W) if `grayscale`, else (H, W, 3).

    Raises:
        InputError: for arrays of another shape or type.
    """
    if image.dtype != np.uint8 or image.shape[2:] not in ((), (3,)) or image.size == 0:
        raise InputError(
            f"An image is uint8 (H, W) or (H, W, 3) RGB, not {image.dtype} {image.shape}."
        )
    if image.ndim == 3 and grayscale:
        return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB) if image.ndim == 2 and not grayscale else image


class UnreadableImage(InputError):
    """An image file is missing or cannot be read."""


def read_image(path: Path, grayscale: bool = False) -> np.ndarray:
    """Read an image as uint8, (H, W) or (H, W, 3) RGB, without applying EXIF's rotation.

    Raises:
        UnreadableImage: when OpenCV cannot read the file.
    """
    mode = cv2.IMREAD_GRAYSCALE if grayscale else cv2.IMREAD_COLOR
    try:
        data = np.fromfile(path, np.uint8)
        image = cv2.imdecode(data, mode | cv2.IMREAD_IGNORE_ORIENTATION) if data.size else None
        reason = "it is not an image, or it is truncated" if data.size else "it is empty"
    except OSError as error:
        image, reason = None, str(error.strerror)
    except cv2.error as error:
        image, reason = None, f"OpenCV requires {error.err}"
    if image is None:
        raise UnreadableImage(f"Cannot read image {path}: {reason}.")
    return image if grayscale else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
