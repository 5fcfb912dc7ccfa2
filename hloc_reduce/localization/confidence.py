"""Tell a pose from chance, and one that is known precisely from one that is not."""

from argparse import ArgumentParser
from dataclasses import dataclass, replace
from math import lgamma

import numpy as np
import pycolmap

from ..utils.cli import InputError

SOLUTIONS = 4  # poses that a minimal sample may have
THRESHOLDS = 8  # inlier thresholds that are tried, from FINEST to RANSAC's
FINEST = 1.0  # pixel
SAME_PLACE = 2.0  # pixels at least: keypoints of other scales or orientations that count once
DETECTED = 1600  # the longer side in pixels, to which photos are reduced before detection
NEIGHBORS = 8  # projected points that give the density around a keypoint
LEAST_NOISE = 0.5  # pixels, the standard deviation of a keypoint at best
# inliers whose errors are independent: maps are bent, so that more of them err alike
INDEPENDENT = 30
FOCAL_LENGTHS = (0.3, 5.0)  # of an estimated one, times the longer side: 11 to 180 mm on 35 mm film
REFINED = 2.0  # by what factor a focal length of EXIF data may change
MAX_POSITION = 0.05  # standard deviation of the position, times the median distance of the inliers
MAX_ROTATION = 2.0  # standard deviation in degrees
MIN_MATCHES = 6  # of an image whose matches are asked whether they agree with a pose
# least agreement without a ratio test, with one, and with one below FEW dimensions; the second
# number of each is for confidences in DOUBTFUL, which copies of repeated structure reach: of fewer
# matches the share is known less well, and with more confidence it was lower in noisy scans only
AGREEMENT, AGREEMENT_RATIO, AGREEMENT_FEW, FEW = (0.17, 0.17), (0.76, 0.86), (0.55, 0.72), 32
DOUBTFUL = (50.0, 300.0)
RIVAL = 0.8  # a pose is ambiguous if another has this share of its inliers


