"""The projection of points: reprojection errors, and derivatives with respect to its parameters.

The parameters are ordered: rotation (3), translation (3), focal length, radial distortion, aspect
ratio, principal point (2), skew. The degrees of freedom of an estimation are the number of its free
parameters, the first ones.
"""

from collections.abc import Iterable

import numpy as np
import pycolmap

POSE, FOCAL, RADIAL, ASPECT, ALL, SKEW = 6, 7, 8, 9, 11, 12  # degrees of freedom
DETECTED = 1600  # pixels, the longer side to which photos are reduced before detection


def reprojection_errors(
    points2D: np.ndarray,
    points3D: np.ndarray,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
) -> tuple[np.ndarray, np.ndarray]:
    """Project world points into an image.

    Args:
        points2D: (M, 2) image points, COLMAP's pixels.
        points3D: (M, 3) world points.
        cam_from_world: the pose.
        camera: intrinsics.

    Returns:
        The distances (M,) between projections and image points in pixels, and the projections
        (M, 2). Behind the camera, distances are infinite and projections NaN.
    """
    local = points3D @ cam_from_world.rotation.matrix().T + cam_from_world.translation
    projected = np.full((len(local), 2), np.nan)
    front = local[:, 2] > 0
    if front.any():
        projected[front] = camera.img_from_cam(local[front])
    errors = np.linalg.norm(projected - points2D, axis=1)
    return np.nan_to_num(errors, nan=np.inf, posinf=np.inf), projected


def project(local: np.ndarray, distortion: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Project points with a focal length of 1 and a radial distortion.

    Args:
        local: (M, 3) points in front of the camera, in its frame.
        distortion: coefficient of COLMAP's RADIAL.

    Returns:
        The image points (2, M), and their derivatives (2, 12, M) with respect to all parameters:
        the rotation about x, y, z, the translation along them, and the intrinsics.
    """
    x, y, z = local.T
    u, v, zero, one = x / z, y / z, np.zeros_like(z), np.ones_like(z)
    r2 = u * u + v * v
    scale, across = 1 + distortion * r2, 2 * distortion * u * v
    du = np.array([-u * v, 1 + u * u, -v, 1 / z, zero, -u / z])
    dv = np.array([-1 - v * v, u * v, u, zero, 1 / z, -v / z])
    # focal length, distortion, aspect ratio, principal point, skew
    along_x = [scale * u, u * r2, zero, one, zero, scale * v]
    along_y = [scale * v, v * r2, scale * v, zero, one, zero]
    derivatives = [
        [*((scale + 2 * distortion * u * u) * du + across * dv), *along_x],
        [*(across * du + (scale + 2 * distortion * v * v) * dv), *along_y],
    ]
    return scale * [u, v], np.array(derivatives)


def photo_scale(camera: pycolmap.Camera) -> float:
    """Return how many pixels a pixel of the reduced photo spans, in which keypoints are detected.

    Thresholds in pixels are multiplied by it. Features are taken to have the default `resize_max`.
    """
    return max(1.0, max(camera.width, camera.height) / DETECTED)


def median_photo_scale(cameras: Iterable[pycolmap.Camera]) -> float:
    """Return the median `photo_scale` of photos, given the camera of each; 1 without any."""
    return float(np.median([photo_scale(camera) for camera in cameras] or [1.0]))
