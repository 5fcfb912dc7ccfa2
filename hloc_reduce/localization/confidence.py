"""Tell right poses from chance, and precise poses from uncertain ones."""

from dataclasses import dataclass, replace
from math import comb, log10
from typing import Annotated, NamedTuple

import numpy as np
import pycolmap

from ..utils.arrays import distinct
from ..utils.cli import InputError
from ..utils.options import HIDDEN
from .projection import FOCAL, POSE, photo_scale, project, reprojection_errors

SOLUTIONS = 4  # poses that a minimal sample may have
THRESHOLDS = 8  # inlier thresholds that are tried, from FINEST to RANSAC's
FINEST = 1.0  # pixel
# pixels; keypoints of other scales or orientations that are nearer count once
SAME_PLACE = 2.0
NEIGHBORS = 8  # projections from which the density around a keypoint is estimated
LEAST_NOISE = 0.5  # pixels, the least standard deviation of a keypoint
INDEPENDENT = 30  # inliers with independent errors: in a bent map neighbors err alike
FOCAL_LENGTHS = (0.3, 5.0)  # range of estimated ones, in longer sides: 11 to 180 mm on 35 mm film
REFINED = 2.0  # factor by which a focal length from EXIF data may change
MAX_POSITION = 0.05  # standard deviation of the position, in median depths of the inliers
MAX_ROTATION = 2.0  # standard deviation in degrees
MIN_MATCHES = 6  # of an image whose matches may tell whether a pose is right
RIVAL = 0.25  # a pose is ambiguous if another one has this share of its confidence
# or if one by other images, such as those of another floor, has this share of its inliers
RIVAL_BY_OTHERS = 0.8

# The least agreement of a pose, from a confidence on. With a ratio test, wrong poses at copies of
# repeated structures have confidences of 50 to 300. Below, there are few matches, so that the
# agreement is less certain; above, there are many more right poses in noisy scans.
Steps = tuple[tuple[float, float], ...]
AGREEMENT: Steps = ((0, 0.3),)  # of matches without a strict ratio test
AGREEMENT_NOISY: Steps = ((0, 0.17),)  # the same for photos whose noise was reduced
STRICT = 0.8  # the largest ratio of a strict test
AGREEMENT_RATIO: Steps = ((0, 0.76), (50, 0.86), (300, 0.76))  # with a strict ratio test
FEW = 32  # dimensions
AGREEMENT_FEW: Steps = ((0, 0.55), (50, 0.72), (300, 0.55))  # the same for fewer dimensions
# The largest share of its confidence that the mirror image of a right pose may have. On symmetric
# facades networks, which match without a ratio test, have up to 0.73; of mirrored photos of a
# castle, localized 90 degrees off by matches with a strict one, seven have 0.47 to 0.97.
MIRRORED, MIRRORED_RATIO = 0.8, 0.4


