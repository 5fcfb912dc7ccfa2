"""Camera resectioning: a pose together with the intrinsics that fit its matches.

The parameters have an order, and the first ones are free: the pose (6), the focal length (7), a
radial distortion (8), the aspect ratio (9), the principal point (11), the skew (12). So the number
of degrees of freedom says which they are. With all twelve any homography of a photo can be undone:
a lens has no skew, but the photo of a picture has.
"""

from typing import NamedTuple

import numpy as np
import pycolmap

from ..utils.colmap import cam_from_img
from .confidence import photo_scale, project, reprojection_errors

POSE, RADIAL, ASPECT, ALL, SKEW = 6, 8, 9, 11, 12  # degrees of freedom
# standard deviations of the logarithm of the focal length, the distortion, the logarithm of the
# aspect ratio, the principal point in focal lengths, and the skew as a tangent: all others are
# possible, but what few matches do not tell is not made up
PRIOR = np.array([0.5, 0.25, 0.25, 0.25, 0.25, 0.25])
ROUNDS = 10  # of refinement, from the inliers of the one before
NOISE = 2.0  # pixels, scale of the Cauchy loss
EVALUATIONS = 100  # of the residuals, a round
DAMPING, TINY = 1e-3, 1e-9  # of the first step; what is damped at least
ENOUGH = 1e-6  # relative gain of the last step
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
    start = view = _View.of(cam_from_world, camera)
    noise = NOISE * photo_scale(camera)
    for _ in range(ROUNDS):
        if inliers.sum() < degrees_of_freedom:
            break
        chosen = points2D[inliers], points3D[inliers]
        view = _fit(*chosen, view, start, degrees_of_freedom, noise)
        pose, lens, image = view.pose, view.camera(camera), view.unskewed(points2D)
        errors, _ = reprojection_errors(image, points3D, pose, lens)
        if found is not None and (errors <= max_error).sum() <= found.inliers.sum():
            break
        inliers = errors <= max_error
        found = Resection(pose, lens, inliers, image)
    return found


class _View(NamedTuple):
    """A pose and the intrinsics that are free, of shapes (3, 3), (3,) and (6,).

    The intrinsics are the logarithm of the focal length, a radial distortion, the logarithm of the
    aspect ratio, the principal point in pixels, and the skew as a tangent.
    """

    rotation: np.ndarray
    translation: np.ndarray
    intrinsics: np.ndarray

    @classmethod
    def of(cls, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera) -> "_View":
        fx, fy, cx, cy, distortion = [*camera.params, 0.0][:5]
        intrinsics = np.array([np.log(fx), distortion, np.log(fy / fx), cx, cy, 0.0])
        return cls(cam_from_world.rotation.matrix(), cam_from_world.translation, intrinsics)

    @property
    def pose(self) -> pycolmap.Rigid3d:
        return pycolmap.Rigid3d(pycolmap.Rotation3d(self.rotation), self.translation)

    @property
    def focal_lengths(self) -> np.ndarray:
        focal_length, _, aspect, *_ = self.intrinsics
        return np.exp([focal_length, focal_length + aspect])

    @property
    def _units(self) -> np.ndarray:
        """The units of changes of the intrinsics: focal lengths for the principal point."""
        return np.array([1, 1, 1, *self.focal_lengths, 1])

    def change(self, start: "_View") -> np.ndarray:
        """Return how much the intrinsics (6,) differ from others, in units of PRIOR."""
        return (self.intrinsics - start.intrinsics) / (PRIOR * start._units)

    def camera(self, photo: pycolmap.Camera) -> pycolmap.Camera:
        _, distortion, _, cx, cy, _ = self.intrinsics
        return pycolmap.Camera(
            model="OPENCV",
            width=photo.width,
            height=photo.height,
            params=[*self.focal_lengths, cx, cy, distortion, 0, 0, 0],
        )

    def unskewed(self, points2D: np.ndarray) -> np.ndarray:
        skew = self.intrinsics[5]
        if not skew:
            return points2D
        fx, fy = self.focal_lengths
        below = points2D[:, 1] - self.intrinsics[4]
        return points2D - np.stack([skew * fx / fy * below, np.zeros(len(below))], axis=1)

    def moved(self, step: np.ndarray) -> "_View":
        """Return the view after a step (7 to 12,), in the order of the degrees of freedom."""
        turn = pycolmap.Rotation3d(step[:3]).matrix()
        step = np.pad(step, (0, SKEW - len(step)))
        return _View(
            turn @ self.rotation,
            turn @ self.translation + step[3:POSE],
            self.intrinsics + self._units * step[POSE:],
        )

    def residuals(
        self, points2D: np.ndarray, points3D: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return residuals (2, M), their derivatives (2, 12, M), and who is in front (M,)."""
        local = points3D @ self.rotation.T + self.translation
        front = local[:, 2] > 0
        local[~front] = 0, 0, 1
        _, distortion, _, *center, skew = self.intrinsics
        ray, derivatives = project(local, distortion)
        ray[0] += skew * ray[1]
        derivatives[0, :RADIAL] += skew * derivatives[1, :RADIAL]
        fx, fy = self.focal_lengths
        scale = np.array([[fx], [fy]])
        residuals = scale * ray + np.array(center)[:, None] - points2D.T
        return residuals, scale[:, None] * derivatives, front


@np.errstate(over="ignore", invalid="ignore")  # of a step that is too long, and refused
def _fit(
    points2D: np.ndarray,
    points3D: np.ndarray,
    view: _View,
    start: _View,
    degrees_of_freedom: int,
    noise: float,
) -> _View:
    """Minimize the Cauchy loss of the residuals by the method of Levenberg and Marquardt.

    What the residuals do not fix stays as it is at the start.
    """
    least, damping, trial = np.inf, DAMPING, view
    free = slice(degrees_of_freedom - POSE)
    for _ in range(EVALUATIONS):
        residuals, derivatives, front = trial.residuals(points2D, points3D)
        squares = np.where(front, (residuals / noise) ** 2, FAR).ravel()
        change = trial.change(start)
        loss = np.log1p(squares).sum() + (change**2).sum()
        if loss < least:
            gain, least, view, damping = least - loss, loss, trial, damping / 10
            if gain < ENOUGH * loss:
                break
            jacobian = np.concatenate(derivatives[:, :degrees_of_freedom], axis=1)
            weighted = jacobian * np.tile(front, 2) / (1 + squares) / noise**2
            normal, gradient = weighted @ jacobian.T, weighted @ residuals.ravel()
            normal[POSE:, POSE:] += np.diag(1 / PRIOR[free] ** 2)
            gradient[POSE:] += (change / PRIOR)[free]
        else:
            damping *= 10
        damped = normal + damping * np.diag(np.maximum(np.diag(normal), TINY))
        trial = view.moved(-np.linalg.solve(damped, gradient))
    return view


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
    ray = np.array([x / fx, y / fy, 1])
    axis = np.cross(ray, [0, 0, 1]) / np.hypot(*ray[:2])
    turn = pycolmap.Rotation3d(np.arctan(np.hypot(*ray[:2])) * axis)
    turn = pycolmap.Rigid3d(turn, np.zeros(3))
    moved = pycolmap.Camera(
        model="PINHOLE",
        width=camera.width,
        height=camera.height,
        params=[fx, fy, cx + x, cy + y],
    )
    return turn * cam_from_world, moved
