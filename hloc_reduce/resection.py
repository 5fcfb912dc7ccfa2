"""Camera resectioning: a pose together with the intrinsics that fit its matches.

The parameters have an order, and the first ones are free: the pose (6), the focal length (7), a
radial distortion (8), the aspect ratio (9), the principal point (11), the skew (12). So the number
of degrees of freedom says which they are. With all twelve any homography of a photo can be undone:
a lens has no skew, but the photo of a picture has.
"""

from typing import NamedTuple

import numpy as np
import pycolmap
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from .colmap import cam_from_img
from .confidence import photo_scale, reprojection_errors

RADIAL, ASPECT, ALL, SKEW = 8, 9, 11, 12  # degrees of freedom
# of the logarithms of the changes of focal length and aspect ratio, the distortion, the shift of
# the principal point in focal lengths, and the skew as a tangent
BOUNDS = np.array([np.inf] * 6 + [2.0, 1.0, 1.0, 1.0, 1.0, 1.0])
ROUNDS = 10  # of refinement, from the inliers of the one before
NOISE = 2.0  # pixels, scale of the Cauchy loss
EVALUATIONS = 30  # of the errors, a round
FAR = 1e6  # pixels
# where all parameters are searched for: in a sample of the matches with errors of a few times the
# threshold, with the principal point in the middle of the photo and near its corners
SAMPLE, NEAR = 400, 5
CORNER = 0.4  # of width and height from the middle


class Resection(NamedTuple):
    """A pose and intrinsics.

    Args:
        cam_from_world: the pose.
        camera: OPENCV intrinsics, with one coefficient of distortion.
        inliers: (M,) bool, which matches agree.
        points2D: (M, 2) the image points without skew.
    """

    cam_from_world: pycolmap.Rigid3d
    camera: pycolmap.Camera
    inliers: np.ndarray
    points2D: np.ndarray


def is_distorted(camera: pycolmap.Camera) -> bool:
    """Tell whether intrinsics have a distortion."""
    return bool(np.any(camera.params[list(camera.extra_params_idxs())]))


def undistort(points2D: np.ndarray, camera: pycolmap.Camera) -> tuple[np.ndarray, pycolmap.Camera]:
    """Undistort image points.

    Args:
        points2D: (M, 2) image points, COLMAP's pixels.
        camera: intrinsics.

    Returns:
        The points (M, 2) as a camera without distortion would have them, at most FAR pixels away,
        and this camera, PINHOLE.
    """
    (fx, _, cx), (_, fy, cy), _ = camera.calibration_matrix()
    pinhole = pycolmap.Camera(
        model="PINHOLE", width=camera.width, height=camera.height, params=[fx, fy, cx, cy]
    )
    return np.clip(cam_from_img(camera, points2D) * [fx, fy] + [cx, cy], -FAR, FAR), pinhole