def confidence(
    points2D: np.ndarray,
    points3D: np.ndarray,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    max_error: float,
    degrees_of_freedom: int = POSE,
) -> float:
    """Measure how unlikely it is that wrong matches agree with a pose as well as these do.

    An a-contrario test in the manner of AC-RANSAC (Moulon, Monasse and Marlet, ACCV 2012). The
    number of false alarms is the expected number of poses with at least as many inliers if all
    matches are wrong: the number of poses that can be computed from them, times the probability
    that a pose has at least as many inliers. It is the least over inlier thresholds up to RANSAC's.

    A wrong match pairs a keypoint with a random one of the matched points. It is an inlier with the
    density of their projections around the keypoint, or of points spread evenly over the image,
    whichever is larger: a pose that projects all points into a small part of the image is no
    evidence. Keypoints in the same cell of the threshold's size count once, and so do equal points;
    the smaller one of the two counts is used. A cell with several matches has as many chances.

    Args:
        points2D: (M, 2) image points of all matches, COLMAP's pixels.
        points3D: (M, 3) their world points.
        cam_from_world: the pose.
        camera: intrinsics.
        max_error: RANSAC's inlier threshold in pixels.
        degrees_of_freedom: the number of estimated parameters, see `projection`.

    Returns:
        Minus the decimal logarithm of the number of false alarms. Above 0 the pose is not expected
        by chance; at 8 one is expected in a hundred million queries of a wrong place.
    """
    errors, projected = reprojection_errors(points2D, points3D, cam_from_world, camera)
    density = _density(points2D, projected, camera)
    # one number tells points apart: hardly any two points have equal ones
    point = np.unique(points3D @ [1, np.sqrt(2), np.sqrt(3)], return_inverse=True)[1]
    scale = photo_scale(camera)
    sample = -(-degrees_of_freedom // 2)  # matches that determine a pose

    def log10_false_alarms(threshold: float) -> float:
        side = max(SAME_PLACE * scale, threshold)
        column, row = np.floor(points2D / side).astype(np.int64).T
        _, first, place = np.unique((column << 32) + row, return_index=True, return_inverse=True)
        number = len(first)
        if number <= sample:
            return np.inf
        agree = errors <= threshold
        inliers = min(_num_distinct(place[agree]), _num_distinct(point[agree]))
        chances = np.bincount(place)
        by_chance = np.minimum(1, chances * np.pi * threshold**2 * density[first]).mean()
        tail = _log10_tail(inliers - sample, number - sample, by_chance)
        poses = log10(comb(number, sample)) + sample * np.log10(chances.mean())
        return poses + np.log10(SOLUTIONS * THRESHOLDS) + tail

    thresholds = np.geomspace(min(FINEST * scale, max_error), max_error, THRESHOLDS)
    return float(-min(map(log10_false_alarms, thresholds)))


def _num_distinct(numbers: np.ndarray) -> int:
    """Count the distinct values of small integers (N,)."""
    return int(np.count_nonzero(np.bincount(numbers)))


def _density(points2D: np.ndarray, projected: np.ndarray, camera: pycolmap.Camera) -> np.ndarray:
    """Return the probability per pixel that a wrong match projects to image points (N, 2)."""
    uniform = 1 / (camera.width * camera.height)
    rounded = projected[np.isfinite(projected).all(axis=1)].round()
    complex_numbers = distinct(rounded @ [1, 1j])  # sorted much faster than rows
    visible = np.stack([complex_numbers.real, complex_numbers.imag], axis=1)
    if len(visible) <= NEIGHBORS:
        return np.full(len(points2D), uniform)
    from scipy.spatial import cKDTree

    share = NEIGHBORS / len(projected)
    farthest = np.sqrt(share / (np.pi * uniform))  # beyond it, the density is uniform
    # one more, as the nearest one may be the projection of the keypoint's own match
    distance, _ = cKDTree(visible).query(
        points2D, k=[NEIGHBORS + 1], distance_upper_bound=max(1, farthest)
    )
    return np.maximum(uniform, share / (np.pi * np.maximum(distance[:, 0], 1) ** 2))


def _log10_tail(successes: int, trials: int, probability: float) -> float:
    """Bound the probability of at least as many successes (Hoeffding, 1963), as a logarithm."""
    rate = successes / trials
    if rate <= probability:
        return 0.0
    divergence = rate * np.log(rate / probability)
    if rate < 1:
        divergence += (1 - rate) * np.log((1 - rate) / (1 - probability))
    return float(-trials * divergence / np.log(10))


class Uncertainty(NamedTuple):
    """Standard deviations, infinite if the inliers do not determine a pose.

    Args:
        position: in units of the inliers' median depth.
        rotation: in degrees.
        focal_length: of its logarithm, 0 if it is known; a bent map is not allowed for.
    """

    position: float
    rotation: float
    focal_length: float


def uncertainty(
    points2D: np.ndarray,
    points3D: np.ndarray,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    degrees_of_freedom: int = POSE,
) -> Uncertainty:
    """Estimate how precisely inliers determine a pose, to first order from their errors.

    More than INDEPENDENT inliers do not make the pose more precise.

    Args:
        points2D: (M, 2) image points of the inliers, COLMAP's pixels.
        points3D: (M, 3) their world points.
        cam_from_world: the pose.
        camera: intrinsics.
        degrees_of_freedom: the number of unknown parameters, see `projection`.
    """
    nothing = Uncertainty(np.inf, np.inf, np.inf)
    equations, unknowns = 2 * len(points2D), degrees_of_freedom
    if equations <= unknowns:
        return nothing
    local = points3D @ cam_from_world.rotation.matrix().T + cam_from_world.translation
    _, derivatives = project(local / np.median(local[:, 2]))
    jacobian = camera.mean_focal_length() * np.concatenate(derivatives, axis=1)
    jacobian = jacobian[:degrees_of_freedom].T
    errors, _ = reprojection_errors(points2D, points3D, cam_from_world, camera)
    measured = (errors**2).sum() / (equations - unknowns)
    noise = max((LEAST_NOISE * photo_scale(camera)) ** 2, measured)
    try:
        variance = noise * np.diag(np.linalg.inv(jacobian.T @ jacobian))
    except np.linalg.LinAlgError:
        return nothing
    if not (variance > 0).all():
        return nothing
    bent = max(1, len(points2D) / INDEPENDENT)
    rotation, position, focal_length = variance[:3], variance[3:POSE], variance[POSE:FOCAL]
    return Uncertainty(
        position=float(np.sqrt(bent * position.sum())),
        rotation=float(np.degrees(np.sqrt(bent * rotation.sum()))),
        focal_length=float(np.sqrt(focal_length.sum())),
    )


def focal_lengths(camera: pycolmap.Camera, guessed: bool) -> tuple[float, float]:
    """Return the range of plausible focal lengths in pixels.

    Args:
        camera: intrinsics before the estimation.
        guessed: their focal length is unknown rather than approximate.
    """
    size, given = max(camera.width, camera.height), camera.mean_focal_length()
    low, high = FOCAL_LENGTHS
    return (low * size, high * size) if guessed else (given / REFINED, given * REFINED)


def agreement(inliers: np.ndarray, images: list[np.ndarray]) -> float:
    """Measure how many matches agree with a pose, in the image where most do.

    Most matches with an image of the right place are right. A wrong pose, for example of a
    mirrored photo of a symmetric facade, agrees with some matches of several images, but of none
    with most.

    Args:
        inliers: (M,) bool, whether a match agrees with the pose.
        images: of each map image the indices of its matches.

    Returns:
        The largest share of inliers among the matches of an image that has 6 or more, or among all:
        its lower bound, by one standard deviation (Wilson, 1927), so that a few tell little.
    """
    parts = [inliers, *(inliers[chosen] for chosen in images if len(chosen) >= MIN_MATCHES)]
    number = np.array([len(part) for part in parts if len(part)])
    rate = np.array([part.sum() for part in parts if len(part)]) / number
    deviation = np.sqrt(rate * (1 - rate) / number + 0.25 / number**2)
    return float(max((rate + 0.5 / number - deviation) / (1 + 1 / number), default=0.0))


@dataclass(frozen=True)
class Gate:
    """What a pose must have for the query to be called localized.

    Args:
        min_confidence: minimum confidence of a localized query: -log10 of the number of poses with
            as many inliers that are expected by chance.
        min_inliers: minimum number of RANSAC's inliers of a localized query.
        min_agreement: pairs, in ascending order, of a confidence and the minimum `agreement` of
            poses with at least this confidence; default: by the matches, see `of_matches`.
        min_agreement_noisy: the same for photos whose noise was reduced.
        max_mirrored: the maximum confidence of the mirror image, as a share of its own; default: by
            the matches.

    Raises:
        InputError: for a confidence that is not finite, or a negative number of inliers or share.
    """

    min_confidence: float = 8.0
    min_inliers: int = 8
    min_agreement: Steps | None = None
    min_agreement_noisy: Steps | None = None
    max_mirrored: Annotated[float, HIDDEN] | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.min_confidence < np.inf:
            raise InputError(
                f"min_confidence is {self.min_confidence}: it must be finite and at least 0."
            )
        if self.min_inliers < 0:
            raise InputError(f"min_inliers is {self.min_inliers}: at least 0.")
        if self.max_mirrored is not None and not self.max_mirrored >= 0:
            raise InputError(f"max_mirrored is {self.max_mirrored}: at least 0.")

    def of_matches(self, matcher: dict, dim: int) -> "Gate":
        """Return the gate for a matcher and descriptors.

        Args:
            matcher: configuration of the matcher's model.
            dim: dimension of the descriptors.
        """
        is_strict = (matcher.get("ratio_threshold") or 1) <= STRICT
        gate = self
        if self.max_mirrored is None:
            gate = replace(gate, max_mirrored=MIRRORED_RATIO if is_strict else MIRRORED)
        if self.min_agreement is not None:
            return gate
        if not is_strict:
            return replace(gate, min_agreement=AGREEMENT, min_agreement_noisy=AGREEMENT_NOISY)
        return replace(gate, min_agreement=AGREEMENT_FEW if dim < FEW else AGREEMENT_RATIO)

    def of_photo(self, blur: float) -> "Gate":
        """Return the gate for a photo whose noise was reduced by a blur in pixels, 0 for none."""
        noisy = self.min_agreement_noisy
        return replace(self, min_agreement=noisy) if blur > 0 and noisy else self

    def is_mirrored(self, confidence: float, of_mirror_image: float) -> bool:
        """Tell from the confidences of a pose and of its mirror image whether neither is sure."""
        most = MIRRORED if self.max_mirrored is None else self.max_mirrored
        return of_mirror_image > most * confidence

    def least_agreement(self, confidence: float) -> float:
        """Return the least agreement of a pose with a confidence."""
        steps = self.min_agreement or AGREEMENT
        return next((least for start, least in reversed(steps) if confidence >= start), 0.0)


DEFAULT_GATE = Gate()
