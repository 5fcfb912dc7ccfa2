"""Cameras and poses as OpenCV and ROS write them.

ROS and its messages are not needed: the functions take and return arrays.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pycolmap

from .cli import InputError, choose
from .parsers import check_camera

CORNER = 0.5  # pixels, of OpenCV's origin, the centre of the first pixel, in COLMAP's image
# ROS's name of a distortion -> how many coefficients OpenCV knows of it, and COLMAP's camera models
# that have the first ones, with their number
_PERSPECTIVE = (0, 4, 5, 8, 12, 14), {"PINHOLE": 0, "OPENCV": 4, "FULL_OPENCV": 8}
DISTORTION_MODELS = {
    "plumb_bob": _PERSPECTIVE,
    "rational_polynomial": _PERSPECTIVE,
    "equidistant": ((0, 4), {"OPENCV_FISHEYE": 4}),
}


class RosPose(NamedTuple):
    """A pose as in `geometry_msgs/PoseWithCovariance`.

    Args:
        position: (3,) of the camera in the world, in the units of the map.
        orientation: (4,) unit quaternion x, y, z, w, world from camera.
        covariance: (36,) in rows: the translation along, then the rotation in radians about the
            fixed axes of the world.
    """

    position: np.ndarray
    orientation: np.ndarray
    covariance: np.ndarray


def to_ros_pose(cam_from_world: pycolmap.Rigid3d, covariance: np.ndarray) -> RosPose:
    """Return a pose with its covariance as ROS has them.

    The camera's frame is the optical one of ROS: x to the right, y down, z forward. A pose of a rig
    is converted in the same way.

    Args:
        cam_from_world: the pose.
        covariance: (6, 6) of a small motion of the camera in its own frame, the rotation in radians
            first: `covariance` of `Localizer.localize`.

    Example:
        >>> pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), [0.0, 0.0, 2.0])
        >>> to_ros_pose(pose, np.eye(6)).position.tolist()
        [0.0, 0.0, -2.0]
    """
    world_from_cam = cam_from_world.inverse()
    # A small motion m makes the pose exp(m) * cam_from_world. It moves what the camera sees, so the
    # camera itself goes the other way; covariances do not tell.
    moved = np.zeros((6, 6))
    moved[:3, 3:] = moved[3:, :3] = world_from_cam.rotation.matrix()
    return RosPose(
        np.array(world_from_cam.translation),
        np.array(world_from_cam.rotation.quat),
        (moved @ covariance @ moved.T).ravel(),
    )


def to_camera(
    matrix: Sequence | np.ndarray,
    distortion: Sequence | np.ndarray,
    width: int,
    height: int,
    distortion_model: str = "plumb_bob",
) -> pycolmap.Camera:
    """Return the intrinsics that OpenCV estimated, or a `sensor_msgs/CameraInfo` has.

    Args:
        matrix: (3, 3) or (9,) camera matrix, `k` of ROS; pixel centres at integers.
        distortion: coefficients in OpenCV's order, `d` of ROS: k1, k2, p1, p2, k3, ..., k6; those
            of `cv2.fisheye` k1, ..., k4. Empty for undistorted images.
        width: of the images, in pixels.
        height: of the images, in pixels.
        distortion_model: a key of `DISTORTION_MODELS`, as ROS calls it: "plumb_bob" for
            `cv2.calibrateCamera`, "equidistant" for `cv2.fisheye.calibrate`.

    Returns:
        A camera with the model PINHOLE, OPENCV, FULL_OPENCV or OPENCV_FISHEYE. Its principal point
        is half a pixel larger, as COLMAP's pixel centres are at .5.

    Raises:
        InputError: if the matrix is not that of a calibrated camera without skew, the number of
            coefficients is wrong, or COLMAP has no model with them.

    Example:
        >>> camera = to_camera([[900, 0, 639.5], [0, 900, 359.5], [0, 0, 1]], [], 1280, 720)
        >>> camera.model.name, camera.params.tolist()
        ('PINHOLE', [900.0, 900.0, 640.0, 360.0])
    """
    fx, fy, cx, cy = _focal_lengths_and_centre(matrix)
    model, coefficients = _lens(distortion, distortion_model)
    if min(width, height) < 1:
        raise InputError(f"The images have {width}x{height} pixels.")
    camera = pycolmap.Camera(model=model, width=int(width), height=int(height))
    camera.params = [fx, fy, cx + CORNER, cy + CORNER, *coefficients]
    try:
        check_camera(camera)
    except ValueError as error:
        raise InputError(f"The camera matrix is not that of a camera: {error}.") from None
    return camera


def _focal_lengths_and_centre(matrix: Sequence | np.ndarray) -> tuple[float, float, float, float]:
    """Return fx, fy, cx and cy of a camera matrix."""
    values = _numbers(matrix, "camera matrix")
    if len(values) != 9:
        raise InputError(f"The camera matrix has {len(values)} numbers, not 9.")
    if not values[0]:  # that is how ROS says it
        raise InputError("The camera matrix has a focal length of 0: the camera is not calibrated.")
    fx, skew, cx, other_skew, fy, cy, *last = values.tolist()
    if skew or other_skew or last != [0, 0, 1]:
        rows = values.reshape(3, 3).tolist()
        raise InputError(f"The camera matrix is {rows}, not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].")
    return fx, fy, cx, cy


def _lens(distortion: Sequence | np.ndarray, distortion_model: str) -> tuple[str, list[float]]:
    """Return the name and the last parameters of the simplest of COLMAP's models with a lens."""
    choose("distortion model", distortion_model, DISTORTION_MODELS)
    numbers, models = DISTORTION_MODELS[distortion_model]
    coefficients = _numbers(distortion, "distortion")
    if len(coefficients) not in numbers:
        known = f"{distortion_model} has {' or '.join(map(str, numbers))} coefficients"
        raise InputError(f"The distortion has {len(coefficients)} numbers: {known}.")
    used = np.trim_zeros(coefficients, "b").tolist()
    for model, number in models.items():
        if len(used) <= number:
            return model, used + (number - len(used)) * [0.0]
    raise InputError(
        "COLMAP has no camera model with thin prisms or a tilted sensor, the 9th and further "
        "coefficients of a distortion: calibrate without them."
    )


def _numbers(values: Sequence | np.ndarray, what: str) -> np.ndarray:
    """Return values (N,) of an array of any shape, float64; raise an InputError for others."""
    try:
        found = np.asarray(values, np.float64).ravel()
    except (TypeError, ValueError):
        raise InputError(f"The {what} is not an array of numbers.") from None
    if not np.isfinite(found).all():
        raise InputError(f"The {what} has numbers that are not finite.")
    return found
