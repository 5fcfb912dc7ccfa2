"""Check what users give to a `Localizer`."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import pycolmap

from ..localization.rigs import NOT_UNIT
from ..utils import masks
from ..utils.cli import InputError

Image = Path | str | np.ndarray


class Photo(NamedTuple):
    """A photo.

    Args:
        image: its file or pixels.
        kept: (H, W) bool, the pixels that are not masked; None for all.
    """

    image: Path | np.ndarray
    kept: np.ndarray | None

    @classmethod
    def of(cls, image: Image, mask: Image | None) -> Self:
        """Return the photo of an image and a mask, which are files or pixels.

        Raises:
            InputError: if one is neither, or the mask cannot be read or is all 0.
        """
        if mask is None:
            return cls(pixels_or_file(image), None)
        given = pixels_or_file(mask)
        kept = masks.kept(given) if isinstance(given, np.ndarray) else masks.read(given)
        return cls(pixels_or_file(image), kept)


def pixels_or_file(image: Image) -> Path | np.ndarray:
    """Return pixels, or the path of a file; raise an InputError for what is neither."""
    if isinstance(image, np.ndarray):
        return image
    if not isinstance(image, str | PathLike):
        said = "cv2.imread returns that for a file that it cannot read" if image is None else image
        raise InputError(f"An image is a file or an array, not {type(image).__name__}: {said}.")
    return Path(image)


def check_pose(near: object) -> None:
    """Raise an InputError for what is no pose."""
    if not _is_pose(near):
        raise InputError(
            "near is a pose, camera from world, a finite pycolmap.Rigid3d with a unit quaternion."
        )


def _is_pose(one: object) -> bool:
    """Tell whether something is a finite pose with a unit quaternion: pycolmap takes others."""
    if not isinstance(one, pycolmap.Rigid3d) or not np.isfinite(one.matrix()).all():
        return False
    return bool(abs(np.linalg.norm(one.rotation.quat) - 1) <= NOT_UNIT)


def check_rig(
    images: Sequence,
    cameras: Sequence,
    cams_from_rig: Sequence,
    names: Sequence[str],
    masks: Sequence,
) -> None:
    """Raise an InputError unless there is one of each, of the right type, for every camera."""
    numbers = [len(part) for part in (images, cameras, cams_from_rig, names, masks)]
    if not images or len({*numbers}) > 1:
        said = "{} images, {} cameras, {} poses, {} names and {} masks".format(*numbers)
        raise InputError(f"A rig needs one of each for every camera, not {said}.")
    if not all(isinstance(one, pycolmap.Camera) for one in cameras):
        raise InputError("The cameras of a rig are pycolmap.Camera: their intrinsics are needed.")
    if not all(map(_is_pose, cams_from_rig)):
        raise InputError(
            "The poses of the cameras in a rig are pycolmap.Rigid3d, camera from rig, finite and "
            "with unit quaternions."
        )
