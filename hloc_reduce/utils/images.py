"""Images: their names and their pixels."""

from collections.abc import Iterable, Mapping
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
CONVERT = (
    "Convert HEIC photos and keep their EXIF data, for example with: magick mogrify -format jpg"
)


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
        suffixes = sorted({Path(other).suffix for other in others})
        of_phones = [f"*{one}" for one in suffixes if one.lower() in (".heic", ".heif")]
        hint = f" {CONVERT} {' '.join(of_phones)}" if of_phones else ""
        if not names:
            there_are = f" It has {some(others)}, but only {read} are read." if others else ""
            raise InputError(f"There is no image in {within}.{there_are}{hint}")
        if others:
            logger.warning(
                "%d photos and videos in %s are ignored, as only %s are read: %s.%s",
                *(len(others), within, read, some(others), hint),
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


def resized(image: Path | np.ndarray, preprocessing: Mapping) -> tuple[np.ndarray, np.ndarray]:
    """Read an image and resize its longer side to at most `resize_max` pixels.

    With `resize_force` smaller images are enlarged to `resize_max` pixels.

    Args:
        image: its file, or its pixels (H, W) or (H, W, 3) RGB, uint8.
        preprocessing: `grayscale`, `resize_max`, `resize_force` of a feature's configuration; and
            `mirrored`, whether to swap left and right.

    Returns:
        The image, (H, W) if `grayscale`, else (H, W, 3) RGB, float32 in [0, 1], and its original
        (width, height).

    Raises:
        InputError: when it cannot be read.
    """
    grayscale = preprocessing.get("grayscale", False)
    pixels = (
        convert(image, grayscale) if isinstance(image, np.ndarray) else read_image(image, grayscale)
    )
    if preprocessing.get("mirrored"):
        pixels = pixels[:, ::-1]
    pixels = pixels.astype(np.float32)
    size = np.array(pixels.shape[1::-1])
    resize_max = preprocessing.get("resize_max")
    if resize_max and (size.max() > resize_max or preprocessing.get("resize_force")):
        # at least one pixel: a panorama may be a thousand times wider than high
        new_size = np.maximum(1, np.round(size * (resize_max / size.max())).astype(int))
        smaller = (new_size <= size).all()
        interpolation = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR  # as hloc
        pixels = cv2.resize(pixels, new_size.tolist(), interpolation=interpolation)
    return pixels / 255, size


def in_original(features: dict, shape: tuple[int, ...], size: np.ndarray, noise: float) -> dict:
    """Return the features of a resized image in pixels of the original one.

    Args:
        features: `keypoints` (N, 2), and perhaps `scales` (N,) and `blur`, in pixels.
        shape: height and width of the resized image, and perhaps more.
        size: original (width, height).
        noise: standard deviation of the keypoints in pixels of the resized image.

    Returns:
        All features, with `image_size` (2,), `uncertainty` and `blur`, pixels.
    """
    ratio = (size / np.array(shape[1::-1])).astype(np.float32)
    features = {**features, "keypoints": (features["keypoints"] + 0.5) * ratio - 0.5}
    if "scales" in features:
        features["scales"] = features["scales"] * ratio.mean()
    features["image_size"] = size
    features["uncertainty"] = noise * ratio.mean()
    features["blur"] = features.get("blur", 0.0) * ratio.mean()
    return features


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
