"""The pose of a query whose lens may be one of several, or is not known at all."""

from dataclasses import replace
from typing import Any

import numpy as np
import pycolmap

from . import absolute_pose
from .calibration import UNCLEAR_CROPPED
from .confidence import MAX_POSITION, MAX_ROTATION
from .intrinsics import from_list
from .pose import Matches, Pose, differ, quality

SEVERAL = (
    "another lens of the map's photos of its size fits about as well, and the pose differs; known "
    "intrinsics would help"
)


def estimate(
    points2D: np.ndarray,
    points3D: np.ndarray,
    images: list[np.ndarray],
    camera: pycolmap.Camera,
    config: dict,
    *options: Any,
) -> Pose:
    """Estimate a pose with a camera and with each other lens that may have taken the photo.

    The pose with the highest confidence counts. If that of another lens is nearly as likely, but
    another pose, it is not trusted.

    Args:
        points2D: (M, 2) image points of all matches, COLMAP's pixels.
        points3D: (M, 3) their world points.
        images: of each map image the indices of its matches, the most similar first.
        camera: intrinsics.
        config: as in `absolute_pose.estimate`; under "photo" also the other "lenses", or a
            "refusal" if no lens is known, see `intrinsics.refinement`.
        options: the other arguments of `absolute_pose.estimate`.
    """
    photo = config.get("photo", {})
    if reason := photo.get("refusal"):
        return Pose(None, camera, np.zeros(len(points2D), bool), refusal=reason)
    tried = [Matches(points2D, points3D, camera, config)]
    tried += [tried[0].with_lens(from_list(lens)) for lens in photo.get("lenses", ())]
    poses = [
        absolute_pose.estimate(points2D, points3D, images, matches.camera, matches.config, *options)
        for matches in tried
    ]
    best = max(poses, key=quality)
    for other in poses:
        rivals = other.confidence >= UNCLEAR_CROPPED * best.confidence
        if rivals and differ(best, other, points3D, MAX_POSITION, MAX_ROTATION):
            return replace(best, refusal=best.refusal or SEVERAL)
    return best