def confidence(
    points2D: np.ndarray,
    points3D: np.ndarray,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    max_error: float,
    degrees_of_freedom: int = 6,
) -> float:
    """Measure how unlikely it is that wrong matches agree with a pose as well as these do.

    An a-contrario test in the manner of AC-RANSAC (Moulon, Monasse and Marlet, ACCV 2012). The
    number of false alarms is how many poses with as many inliers are expected if all matches are
    wrong: the number of poses that can be computed from them, times the probability that one has so
    many inliers. The inlier threshold is the one, up to RANSAC's, that makes it least.

    A wrong match pairs a keypoint with any of the matched points. So the probability that it is an
    inlier is the density of their projections around the keypoint, or if larger that of points
    spread evenly over the image: a pose that projects all points into a small part of the image
    is no evidence. Matches are counted by the places of keypoints, cells of the threshold's size,
    or by their points, whichever are fewer; a place with several matches has as many chances.

    Args:
        points2D: (M, 2) image points of all matches, COLMAP's pixels.
        points3D: (M, 3) their world points.
        cam_from_world: the pose.
        camera: intrinsics.
        max_error: RANSAC's inlier threshold in pixels.
        degrees_of_freedom: 6 for the pose alone, 7 with the focal length, 8 with a distortion too,
            11 with the aspect ratio and the principal point too.

    Returns:
        Minus the decimal logarithm of the number of false alarms. Above 0 the pose is not expected
        by chance; at 8 one is expected in a hundred million queries of a wrong place.
    """
    errors, projected = reprojection_errors(points2D, points3D, cam_from_world, camera)
    density = _density(points2D, projected, camera)
    # equal points have equal projections, and hardly ever do others
    point, scale = points3D @ [1, np.sqrt(2), np.sqrt(3)], photo_scale(camera)
    sample = -(-degrees_of_freedom // 2)  # matches that fix a pose

    def log10_false_alarms(threshold: float) -> float:
        side = max(SAME_PLACE * scale, threshold)
        column, row = np.floor(points2D / side).astype(np.int64).T
        _, first, place = np.unique((column << 32) + row, return_index=True, return_inverse=True)
        number = len(first)
        if number <= sample:
            return np.inf
        agree = errors <= threshold
        inliers = min(len(np.unique(place[agree])), len(np.unique(point[agree])))
        chances = np.bincount(place)
        by_chance = np.minimum(1, chances * np.pi * threshold**2 * density[first]).mean()
        tail = _log10_tail(inliers - sample, number - sample, by_chance)
        poses = _log10_choose(number, sample) + sample * np.log10(chances.mean())
        return poses + np.log10(SOLUTIONS * THRESHOLDS) + tail

    thresholds = np.geomspace(min(FINEST * scale, max_error), max_error, THRESHOLDS)
    return float(-min(map(log10_false_alarms, thresholds)))


def photo_scale(camera: pycolmap.Camera) -> float:
    """Return how many pixels of a photo are one of those that keypoints are detected in."""
    return max(1.0, max(camera.width, camera.height) / DETECTED)


def focal_lengths(camera: pycolmap.Camera, guessed: bool) -> tuple[float, float]:
    """Return between which focal lengths in pixels an estimated one is plausible.

    Args:
        camera: intrinsics before the estimation.
        guessed: they say nothing about the focal length; else it is known roughly.
    """
    size, given = max(camera.width, camera.height), camera.mean_focal_length()
    low, high = FOCAL_LENGTHS
    return (low * size, high * size) if guessed else (given / REFINED, given * REFINED)


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
        Their distances (M,) in pixels from the image points, infinite behind the camera, and the
        projections (M, 2), there NaN.
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
        The image points (2, M), and their derivatives (2, 12, M) by a rotation about x, y, z, a
        translation along them, and the intrinsics in the order of the degrees of freedom.
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


def _density(points2D: np.ndarray, projected: np.ndarray, camera: pycolmap.Camera) -> np.ndarray:
    """Return the probability (N,), by pixel, that a wrong match projects to image points (N, 2)."""
    uniform = 1 / (camera.width * camera.height)
    visible = np.unique(projected[np.isfinite(projected).all(axis=1)].round(), axis=0)
    if len(visible) <= NEIGHBORS:
        return np.full(len(points2D), uniform)
    from scipy.spatial import cKDTree

    # the nearest may be the keypoint's own
    distance = cKDTree(visible).query(points2D, k=[NEIGHBORS + 1])[0][:, 0]
    share = NEIGHBORS / len(projected)
    return np.maximum(uniform, share / (np.pi * np.maximum(distance, 1) ** 2))


def _log10_choose(n: int, k: int) -> float:
    return (lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)) / np.log(10)


def _log10_tail(successes: int, trials: int, probability: float) -> float:
    """Bound the probability of as many successes or more (Hoeffding, 1963), as a logarithm."""
    rate = successes / trials
    if rate <= probability:
        return 0.0
    divergence = rate * np.log(rate / probability)
    if rate < 1:
        divergence += (1 - rate) * np.log((1 - rate) / (1 - probability))
    return float(-trials * divergence / np.log(10))


def uncertainty(
    points2D: np.ndarray,
    points3D: np.ndarray,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    degrees_of_freedom: int = 6,
) -> tuple[float, float]:
    """Estimate how precisely inliers fix a pose, to first order from their errors.

    Args:
        points2D: (M, 2) image points of the inliers, COLMAP's pixels.
        points3D: (M, 3) their world points.
        cam_from_world: the pose.
        camera: intrinsics.
        degrees_of_freedom: 6 for the pose alone, 7 with the focal length, 8 with a distortion too,
            11 with the aspect ratio and the principal point too.

    Returns:
        The standard deviations of the position, in units of the inliers' median depth, and of the
        rotation in degrees; infinite where the inliers do not fix the pose. More than
        INDEPENDENT inliers do not reduce them further.
    """
    local = points3D @ cam_from_world.rotation.matrix().T + cam_from_world.translation
    _, derivatives = project(local / np.median(local[:, 2]))
    jacobian = camera.mean_focal_length() * np.concatenate(derivatives, axis=1)
    jacobian = jacobian[:degrees_of_freedom].T
    equations, unknowns = jacobian.shape
    if equations <= unknowns:
        return np.inf, np.inf
    errors, _ = reprojection_errors(points2D, points3D, cam_from_world, camera)
    noise = max(
        (LEAST_NOISE * photo_scale(camera)) ** 2, (errors**2).sum() / (equations - unknowns)
    )
    try:
        variance = noise * np.diag(np.linalg.inv(jacobian.T @ jacobian))
        variance = variance * max(1, len(points2D) / INDEPENDENT)
    except np.linalg.LinAlgError:
        return np.inf, np.inf
    if not (variance > 0).all():
        return np.inf, np.inf
    return float(np.sqrt(variance[3:6].sum())), float(np.degrees(np.sqrt(variance[:3].sum())))


