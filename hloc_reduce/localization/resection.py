"""Camera resectioning: estimate intrinsics together with the pose.

`projection` orders the parameters and counts degrees of freedom. All twelve parameters undo any
homography of a photo: no lens has a skew, but the photo of a picture does.
"""

from typing import NamedTuple

import numpy as np
import pycolmap

from ..utils.colmap import cam_from_img
from .projection import ALL, ASPECT, POSE, RADIAL, SKEW, photo_scale, project, reprojection_errors

# Standard deviations of the logarithm of the focal length, the distortion, the logarithm of the
# aspect ratio, the principal point in focal lengths, and the skew as a tangent. They are wide, and
# only keep parameters that few matches do not determine near their start.
PRIOR = np.array([0.5, 0.25, 0.25, 0.25, 0.25, 0.25])
REFINEMENTS = 10  # of refinement, each from the inliers of the one before
NOISE_PIXELS = 2.0  # pixels, scale of the Cauchy loss
EVALUATIONS = 100  # of the residuals in each round
DAMPING = 1e-3  # of the first step
TINY = 1e-9  # least diagonal of the damping
CONVERGED = 1e-6  # relative gain of the last step
FAR_PIXELS = 1e6  # pixels
PINHOLES = "SIMPLE_PINHOLE", "PINHOLE"  # models without distortion
BEHIND = 1e6  # the square of a point behind the camera, in units of the noise
# The search for all parameters: in a sample of SAMPLE matches with errors up to NEAR thresholds, it
# starts with principal points in the middle and CORNER of width and height away from it.
SAMPLE, NEAR, CORNER = 400, 5, 0.4
SEARCHES, GAIN = 3, 1.01  # each from the result of the one before, while the score grows
# of the linear start: six matches of a sample determine a projection
SIX, TRIALS, SEED = 6, 200, 0

View = tuple[pycolmap.Rigid3d, pycolmap.Camera]


class Resection(NamedTuple):
    """A pose and intrinsics that were estimated together.

    Args:
        cam_from_world: the pose.
        camera: OPENCV intrinsics, with one coefficient of distortion.
        inliers: (M,) bool, whether a match agrees.
        points2D: (M, 2) the image points without skew.
    """

    cam_from_world: pycolmap.Rigid3d
    camera: pycolmap.Camera
    inliers: np.ndarray
    points2D: np.ndarray


def is_distorted(camera: pycolmap.Camera) -> bool:
    """Return whether intrinsics have a distortion."""
    return bool(np.any(camera.params[list(camera.extra_params_idxs())]))


def undistort(points2D: np.ndarray, camera: pycolmap.Camera) -> tuple[np.ndarray, pycolmap.Camera]:
    """Undistort image points.

    Args:
        points2D: (M, 2) image points, COLMAP's pixels.
        camera: intrinsics.

    Returns:
        The points (M, 2) in a camera without distortion, clipped to FAR_PIXELS, and that camera,
        PINHOLE.
    """
    (fx, _, cx), (_, fy, cy), _ = camera.calibration_matrix()
    image = cam_from_img(camera, points2D) * [fx, fy] + [cx, cy]
    return np.clip(image, -FAR_PIXELS, FAR_PIXELS), _camera(camera, "PINHOLE", fx, fy, cx, cy)


def _camera(photo: pycolmap.Camera, model: str, *params: float) -> pycolmap.Camera:
    """Return intrinsics for photos of the same size."""
    return pycolmap.Camera(model=model, width=photo.width, height=photo.height, params=params)


def resect(
    points2D: np.ndarray,
    points3D: np.ndarray,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    max_error: float,
    degrees_of_freedom: int,
    chosen: np.ndarray | None = None,
) -> Resection | None:
    """Refine a pose and intrinsics from their inliers, as long as the number of inliers grows.

    Args:
        points2D: (M, 2) image points of all matches, COLMAP's pixels.
        points3D: (M, 3) their world points.
        cam_from_world: the initial pose.
        camera: the initial intrinsics, PINHOLE or those of a `Resection`.
        max_error: inlier threshold in pixels.
        degrees_of_freedom: 7 to 12.
        chosen: (M,) bool, the matches of the first round; default: the initial inliers.

    Returns:
        None if there are fewer inliers than degrees of freedom.
    """
    if chosen is None:
        chosen = reprojection_errors(points2D, points3D, cam_from_world, camera)[0] <= max_error
    start = view = _Parameters.of(cam_from_world, camera)
    noise, found = NOISE_PIXELS * photo_scale(camera), None
    for _ in range(REFINEMENTS):
        if chosen.sum() < degrees_of_freedom:
            break
        view = _fit(points2D[chosen], points3D[chosen], view, start, degrees_of_freedom, noise)
        pose, lens, image = view.cam_from_world, view.camera(camera), view.unskewed(points2D)
        inliers = reprojection_errors(image, points3D, pose, lens)[0] <= max_error
        if found is not None and inliers.sum() <= found.inliers.sum():
            break
        found, chosen = Resection(pose, lens, inliers, image), inliers
    return found


