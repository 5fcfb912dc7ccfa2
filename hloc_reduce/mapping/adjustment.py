"""Bundle adjustment of a whole model with other cameras than those that it was built with."""

import copy
from collections.abc import Callable

import numpy as np
import pycolmap

from ..utils import colmap
from .extension import OPTIONS


def with_cameras(
    sfm: pycolmap.Reconstruction, camera_of: Callable[[int], pycolmap.Camera]
) -> pycolmap.Reconstruction:
    """Copy the images, points and tracks of a model, with other cameras.

    Args:
        sfm: the model.
        camera_of: returns the camera of an image, by the id of the image.
    """
    made = pycolmap.Reconstruction()
    for image_id in sfm.reg_image_ids():
        image, camera = sfm.images[image_id], camera_of(image_id)
        keypoints = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        new = pycolmap.Image(image.name, keypoints, camera_id=camera.camera_id, image_id=image_id)
        colmap.add_image(made, camera, new, image.cam_from_world())
    for point in sfm.points3D.values():
        made.add_point3D(point.xyz, point.track)
    return made


def with_own_cameras(sfm: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Copy a model, with a camera for each image."""

    def own(image_id: int) -> pycolmap.Camera:
        camera = copy.deepcopy(sfm.cameras[sfm.images[image_id].camera_id])
        camera.camera_id = image_id
        return camera

    return with_cameras(sfm, own)


def with_one_camera(sfm: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Copy a model of cameras of one kind and size, with one for all images: their median."""
    cameras = [sfm.cameras[sfm.images[i].camera_id] for i in sfm.reg_image_ids()]
    shared = copy.deepcopy(cameras[0])
    shared.params = np.median([camera.params for camera in cameras], axis=0).tolist()
    return with_cameras(sfm, lambda _: shared)


def adjusted_error(sfm: pycolmap.Reconstruction, refine_principal_point: bool = False) -> float:
    """Adjust a model, in place, and return its mean reprojection error in pixels."""
    options = OPTIONS.get_global_bundle_adjustment()
    options.refine_principal_point = refine_principal_point
    options.print_summary = False
    solver = colmap.solver_options(options)
    # by COLMAP's limit of the gradient, 1, the adjustment of few points ends before it begins
    solver.gradient_tolerance, solver.function_tolerance = 1e-4, 1e-6
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sfm.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, sfm).solve()
    sfm.update_point_3d_errors()
    return sfm.compute_mean_reprojection_error()
