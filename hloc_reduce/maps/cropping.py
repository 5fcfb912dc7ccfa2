"""Tell whether a map of photos alone fits much better if the photos were cropped."""

import copy

import pycolmap

from .. import logger
from ..mapping.extension import OPTIONS

LARGEST = 200  # images: adjusting more takes minutes, and more photos bend a map less
# cropped photos, and others with wrong focal lengths, gain 18 % and more, those of sound maps at
# most 9 % (docs/localize.md)
GAIN = 0.12


def gain(sfm: pycolmap.Reconstruction) -> float:
    """Measure how much better the photos of a map fit with free principal points.

    A principal point that is assumed in the centre, although a photo was cropped, bends the poses
    and points of all photos, so that every single one still fits.

    Args:
        sfm: the map, all of whose poses and intrinsics may be wrong.

    Returns:
        The share by which the mean reprojection error falls, less the part that the additional
        parameters alone explain; 0 for more than LARGEST images.
    """
    images = [sfm.images[i] for i in sfm.reg_image_ids()]
    cameras = len({image.camera_id for image in images})
    residuals = 2 * sfm.compute_num_observations() - 3 * sfm.num_points3D() - 6 * len(images)
    if len(images) > LARGEST or residuals <= 4 * cameras:
        return 0.0
    freed = copy.deepcopy(sfm)
    error = _adjusted_error(freed, refine_principal_point=False)
    by_chance = (1 - 2 * cameras / residuals) ** 0.5
    return 1 - _adjusted_error(freed, refine_principal_point=True) / (error * by_chance or 1.0)


def _adjusted_error(sfm: pycolmap.Reconstruction, refine_principal_point: bool) -> float:
    """Adjust a map, in place, and return its mean reprojection error in pixels."""
    options = OPTIONS.get_global_bundle_adjustment()
    options.refine_principal_point = refine_principal_point
    options.print_summary = False
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sfm.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, sfm).solve()
    sfm.update_point_3d_errors()
    return sfm.compute_mean_reprojection_error()


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
