"""Tell whether a map of photos alone fits much better if the photos were cropped."""

import copy

import pycolmap

from .. import logger
from ..mapping.extension import OPTIONS

LARGEST = 200  # images: adjusting more takes minutes, and more photos bend a map less
# Cropped photos, and others with wrong focal lengths, gain 14 % and more, those of sound maps at
# most 9 % (docs/results.md)
GAIN = 0.12


def gain(sfm: pycolmap.Reconstruction) -> float:
    """Measure how much better the photos of a map fit with free principal points.

    A principal point that is assumed in the centre, although a photo was cropped, bends the poses
    and points of all photos, so that every single one still fits.

    Args:
        sfm: the map, whose intrinsics were estimated with its poses.

    Returns:
        The share by which the mean reprojection error falls, beyond that which so many parameters
        more explain; 0 for more than LARGEST images.
    """
    cameras, images = len(sfm.cameras), sfm.num_reg_images()
    residuals = 2 * sfm.compute_num_observations() - 3 * sfm.num_points3D() - 6 * images
    if images > LARGEST or residuals <= 4 * cameras:
        return 0.0
    error = sfm.compute_mean_reprojection_error()
    freed = copy.deepcopy(sfm)
    options = OPTIONS.get_global_bundle_adjustment()
    options.refine_principal_point = True
    options.print_summary = False
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in freed.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, freed).solve()
    freed.update_point_3d_errors()
    by_chance = (1 - 2 * cameras / residuals) ** 0.5
    return 1 - freed.compute_mean_reprojection_error() / (error * by_chance) if error else 0.0


def warn(gained: float) -> None:
    """Warn that the photos of a map may be cropped if they fit much better so."""
    if gained > GAIN:
        logger.warning(
            "The photos fit %.0f %% better if their principal points are not in their centres: "
            "they may be cropped, or have wrong focal lengths, and positions may be off by a tenth "
            "of the distance and more. Uncropped photos, a COLMAP model with known intrinsics, or "
            "--camera_mode single for photos of one camera help.",
            100 * gained,
        )
