"""Masks of photos, laid out as COLMAP's: keypoints in black pixels are dropped.

The mask of `a/photo.jpg` is `a/photo.jpg.png` in the folder of masks. A file in place of a folder
is the mask of all photos of its size.
"""

import os
from collections.abc import Collection, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from .cli import InputError, no_folder
from .files import file_sha256
from .images import IMAGE_SUFFIXES, stored_size
from .progress import progress

SUFFIX = ".png"  # beyond the name of the photo


class Mask(NamedTuple):
    """The mask of a photo.

    Args:
        path: its file.
        size: width and height.
        sha256: of the file.
    """

    path: Path
    size: tuple[int, int]
    sha256: str


def kept(mask: np.ndarray, what: str = "The mask") -> np.ndarray:
    """Return which pixels of a mask (H, W) or (H, W, 3) are not black, (H, W) bool.

    Raises:
        InputError: for arrays of another shape, or without a pixel that is not black; the message
            begins with `what`.
    """
    is_image = mask.ndim == 2 or mask.shape[2:] == (3,)
    if mask.dtype.kind not in "bui" or not is_image or mask.size == 0:
        raise InputError(
            f"{what} is not (H, W), bool or uint8, 0 where a photo is ignored, but {mask.dtype} "
            f"{mask.shape}."
        )
    found: np.ndarray = mask != 0
    if found.ndim == 3:
        found = found[..., 0] | found[..., 1] | found[..., 2]
    if not found.any():
        raise InputError(
            f"{what} is all black, so that its photo would have no keypoint: black is ignored, "
            "white is kept."
        )
    return found


def read(path: Path) -> np.ndarray:
    """Return which pixels of a mask's file are not black, (H, W) bool.

    Raises:
        InputError: if it cannot be read, is not an image, or is all black.
    """
    try:
        data = np.fromfile(path, np.uint8)
        # at full depth: numbers of objects in 16 bits may be small
        how = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        pixels = cv2.imdecode(data, how) if data.size else None
    except OSError as error:
        raise InputError(f"Cannot read the mask {path}: {error.strerror}.") from None
    except cv2.error:  # of more pixels than it reads
        pixels = None
    if pixels is None:
        raise InputError(f"The mask {path} is not an image, or it is truncated.")
    return kept(pixels, f"The mask {path}")


def find(masks: Path | None, image_dir: Path, names: Collection[str]) -> dict[str, Mask]:
    """Return the masks of photos by name; photos without one are not masked.

    Args:
        masks: folder of masks, or one mask for all photos of its size; None for no masks.
        image_dir: folder of the photos.
        names: the photos.

    Raises:
        InputError: if there are no such masks, none belongs to a photo in `image_dir`, or a mask is
            broken, all black, or of another size than its photo.
    """
    if masks is None:
        return {}
    files = _files(masks, image_dir, names)
    if not files:
        check(masks, [image_dir])
    found = {
        name: _inspect(path, *_state(path))
        for name, path in progress(files.items(), "Reading masks", "mask")
    }
    for name, mask in found.items():
        size = stored_size(image_dir / name)
        if size not in (None, mask.size):  # whether a photo can be read is said elsewhere
            raise _other_size(mask, image_dir / name, size)
    return found


def digests(found: Mapping[str, Mask]) -> dict[str, str]:
    """Return the sha256 of masks by the names of their photos."""
    return {name: mask.sha256 for name, mask in found.items()}


def those_of(masks: Path | None, image_dir: Path) -> Path | None:
    """Return masks if one belongs to a photo in a folder, else None; arguments as in `find`."""
    return masks if masks is not None and _applies(masks, image_dir) else None


def check(masks: Path, image_dirs: Collection[Path]) -> None:
    """Raise an InputError unless there are masks, and one belongs to a photo in these folders."""
    for image_dir in image_dirs:
        if not image_dir.is_dir():
            raise no_folder(image_dir)
    if any(_applies(masks, image_dir) for image_dir in image_dirs):
        return
    where = " or ".join(map(str, image_dirs))
    if not masks.is_dir():
        width, height = stored_size(masks) or (0, 0)
        raise InputError(
            f"No photo in {where} has the size of the mask {masks}, {width}x{height} pixels."
        )
    photo, folder = next(((p, d) for d in image_dirs for p in _photos(d)), (None, None))
    example = ""
    if photo is not None and folder is not None:
        name = photo.relative_to(folder).as_posix()
        example = f" That of {name} would be {masks / name}{SUFFIX}."
    raise InputError(f"No mask in {masks} belongs to a photo in {where}.{example}")


def _applies(masks: Path, image_dir: Path) -> bool:
    """Tell whether a mask belongs to a photo in a folder."""
    if not _is_folder(masks):
        size = _inspect(masks, *_state(masks)).size
        return any(stored_size(photo) == size for photo in _photos(image_dir))
    found = (mask.relative_to(masks).as_posix() for mask in _walk(masks, {SUFFIX}))
    return any((image_dir / name.removesuffix(SUFFIX)).is_file() for name in found)


def _is_folder(masks: Path) -> bool:
    if not masks.exists():
        raise InputError(f"There is no folder or file {masks} of masks.")
    return masks.is_dir()


def _files(masks: Path, image_dir: Path, names: Collection[str]) -> dict[str, Path]:
    """Return the files of masks by the names of their photos."""
    if _is_folder(masks):
        files = {name: masks / f"{name}{SUFFIX}" for name in names}
        return {name: path for name, path in files.items() if path.is_file()}
    size = _inspect(masks, *_state(masks)).size
    return {name: masks for name in names if stored_size(image_dir / name) == size}


def _photos(image_dir: Path) -> Iterator[Path]:
    """Yield the photos in a folder."""
    return _walk(image_dir, IMAGE_SUFFIXES)


def _walk(root: Path, suffixes: Collection[str]) -> Iterator[Path]:
    """Yield the files in a folder, also behind links to folders, whose names end so."""
    for folder, _, names in os.walk(root, followlinks=True):
        yield from (Path(folder, n) for n in sorted(names) if Path(n).suffix.lower() in suffixes)


def _state(path: Path) -> tuple[int, int]:
    """Return the size and the time of a file."""
    status = path.stat()
    return status.st_size, status.st_mtime_ns


@cache  # the stages of a run ask for the same masks
def _inspect(path: Path, size: int, time: int) -> Mask:
    """Read a mask in a file of this size and time."""
    height, width = read(path).shape
    return Mask(path, (width, height), file_sha256(path))


def _other_size(mask: Mask, photo: Path, size: tuple[int, int] | None) -> InputError:
    """Return the error for a mask that has another size than its photo."""
    width, height = size or (0, 0)
    hint = "Masks have the pixels of the photo's file"
    if mask.size == (height, width):
        hint += ", before EXIF data turn it"
    return InputError(
        f"The mask {mask.path} has {mask.size[0]}x{mask.size[1]} pixels, its photo {photo} has "
        f"{width}x{height}. {hint}."
    )
