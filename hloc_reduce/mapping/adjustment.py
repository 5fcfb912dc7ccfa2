"""Bundle adjustment of a whole model with other cameras than those that it was built with."""

import copy
from collections.abc import Iterable
from typing import Any

import numpy as np
import pycolmap

from ..localization.projection import POSE, reprojection_errors
from ..utils import colmap
from .extension import OPTIONS

Model = pycolmap.CameraModelId
# of cameras whose intrinsics the mapper estimates
ESTIMATED_MODELS = {Model.SIMPLE_PINHOLE, Model.PINHOLE, Model.SIMPLE_RADIAL, Model.RADIAL}

MAX_ADJUSTED_IMAGES = 200  # adjusting more takes minutes, and more photos bend a map less
# cropped photos, and others with wrong focal lengths, gain 18 % and more, those of sound maps at
# most 10 % (docs/maps.md)
GAIN_OF_FREE = 0.12
PRECISE_KEYPOINTS = 0.1  # pixels, of the best keypoints: smaller errors tell nothing


def with_own_cameras(sfm: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Copy a model, with a camera for each image."""

    def own(image_id: int) -> pycolmap.Camera:
        camera = copy.deepcopy(sfm.cameras[sfm.images[image_id].camera_id])
        camera.camera_id = image_id
        return camera

    return colmap.with_cameras(sfm, own)


def without_rigs(sfm: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return a model with a pose of its own for each image: itself, or a copy if it has rigs."""
    if all(rig.num_sensors() == 1 for rig in sfm.rigs.values()):
        return sfm
    cameras = {i: copy.deepcopy(camera) for i, camera in sfm.cameras.items()}
    return colmap.with_cameras(sfm, lambda i: cameras[sfm.images[i].camera_id])


def scale_by_rigs(sfm: pycolmap.Reconstruction, known: Iterable[int]) -> None:
    """Adjust a model, in place, so that its scale is that of its rigs, if these have a baseline.

    COLMAP's mapper holds two images where they are when it adjusts a model, and with them the scale
    of its first points. It is off by some percent if the cameras of the rigs see different points.

    Args:
        sfm: of the mapper.
        known: ids of cameras whose intrinsics stay.
    """
    rigs = {sfm.frames[sfm.images[i].frame_id].rig_id for i in sfm.reg_image_ids()}
    poses = [pose for i in rigs for pose in sfm.rigs[i].non_ref_sensors.values()]
    if not any(pose is not None and pose.translation.any() for pose in poses):
        return
    _adjuster(sfm, known=known, is_scale_fixed=False).solve()
    sfm.update_point_3d_errors()


def with_one_camera(sfm: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Copy a model of cameras of one kind and size, with one for all images: their median."""
    cameras = [sfm.cameras[sfm.images[i].camera_id] for i in sfm.reg_image_ids()]
    shared = copy.deepcopy(cameras[0])
    shared.params = np.median([camera.params for camera in cameras], axis=0).tolist()
    return colmap.with_cameras(sfm, lambda _: shared)


def adjust(sfm: pycolmap.Reconstruction, options: pycolmap.IncrementalPipelineOptions) -> None:
    """Adjust a model, in place, by all of its points, with the mapper's options."""
    with colmap.near_origin(sfm):
        _adjuster(sfm, known=options.constant_cameras, mapper=options).solve()
    sfm.update_point_3d_errors()


def adjusted_error(sfm: pycolmap.Reconstruction, refine_principal_point: bool = False) -> float:
    """Adjust a model, in place, and return its mean reprojection error in pixels."""
    with colmap.near_origin(sfm):
        _adjuster(sfm, refine_principal_point).solve()
    sfm.update_point_3d_errors()
    return sfm.compute_mean_reprojection_error()


def gain_of_free_intrinsics(sfm: pycolmap.Reconstruction) -> float:
    """Adjust copies of a model with its intrinsics and with free ones.

    Poses are adjusted in both, as they may be imprecise.

    Returns:
        The share by which the median reprojection error falls with free intrinsics. That of
        `PRECISE_KEYPOINTS` keypoints is added to it.
    """
    errors = []
    for options in ({"known": [*sfm.cameras]}, {"refine_principal_point": True}):
        adjusted = copy.deepcopy(sfm)
        with colmap.near_origin(adjusted):
            _adjuster(adjusted, **options).solve()
        adjusted.update_point_3d_errors()
        median = np.median([point.error for point in adjusted.points3D.values()])
        errors.append(float(np.hypot(PRECISE_KEYPOINTS, median)))
    known, free = errors
    return 1 - free / known


def focal_length_deviations(sfm: pycolmap.Reconstruction) -> dict[int, float]:
    """Estimate how precisely an adjustment of a model determines its focal lengths.

    Poses, points and distortions are as unknown as these. Cameras of other models than
    `ESTIMATED_MODELS`, which somebody gave, are taken for known.

    Returns:
        From camera to the standard deviation of its focal length, as a share, to first order from
        the reprojection errors; infinite if the adjustment does not determine all parameters.
    """
    sfm = without_rigs(sfm)  # COLMAP computes no covariance of rigs
    images = [sfm.images[i] for i in sfm.reg_image_ids()]
    cameras = {image.camera_id: sfm.cameras[image.camera_id] for image in images}
    cameras = {i: camera for i, camera in cameras.items() if camera.model in ESTIMATED_MODELS}
    squares = np.concatenate([_errors(sfm, image) for image in images]) ** 2
    squares = squares[np.isfinite(squares)]  # not those of points behind a camera
    redundancy = 2 * len(squares) - 3 * sfm.num_points3D() - POSE * len(images)
    with colmap.near_origin(sfm):
        covariance = colmap.covariance(sfm, _adjuster(sfm, known={*sfm.cameras} - {*cameras}))
    if covariance is None or redundancy <= 0:
        return dict.fromkeys(cameras, np.inf)
    found = {}
    for camera_id, camera in cameras.items():
        (first, *_) = camera.focal_length_idxs()
        block = covariance.get_other_params_cov(camera.params)
        variance = np.nan if block is None else block[first, first]
        relative = variance / camera.params[first] ** 2
        found[camera_id] = float(np.sqrt(squares.sum() / redundancy * relative))
    # of a covariance that is nearly singular, some are wrong by chance
    return found if all(one < 1 for one in found.values()) else dict.fromkeys(cameras, np.inf)


def _errors(sfm: pycolmap.Reconstruction, image: pycolmap.Image) -> np.ndarray:
    """Return the reprojection errors (M,) of the points that an image sees, in pixels."""
    points2D, points3D = colmap.observed(sfm, image)
    camera = sfm.cameras[image.camera_id]
    return reprojection_errors(points2D, points3D, image.cam_from_world(), camera)[0]


def _adjuster(
    sfm: pycolmap.Reconstruction,
    refine_principal_point: bool = False,
    known: Iterable[int] = (),
    is_scale_fixed: bool = True,
    mapper: pycolmap.IncrementalPipelineOptions = OPTIONS,
) -> Any:
    """Prepare the adjustment of a whole model, but for the intrinsics of known cameras.

    One frame stays where it is, and, if its scale is fixed, a coordinate of another.
    """
    options = colmap.exact(mapper.get_global_bundle_adjustment())
    options.refine_principal_point = refine_principal_point
    options.print_summary = False
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sfm.reg_image_ids():
        config.add_image(image_id)
    for camera_id in known:
        config.set_constant_cam_intrinsics(camera_id)
    if is_scale_fixed:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    else:
        config.set_constant_rig_from_world_pose(sfm.images[min(sfm.reg_image_ids())].frame_id)
    return colmap.bundle_adjuster(sfm, options, config)