def resect_anew(
    points2D: np.ndarray,
    points3D: np.ndarray,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    max_error: float,
) -> Resection | None:
    """Estimate all parameters but the skew as `resect` does, even if the initial ones are far off.

    Many parameters have local optima. So this tries several starts: the initial PINHOLE intrinsics,
    another aspect ratio, principal points near the corners, with the camera turned accordingly, and
    the linear solution of `linear`. It does so again from the result, as long as that is better
    than what it began with.
    """

    def score(image: np.ndarray, view: View) -> float:
        """Return how many matches agree and how well, as MSAC does."""
        errors, _ = reprojection_errors(image, points3D, *view)
        return float(np.maximum(0, 1 - (errors / max_error) ** 2).sum())

    best, view = None, (cam_from_world, camera)
    least = GAIN * score(points2D, view)
    for _ in range(SEARCHES):
        starts = _search(points2D, points3D, *view, max_error)
        resected = (resect(points2D, points3D, *start, max_error, ALL) for start in starts)
        scored = [(score(one.points2D, one[:2]), one) for one in resected if one is not None]
        highest, found = max(scored, key=lambda both: both[0], default=(0.0, None))
        if best is None or highest > least:
            best = found
        if found is None or highest <= least:
            break
        least = GAIN * highest
        view = found.cam_from_world, _camera(camera, "PINHOLE", *found.camera.params[:4])
    return best


