"""Photos that fit much better with other intrinsics: they were cropped or enlarged."""

import copy
from typing import NamedTuple

import numpy as np
import pycolmap

from ..adjustment import (
    GAIN_OF_FREE,
    MAX_ADJUSTED_IMAGES,
    adjusted_error,
    with_own_cameras,
    without_rigs,
)
from ..findings import Finding
from .inputs import MIN_TELLING_POINTS, Inputs

# photos that share a camera gain by cameras of their own, too: if none is unlike the others, up to
# 21 % in sound maps, and 31 % and more if many were cropped
GAIN_OF_OWN = 0.25
# a photo is altered if its focal length differs by more than this share of those of the others, or
# its principal point by this share of the longer side
UNLIKE_SHARE = 0.1


class Fit(NamedTuple):
    """How much better the photos of a map fit with other intrinsics.

    Attributes:
        gain: the share by which the mean reprojection error falls with free principal points, and
            perhaps a camera for each photo, less the part that the additional parameters explain.
        altered: photos with other intrinsics than most: these, or the others, were cropped or
            enlarged.
    """

    gain: float
    altered: list[str]


NOT_TRIED = Fit(0.0, [])


def measure(sfm: pycolmap.Reconstruction) -> Fit:
    """Adjust copies of a map with a camera for each photo and free principal points, and as it is.

    A principal point that is assumed in the centre, although a photo was cropped, bends the poses
    and points of all photos, so that every single one still fits. So does a focal length that a
    photo shares with others by its EXIF data, although it was enlarged.

    Args:
        sfm: the map, all of whose poses and intrinsics may be wrong.

    Returns:
        NOT_TRIED for more than MAX_ADJUSTED_IMAGES images, or too few points to tell.
    """
    images = [sfm.images[i] for i in sfm.reg_image_ids()]
    cameras = {i: len(sfm.cameras[i].params) for i in {image.camera_id for image in images}}
    own = sum(cameras[image.camera_id] for image in images)
    residuals = 2 * sfm.compute_num_observations() - 3 * sfm.num_points3D() - 6 * len(images)
    if len(images) > MAX_ADJUSTED_IMAGES or residuals <= 2 * own:
        return NOT_TRIED
    # photos of rigs by themselves, so that nothing but intrinsics makes a difference
    adjusted = copy.deepcopy(without_rigs(sfm))
    error = adjusted_error(adjusted)

    def gain(freed: pycolmap.Reconstruction, parameters: int) -> float:
        by_chance = (1 - parameters / residuals) ** 0.5
        return 1 - adjusted_error(freed, refine_principal_point=True) / (error * by_chance or 1.0)

    separate = with_own_cameras(adjusted)
    if len(cameras) < len(images):
        adjusted_error(separate)
    of_own = gain(separate, own - sum(cameras.values()) + 2 * len(cameras))
    if of_own > GAIN_OF_FREE and (altered := _altered(separate, _focal_lengths(adjusted))):
        return Fit(of_own, altered)
    if len(cameras) == len(images) or of_own > GAIN_OF_OWN:
        return Fit(of_own, [])
    return Fit(gain(adjusted, 2 * len(cameras)), [])


def _focal_lengths(sfm: pycolmap.Reconstruction) -> dict[str, float]:
    images = [sfm.images[i] for i in sfm.reg_image_ids()]
    return {image.name: sfm.cameras[image.camera_id].mean_focal_length() for image in images}


def _altered(sfm: pycolmap.Reconstruction, assumed: dict[str, float]) -> list[str]:
    """Return the photos whose intrinsics differ from those of the largest group of photos.

    Args:
        sfm: the map with free intrinsics.
        assumed: the focal length of each photo in the map as it was.
    """
    found = _focal_lengths(sfm)
    images = sorted((sfm.images[i] for i in sfm.reg_image_ids()), key=lambda image: image.name)
    zoom = np.array([np.log(found[image.name] / assumed[image.name]) for image in images])
    centre = np.array([_off_centre(sfm.cameras[image.camera_id]) for image in images])
    zoomed = np.abs(zoom[:, None] - zoom) > np.log1p(UNLIKE_SHARE)
    moved = np.abs(centre[:, None] - centre).max(axis=2) > UNLIKE_SHARE
    seen = np.array([image.num_points3D for image in images]) >= MIN_TELLING_POINTS
    differs = (zoomed | moved) & seen & seen[:, None]
    # of a photo that differs from the fewest of those that tell
    like_most = differs[np.where(seen, differs.sum(axis=1), len(images)).argmin()]
    return [image.name for image, differs in zip(images, like_most, strict=True) if differs]


def _off_centre(camera: pycolmap.Camera) -> np.ndarray:
    """Return where the principal point is, from the centre, in longer sides: (2,)."""
    principal_point = np.array([camera.principal_point_x, camera.principal_point_y])
    size = np.array([camera.width, camera.height])
    return (principal_point - size / 2) / size.max()


def find(inputs: Inputs) -> list[Finding]:
    """Find out whether the photos fit much better with other intrinsics, see `measure`."""
    fit = measure(inputs.model)
    return [finding(fit)] if fit.gain > GAIN_OF_FREE else []


def finding(fit: Fit) -> Finding:
    """Return the finding for photos that fit much better with other intrinsics."""
    better = f"{100 * fit.gain:.0f} % better"
    if fit.altered:
        text = (
            "The map may be wrong. Photos with another focal length or principal point than the "
            f"others: {{names}}. With other intrinsics, all photos fit {better}. Either these or "
            "the others were cropped or enlarged, and are misplaced, or the place is flat: use the "
            "original photos."
        )
    else:
        text = (
            f"The photos fit {better} if their principal points are not in their centres: they may "
            "be cropped, or have wrong focal lengths, and positions may be off by a tenth of the "
            "distance and more. Uncropped photos or a COLMAP model with known intrinsics help; so "
            "does --camera_mode single, if one camera took all photos and the map has several."
        )
    doubt = "photos that may be cropped or enlarged"
    return Finding("intrinsics", text, tuple(fit.altered), {"gain": fit.gain}, doubt=doubt)
