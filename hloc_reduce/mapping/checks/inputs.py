"""What checks of a map look at."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
import pycolmap

from ..epipolar import Pair
from ..registration import Registration

MIN_TELLING_POINTS = 100  # fewer tell nothing of a photo, or of two groups of photos


class Localize(Protocol):
    """Localizes photos by other photos of a map."""

    def __call__(
        self, names: Collection[str], by: Collection[str], mirrored: bool
    ) -> Mapping[str, Mapping[str, float]]:
        """Localize photos, or their mirror images, by some of the photos of the map.

        Returns:
            From photo to its `confidence` and `agreement`; photos that cannot be read are left out.
        """


@dataclass(frozen=True)
class Inputs:
    """A map and what is known of it. A check that needs more than is given finds nothing.

    Args:
        model: the map, with all keypoints of its images.
        verified: the matches (M, 2) of pairs that agree with a two-view geometry.
        matches: match file of the images; default: only `verified` matches are known.
        image_dir: folder of the photos.
        cameras: from id to the camera before the model was reconstructed, with the focal length of
            EXIF data or a guess.
        registration: which photos were to be in the map, and why some are not.
        typical: sizes (width, height) of photos by a typical lens, see `intrinsics.MapCameras`;
            default: those of the model.
        localize: localizes photos by others.
        matched: the pairs of photos that were matched, whether they have matches or not; photos in
            none of them were matched with all others. Default: all pairs.
    """

    model: pycolmap.Reconstruction
    verified: Mapping[Pair, np.ndarray] | None = None
    matches: Path | None = None
    image_dir: Path | None = None
    cameras: Mapping[int, pycolmap.Camera] | None = None
    registration: Registration | None = None
    typical: Collection[tuple[int, int]] | None = None
    localize: Localize | None = None
    matched: Collection[Pair] | None = None

    @cached_property
    def images(self) -> list[pycolmap.Image]:
        """The images with a pose, by id."""
        return [self.model.images[i] for i in sorted(self.model.reg_image_ids())]

    @cached_property
    def names(self) -> list[str]:
        """The names of the images with a pose, sorted."""
        return sorted(image.name for image in self.images)

    @cached_property
    def frames(self) -> np.ndarray:
        """The frame of each image (N,), from 0: photos that a rig took at one moment share one."""
        return np.unique([image.frame_id for image in self.images], return_inverse=True)[1]

    @cached_property
    def keypoints(self) -> dict[str, np.ndarray]:
        """The keypoints (N, 2) of each image, COLMAP's pixels."""
        return {
            image.name: np.array([point.xy for point in image.points2D]).reshape(-1, 2)
            for image in self.images
        }
