"""Lenses that no camera has."""

from collections import Counter

import pycolmap

from ...localization.exif import WELL_KNOWN
from ...localization.gate import focal_lengths
from ..findings import Finding
from .inputs import Inputs

MAX_DISTORTION = 1.0  # COLMAP's limit for images that it registers


def find(inputs: Inputs) -> list[Finding]:
    """Find the photos whose lenses are implausible.

    Their focal lengths in pixels or distortions are those of no lens, or their focal lengths are
    far from EXIF data, unless `WELL_KNOWN` photos or more share the camera: these estimate it
    better.
    """
    shared = Counter(image.camera_id for image in inputs.images)
    said, values = {}, {}
    for image in inputs.images:
        camera, number = inputs.model.cameras[image.camera_id], shared[image.camera_id]
        initial = (inputs.cameras or {}).get(image.camera_id)
        if initial and initial.model == camera.model and (initial.params == camera.params).all():
            continue  # it was not estimated: somebody gave it
        low, high = focal_lengths(
            initial or camera,
            initial is None or not initial.has_prior_focal_length or number >= WELL_KNOWN,
        )
        focal_length = camera.mean_focal_length()
        if not low <= focal_length <= high:
            values[image.name] = focal_length
            said[image.name] = (
                f"focal length {focal_length:.0f}" if focal_length > 0 else "no focal length fits"
            )
        elif is_distorted(camera):
            values[image.name] = distortion_of(camera)
            said[image.name] = f"distortion {values[image.name]:.1f}"
    if not said:
        return []
    named = ", ".join(f"{name} ({what})" for name, what in said.items())
    text = (
        "These photos have focal lengths in pixels or distortions that no lens has, or focal "
        f"lengths far from their EXIF data, so that their poses are wrong: {named}. Use the photos "
        "as the camera wrote them, neither cropped nor edited."
    )
    doubt = "photos with an implausible lens"
    return [Finding("lenses", text, tuple(said), values, "drop", doubt)]


def is_distorted(camera: pycolmap.Camera) -> bool:
    """Tell whether no lens has the distortion of a camera."""
    return abs(distortion_of(camera)) > MAX_DISTORTION


def distortion_of(camera: pycolmap.Camera) -> float:
    """Return the largest coefficient of distortion."""
    return max(camera.params[list(camera.extra_params_idxs())], key=abs, default=0.0)