def _search(
    points2D: np.ndarray,
    points3D: np.ndarray,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    max_error: float,
) -> list[tuple[pycolmap.Rigid3d, pycolmap.Camera]]:
    """Return up to two poses with intrinsics that may be near the best ones, see `resect_anew`."""
    errors, _ = reprojection_errors(points2D, points3D, cam_from_world, camera)
    near = np.flatnonzero(errors <= NEAR * max_error)
    found = linear(points2D[near], points3D[near], camera, max_error)
    near = near[:: -(-len(near) // SAMPLE) or 1]
    sample, everything = (points2D[near], points3D[near]), np.ones(len(near), bool)
    starts = [(cam_from_world, camera)]
    starts += [_turned(*starts[0], x, y) for x in (-CORNER, CORNER) for y in (-CORNER, CORNER)]
    if stretched := resect(*sample, *starts[0], max_error, ASPECT):
        starts.append((stretched.cam_from_world, stretched.camera))

    def loss(refined: Resection) -> float:
        errors, _ = reprojection_errors(*sample, refined.cam_from_world, refined.camera)
        return float(np.log1p((errors / (NOISE_PIXELS * photo_scale(camera))) ** 2).sum())

    tried = [resect(*sample, *start, max_error, ALL, everything) for start in starts]
    refined = min((one for one in tried if one is not None), key=loss, default=None)
    return [start for start in (refined and refined[:2], found) if start is not None]


@np.errstate(divide="ignore", invalid="ignore")  # points at infinity are no inliers
def linear(
    points2D: np.ndarray, points3D: np.ndarray, camera: pycolmap.Camera, max_error: float
) -> tuple[pycolmap.Rigid3d, pycolmap.Camera] | None:
    """Estimate a pose and PINHOLE intrinsics without initial ones, by RANSAC and linear equations.

    Points of a plane do not determine them (Hartley and Zisserman, Multiple View Geometry, 7.1).

    Args:
        points2D: (M, 2) image points, COLMAP's pixels.
        points3D: (M, 3) their world points.
        camera: of the same size.
        max_error: inlier threshold in pixels.

    Returns:
        None where no projection is found.
    """
    if len(points2D) < 2 * SIX:
        return None
    generator, longer = np.random.default_rng(SEED), max(camera.width, camera.height)
    middle = np.array([camera.width, camera.height]) / 2
    centre = points3D.mean(axis=0)
    scale = np.median(np.linalg.norm(points3D - centre, axis=1)) or 1.0
    image, world = (points2D - middle) / longer, (points3D - centre) / scale
    world = np.pad(world, ((0, 0), (0, 1)), constant_values=1)

    def inliers(projections: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return which chosen matches (N,) agree with projections (..., 3, 4): (..., N) bool."""
        projected = world[chosen] @ projections.swapaxes(-1, -2)
        depth = projected[..., 2]
        depth = depth * np.sign(np.median(depth, axis=-1, keepdims=True))
        errors = np.linalg.norm(projected[..., :2] / projected[..., 2:] - image[chosen], axis=-1)
        return (longer * errors <= max_error) & (depth > 0)

    drawn = generator.integers(0, len(image), (TRIALS, SIX))
    sample = generator.permutation(len(image))[:SAMPLE]
    projections = _projections(image[drawn], world[drawn])
    best = projections[inliers(projections, sample).sum(axis=1).argmax()]
    everything = np.arange(len(image))
    for _ in range(REFINEMENTS // 2):
        agree = inliers(best, everything)
        if agree.sum() < 2 * SIX:
            return None
        best = _projections(image[agree], world[agree])
    to_pixels = np.array([[longer, 0, middle[0]], [0, longer, middle[1]], [0, 0, 1]])
    to_world = np.vstack([np.eye(3, 4) / scale, [0, 0, 0, 1]])
    to_world[:3, 3] = -centre / scale
    return _decomposed(to_pixels @ best @ to_world, camera)


def _projections(image: np.ndarray, world: np.ndarray) -> np.ndarray:
    """Solve for projections (..., 3, 4) of points (..., N, 4) to image points (..., N, 2)."""
    nothing = np.zeros_like(world)
    rows = [
        np.concatenate([world, nothing, -image[..., :1] * world], axis=-1),
        np.concatenate([nothing, world, -image[..., 1:] * world], axis=-1),
    ]
    equations = np.concatenate(rows, axis=-2)
    *_, vectors = np.linalg.svd(equations, full_matrices=False)
    return vectors[..., -1, :].reshape(*image.shape[:-2], 3, 4)


def _decomposed(
    projection: np.ndarray, camera: pycolmap.Camera
) -> tuple[pycolmap.Rigid3d, pycolmap.Camera] | None:
    """Split a projection (3, 4) into a pose and PINHOLE intrinsics, without its skew."""
    from scipy.linalg import rq

    if not np.isfinite(projection).all():
        return None
    if np.linalg.det(projection[:, :3]) < 0:
        projection = -projection
    calibration, rotation = rq(projection[:, :3])
    signs = np.diag(np.where(np.diag(calibration) < 0, -1.0, 1.0))
    calibration, rotation = calibration @ signs, signs @ rotation
    if not np.diag(calibration).all():
        return None
    translation = np.linalg.solve(calibration, projection[:, 3])
    (fx, _, cx), (_, fy, cy), _ = calibration / calibration[2, 2]
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)
    return pose, _camera(camera, "PINHOLE", fx, fy, cx, cy)


def is_plain(camera: pycolmap.Camera) -> bool:
    """Return whether intrinsics are of a pinhole with square pixels, centred, as `centred` makes.

    A fisheye lens is none, even if all its coefficients are 0.
    """
    (fx, _, cx), (_, fy, cy), _ = camera.calibration_matrix()
    middle = camera.width / 2, camera.height / 2
    return camera.model.name in PINHOLES and fx == fy and (cx, cy) == middle


def centred(
    cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera
) -> tuple[pycolmap.Rigid3d, pycolmap.Camera]:
    """Move the principal point to the middle, turn the camera accordingly, drop all distortion."""
    (fx, _, cx), (_, _, cy), _ = camera.calibration_matrix()
    pinhole = _camera(camera, "PINHOLE", fx, fx, cx, cy)
    return _turned(cam_from_world, pinhole, 0.5 - cx / camera.width, 0.5 - cy / camera.height)


def _turned(
    cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera, x: float, y: float
) -> tuple[pycolmap.Rigid3d, pycolmap.Camera]:
    """Move the principal point by shares of width and height, and turn the camera there."""
    fx, fy, cx, cy = camera.params
    x, y = x * camera.width, y * camera.height
    ray = np.array([x / fx, y / fy, 1])
    axis, tangent = np.cross(ray, [0, 0, 1]), np.hypot(*ray[:2])
    rotation = pycolmap.Rotation3d(np.arctan(tangent) / (tangent or 1) * axis)
    turn = pycolmap.Rigid3d(rotation, np.zeros(3))
    return turn * cam_from_world, _camera(camera, "PINHOLE", fx, fy, cx + x, cy + y)


class _Parameters(NamedTuple):
    """The parameters that are optimized: rotation (3, 3), translation (3,), intrinsics (6,).

    The intrinsics are the logarithm of the focal length, a radial distortion, the logarithm of the
    aspect ratio, the principal point in pixels, and the skew as a tangent.
    """

    rotation: np.ndarray
    translation: np.ndarray
    intrinsics: np.ndarray

    @classmethod
    def of(cls, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera) -> "_Parameters":
        fx, fy, cx, cy, distortion = [*camera.params, 0.0][:5]
        intrinsics = np.array([np.log(fx), distortion, np.log(fy / fx), cx, cy, 0.0])
        return cls(cam_from_world.rotation.matrix(), cam_from_world.translation, intrinsics)

    @property
    def cam_from_world(self) -> pycolmap.Rigid3d:
        return pycolmap.Rigid3d(pycolmap.Rotation3d(self.rotation), self.translation)

    @property
    def focal_lengths(self) -> np.ndarray:
        focal_length, _, aspect, *_ = self.intrinsics
        return np.exp([focal_length, focal_length + aspect])

    @property
    def _units(self) -> np.ndarray:
        """The units of changes of the intrinsics: focal lengths for the principal point."""
        return np.array([1, 1, 1, *self.focal_lengths, 1])

    def change(self, start: "_Parameters") -> np.ndarray:
        """Return the difference (6,) from initial intrinsics, in units of PRIOR."""
        return (self.intrinsics - start.intrinsics) / (PRIOR * start._units)

    def camera(self, photo: pycolmap.Camera) -> pycolmap.Camera:
        _, distortion, _, cx, cy, _ = self.intrinsics
        return _camera(photo, "OPENCV", *self.focal_lengths, cx, cy, distortion, 0, 0, 0)

    def unskewed(self, points2D: np.ndarray) -> np.ndarray:
        skew = self.intrinsics[5]
        if not skew:
            return points2D
        fx, fy = self.focal_lengths
        below = points2D[:, 1] - self.intrinsics[4]
        return points2D - np.stack([skew * fx / fy * below, np.zeros(len(below))], axis=1)

    def moved(self, step: np.ndarray) -> "_Parameters":
        """Return the parameters after a step (7 to 12,) of the free ones."""
        turn = pycolmap.Rotation3d(step[:3]).matrix()
        step = np.pad(step, (0, SKEW - len(step)))
        return _Parameters(
            turn @ self.rotation,
            turn @ self.translation + step[3:POSE],
            self.intrinsics + self._units * step[POSE:],
        )

    def residuals(
        self, points2D: np.ndarray, points3D: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return residuals (2, M), derivatives (2, 12, M), and which points are in front (M,)."""
        local = points3D @ self.rotation.T + self.translation
        front = local[:, 2] > 0
        local[~front] = 0, 0, 1
        _, distortion, _, *center, skew = self.intrinsics
        ray, derivatives = project(local, distortion)
        ray[0] += skew * ray[1]
        derivatives[0, :RADIAL] += skew * derivatives[1, :RADIAL]
        scale = self.focal_lengths[:, None]
        residuals = scale * ray + np.array(center)[:, None] - points2D.T
        return residuals, scale[:, None] * derivatives, front


@np.errstate(over="ignore", invalid="ignore")  # steps that are too long are refused
def _fit(
    points2D: np.ndarray,
    points3D: np.ndarray,
    view: _Parameters,
    start: _Parameters,
    degrees_of_freedom: int,
    noise: float,
) -> _Parameters:
    """Minimize the Cauchy loss of the residuals by the Levenberg-Marquardt method.

    Parameters that the residuals do not determine stay as they are in `start`.
    """
    least, damping, trial = np.inf, DAMPING, view
    free = slice(degrees_of_freedom - POSE)
    for _ in range(EVALUATIONS):
        residuals, derivatives, front = trial.residuals(points2D, points3D)
        squares = np.where(front, (residuals / noise) ** 2, BEHIND).ravel()
        change = trial.change(start)
        loss = np.log1p(squares).sum() + (change**2).sum()
        if loss < least:
            gain, least, view, damping = least - loss, loss, trial, damping / 10
            if gain < CONVERGED * loss:
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
