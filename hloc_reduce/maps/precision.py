"""Find photos of a map of photos alone whose positions its points hardly determine."""

from collections import Counter

import numpy as np
import pycolmap

from .. import logger
from ..localization.confidence import MAX_POSITION, uncertainty
from ..localization.projection import FOCAL, POSE
from ..mapping.plausibility import MANY
from ..utils import cli


def find(sfm: pycolmap.Reconstruction) -> dict[str, float]:
    """Find photos whose positions are less certain than `MAX_POSITION`.

    A distant photo of a nearly flat scene hardly tells a longer focal length from a larger
    distance. The intrinsics of a camera that took several photos are taken for known.

    Args:
        sfm: the map, whose intrinsics were estimated with its poses.

    Returns:
        From name to the standard deviation of the position, at most 1, as a share of the median
        depth of the points that the photo sees; the least certain first.
    """
    images = [sfm.images[i] for i in sfm.reg_image_ids()]
    taken = Counter(image.camera_id for image in images)
    found = {}
    for image in images:
        seen = [point for point in image.points2D if point.has_point3D()]
        points2D = np.array([point.xy for point in seen]).reshape(-1, 2)
        points3D = np.array([sfm.points3D[point.point3D_id].xyz for point in seen]).reshape(-1, 3)
        camera = sfm.cameras[image.camera_id]
        freedom = POSE if taken[image.camera_id] >= MANY else FOCAL
        position, *_ = uncertainty(points2D, points3D, image.cam_from_world(), camera, freedom)
        if position > MAX_POSITION:
            found[image.name] = min(position, 1.0)
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def warn(uncertain: dict[str, float]) -> None:
    """Warn of photos whose positions are uncertain, if there are any."""
    if uncertain:
        named = [
            f"{name} ({'at least ' * (share == 1)}{100 * share:.0f} %)"
            for name, share in uncertain.items()
        ]
        logger.warning(
            "The positions of these photos are uncertain by more than %.0f %% of their distance: "
            "%s. Queries near them may be localized as far off. More photos between them and the "
            "others help, or intrinsics: a COLMAP model, EXIF data, or --camera_mode single.",
            *(100 * MAX_POSITION, cli.some(named)),
        )