def agreement(inliers: np.ndarray, images: list[np.ndarray]) -> float:
    """Measure how well the matches of the image that agrees most agree with a pose.

    An image that shows the place of a query has mostly right matches. A pose that symmetric or
    repeated structure makes up agrees with some matches of several images, but of none with most:
    that of a mirrored photo of a symmetric facade, for example.

    Args:
        inliers: (M,) bool, which matches agree with the pose.
        images: of each map image the indices of its matches.

    Returns:
        The largest share of inliers among the matches of an image that has 6 or more, or among all:
        its lower bound, by one standard deviation (Wilson, 1927), so that a few tell little.
    """
    parts = [inliers, *(inliers[chosen] for chosen in images if len(chosen) >= MIN_MATCHES)]
    return max(_lower_bound(part.sum(), len(part)) for part in parts)


def _lower_bound(successes: int, trials: int) -> float:
    """Return the lower bound of a rate, by one standard deviation."""
    if not trials:
        return 0.0
    rate = successes / trials
    deviation = np.sqrt(rate * (1 - rate) / trials + 0.25 / trials**2)
    return float((rate + 0.5 / trials - deviation) / (1 + 1 / trials))


@dataclass(frozen=True)
class Gate:
    """What a pose must have for the query to be called localized.

    Args:
        min_confidence: `confidence`.
        min_inliers: inliers of RANSAC.
        min_agreement: `agreement`, in general and where the confidence is doubtful; default: that
            of `of_matches`.

    Raises:
        InputError: for a confidence that is not finite or a negative number of inliers.
    """

    min_confidence: float = 8.0
    min_inliers: int = 8
    min_agreement: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.min_confidence < np.inf:
            raise InputError(
                f"min_confidence is {self.min_confidence}: it must be finite and at least 0."
            )
        if self.min_inliers < 0:
            raise InputError(f"min_inliers is {self.min_inliers}: at least 0.")

    def of_matches(self, matcher: dict, dim: int) -> "Gate":
        """Return the gate for matches of descriptors, whose agreement differs.

        Args:
            matcher: configuration of the matcher's model.
            dim: dimension of the descriptors.
        """
        if self.min_agreement is not None:
            return self
        with_ratio = AGREEMENT_FEW if dim < FEW else AGREEMENT_RATIO
        least = with_ratio if matcher.get("ratio_threshold") else AGREEMENT
        return replace(self, min_agreement=least)

    def least_agreement(self, confidence: float) -> float:
        """Return the agreement that a pose of a confidence must have."""
        general, doubtful = self.min_agreement or AGREEMENT
        low, high = DOUBTFUL
        return doubtful if low <= confidence < high else general


DEFAULT_GATE = Gate()


def add_gate_options(parser: ArgumentParser) -> None:
    """Add --min_confidence and --min_inliers."""
    parser.add_argument(
        "--min_confidence",
        type=float,
        default=DEFAULT_GATE.min_confidence,
        help="confidence that a pose must have for the query to be called localized: minus the "
        "decimal logarithm of how many such poses are expected by chance",
    )
    parser.add_argument(
        "--min_inliers",
        type=int,
        default=DEFAULT_GATE.min_inliers,
        help="inliers that a pose must have for the query to be called localized",
    )