def resect(
    points2D: np.ndarray,
    points3D: np.ndarray,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    max_error: float,
    degrees_of_freedom: int,
    chosen: np.ndarray | None = None,
) -> Resection | None:
    """Refine a pose and intrinsics to the matches that agree, as long as more and more do.

    Args:
        points2D: (M, 2) image points of all matches, COLMAP's pixels.
        points3D: (M, 3) their world points.
        cam_from_world: the pose to begin with.
        camera: the intrinsics to begin with, PINHOLE or of a `resect` before.
        max_error: inlier threshold in pixels.
        degrees_of_freedom: 7 to 12.
        chosen: (M,) bool, the matches to begin with; default: those that agree.

    Returns:
        What was found; None where fewer matches agree than there are degrees of freedom.
    """
    if chosen is None:
        chosen = reprojection_errors(points2D, points3D, cam_from_world, camera)[0] <= max_error
    inliers, found = chosen, None  # those of each round, and what the last one found
    rotation, translation = cam_from_world.rotation.matrix(), cam_from_world.translation
    depth = np.median((points3D @ rotation.T + translation)[inliers, 2]) if inliers.any() else 1.0
    fx, fy, cx, cy, *coefficients = camera.params
    before = coefficients[0] if coefficients else 0.0

    def pose(free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        turned = Rotation.from_rotvec(free[:3]).as_matrix() @ rotation
        return turned, translation + depth * free[3:6]

    def intrinsics(free: np.ndarray) -> list[float]:
        """Return the parameters of an OPENCV camera with one coefficient of distortion."""
        change, distortion, aspect, x, y, _ = np.pad(free[6:], (0, SKEW - len(free)))
        change = np.exp(change)
        return [
            fx * change,
            fy * change * np.exp(aspect),
            cx + fx * x,
            cy + fx * y,
            before + distortion,
        ]

    def unskewed(free: np.ndarray, image: np.ndarray) -> np.ndarray:
        if len(free) < SKEW:
            return image
        return image - free[-1] * np.stack([image[:, 1] - cy, np.zeros(len(image))], axis=1)

    def residuals(free: np.ndarray, image: np.ndarray, world: np.ndarray) -> np.ndarray:
        turned, moved = pose(free)
        local = world @ turned.T + moved
        ray = local[:, :2] / np.maximum(local[:, 2:], 1e-6 * depth)
        *matrix, distortion = intrinsics(free)
        ray *= 1 + distortion * (ray**2).sum(axis=1, keepdims=True)
        return (ray * matrix[:2] + matrix[2:] - unskewed(free, image)).ravel()

    free, bounds = np.zeros(degrees_of_freedom), BOUNDS[:degrees_of_freedom]
    for _ in range(ROUNDS):
        if inliers.sum() < degrees_of_freedom:
            break
        free = least_squares(
            residuals,
            free,
            bounds=(-bounds, bounds),
            x_scale="jac",
            loss="cauchy",
            f_scale=NOISE * photo_scale(camera),
            max_nfev=EVALUATIONS,
            args=(points2D[inliers], points3D[inliers]),
        ).x
        turned, moved = pose(free)
        refined = pycolmap.Rigid3d(pycolmap.Rotation3d(turned), moved)
        lens = pycolmap.Camera(
            model="OPENCV",
            width=camera.width,
            height=camera.height,
            params=[*intrinsics(free), 0, 0, 0],
        )
        image = unskewed(free, points2D)
        errors, _ = reprojection_errors(image, points3D, refined, lens)
        if found is not None and (errors <= max_error).sum() <= found.inliers.sum():
            break
        inliers = errors <= max_error
        found = Resection(refined, lens, inliers, image)
    return found


def resect_anew(
    points2D: np.ndarray,
    points3D: np.ndarray,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    max_error: float,
) -> Resection | None:
    """Find all intrinsics, and the pose, though those to begin with are far off.

    That many parameters have local optima. So the principal point is looked for in the middle and
    near the corners, where the camera is turned there.

    Args:
        points2D: (M, 2) image points of all matches, COLMAP's pixels.
        points3D: (M, 3) their world points.
        cam_from_world: the pose to begin with.
        camera: PINHOLE intrinsics to begin with.
        max_error: inlier threshold in pixels.

    Returns:
        As `resect`.
    """
    errors, _ = reprojection_errors(points2D, points3D, cam_from_world, camera)
    near = np.flatnonzero(errors <= NEAR * max_error)
    near = near[:: -(-len(near) // SAMPLE) or 1]
    matches, all_of_them = (points2D[near], points3D[near]), np.ones(len(near), bool)
    starts = [(cam_from_world, camera)]
    starts += [_turned(*starts[0], x, y) for x in (-CORNER, CORNER) for y in (-CORNER, CORNER)]
    if stretched := resect(*matches, *starts[0], max_error, ASPECT):
        starts.append(stretched[:2])
    found = [resect(*matches, *start, max_error, ALL, all_of_them) for start in starts]
    found = [pose_and_camera[:2] for pose_and_camera in found if pose_and_camera is not None]

    def loss(start: tuple[pycolmap.Rigid3d, pycolmap.Camera]) -> float:
        errors, _ = reprojection_errors(*matches, *start)
        return float(np.log1p((errors / (NOISE * photo_scale(camera))) ** 2).sum())

    return resect(points2D, points3D, *min(found, key=loss), max_error, ALL) if found else None


def _turned(
    cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera, x: float, y: float
) -> tuple[pycolmap.Rigid3d, pycolmap.Camera]:
    """Move the principal point by shares of width and height, and turn the camera there."""
    fx, fy, cx, cy = camera.params
    x, y = x * camera.width, y * camera.height
    turn, _ = Rotation.align_vectors([[0, 0, 1]], [[x / fx, y / fy, 1]])
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d(turn.as_matrix()), np.zeros(3))
    moved = pycolmap.Camera(
        model="PINHOLE",
        width=camera.width,
        height=camera.height,
        params=[fx, fy, cx + x, cy + y],
    )
    return turn * cam_from_world, moved
