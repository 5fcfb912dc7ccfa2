"""What a pose of a query measures: numbers without limits, by which `gate` decides."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from math import comb, log10
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from ..utils.arrays import distinct
from .projection import FOCAL, POSE, photo_scale, project, reprojection_errors

SOLUTIONS = 4  # poses that a minimal sample may have
THRESHOLDS = 8  # inlier thresholds that are tried, from FINEST to RANSAC's
FINEST = 1.0  # pixel
# pixels; keypoints of other scales or orientations that are nearer count once
SAME_PLACE = 2.0
NEIGHBORS = 8  # projections from which the density around a keypoint is estimated
LEAST_NOISE = 0.5  # pixels, the least standard deviation of a keypoint
INDEPENDENT = 100  # inliers with independent errors: neighbors err alike
# the same where other intrinsics may make up for errors of the map, which are alike in a bent one
INDEPENDENT_IF_BENT = 30
DEVIATIONS = 3.0  # standard deviations by which a pose may be off
MIN_MATCHES = 6  # of an image whose matches may tell whether a pose is right


class Seen(NamedTuple):
    """The matches of a photo, and what they are judged by, see `confidence`."""

    points2D: np.ndarray
    points3D: np.ndarray
    cam_from_world: pycolmap.Rigid3d
    camera: pycolmap.Camera
    max_error: float


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
    seen = Seen(points2D, points3D, cam_from_world, camera, max_error)
    return joint_confidence([seen], degrees_of_freedom)


def joint_confidence(photos: Sequence[Seen], degrees_of_freedom: int = POSE) -> float:
    """Return the `confidence` of one pose that places several photos, as those of a rig.

    Args:
        photos: their matches; those of all count together.
        degrees_of_freedom: the number of estimated parameters, see `projection`.
    """
    sample = -(-degrees_of_freedom // 2)  # matches that determine a pose
    counts = [_counting(seen) for seen in photos]
    thresholds = [
        np.geomspace(
            min(FINEST * photo_scale(seen.camera), seen.max_error), seen.max_error, THRESHOLDS
        )
        for seen in photos
    ]

    def log10_false_alarms(limits: tuple[float, ...]) -> float:
        found = [count(limit) for count, limit in zip(counts, limits, strict=True)]
        number, inliers, expected, matches = map(sum, zip(*found, strict=True))
        if number <= sample:
            return np.inf
        tail = _log10_tail(inliers - sample, number - sample, expected / number)
        poses = log10(comb(number, sample)) + sample * np.log10(matches / number)
        return poses + np.log10(SOLUTIONS * THRESHOLDS) + tail

    return float(-min(map(log10_false_alarms, zip(*thresholds, strict=True))))


def _counting(seen: Seen) -> Callable[[float], tuple[int, int, float, int]]:
    """Return what counts the matches of a photo for `confidence`, given an inlier threshold.

    It returns the number of cells with a keypoint, of these the inliers, how many are expected by
    chance, and the number of matches.
    """
    points2D, points3D, cam_from_world, camera, _ = seen
    errors, projected = reprojection_errors(points2D, points3D, cam_from_world, camera)
    density = _density(points2D, projected, camera)
    # one number tells points apart: hardly any two points have equal ones
    point = np.unique(points3D @ [1, np.sqrt(2), np.sqrt(3)], return_inverse=True)[1]
    scale = photo_scale(camera)

    def count(threshold: float) -> tuple[int, int, float, int]:
        side = max(SAME_PLACE * scale, threshold)
        column, row = np.floor(points2D / side).astype(np.int64).T
        _, first, place = np.unique((column << 32) + row, return_index=True, return_inverse=True)
        agree = errors <= threshold
        inliers = min(_num_distinct(place[agree]), _num_distinct(point[agree]))
        chances = np.bincount(place, minlength=len(first))
        expected = np.minimum(1, chances * np.pi * threshold**2 * density[first]).sum()
        return len(first), inliers, float(expected), len(points2D)

    return count


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

    def allows(self, position: float, rotation: float) -> bool:
        """Tell whether a pose that is so uncertain may be off by so much.

        Args:
            position: in units of the inliers' median depth.
            rotation: in degrees.
        """
        near = position <= DEVIATIONS * self.position
        return bool(near and rotation <= DEVIATIONS * self.rotation)

    def at_least(self, position: float, rotation: float) -> "Uncertainty":
        """Return it, but with at least this for the position and the rotation, see `allows`."""
        return self._replace(
            position=max(self.position, position), rotation=max(self.rotation, rotation)
        )


UNDETERMINED = Uncertainty(np.inf, np.inf, np.inf)


def covariance(
    points2D: np.ndarray,
    points3D: np.ndarray,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    degrees_of_freedom: int = POSE,
) -> np.ndarray | None:
    """Return the covariance of a pose that inliers determine, to first order from their errors.

    It is that of a small motion of the camera, and of its unknown intrinsics. The inliers are taken
    to be independent, and the map to be exact.

    Args:
        points2D: (M, 2) image points of the inliers, COLMAP's pixels.
        points3D: (M, 3) their world points.
        cam_from_world: the pose.
        camera: intrinsics.
        degrees_of_freedom: the number of unknown parameters, see `projection`.

    Returns:
        (F, F) float64 of the unknown parameters: the rotation about the camera's axes in radians,
        the translation along them in the units of the map, the focal length as its logarithm, and
        so on. None if the inliers do not determine them.
    """
    equations, unknowns = 2 * len(points2D), degrees_of_freedom
    if equations <= unknowns:
        return None
    local = points3D @ cam_from_world.rotation.matrix().T + cam_from_world.translation
    depth = np.median(local[:, 2])
    _, derivatives = project(local / depth)
    jacobian = camera.mean_focal_length() * np.concatenate(derivatives, axis=1)
    jacobian = jacobian[:degrees_of_freedom].T
    errors, _ = reprojection_errors(points2D, points3D, cam_from_world, camera)
    measured = (errors**2).sum() / (equations - unknowns)
    noise = max((LEAST_NOISE * photo_scale(camera)) ** 2, measured)
    try:
        found = noise * np.linalg.inv(jacobian.T @ jacobian)
    except np.linalg.LinAlgError:
        return None
    if not (np.diag(found) > 0).all():
        return None
    unit = np.ones(degrees_of_freedom)
    unit[3:POSE] = depth
    return found * np.outer(unit, unit)


def rig_covariance(
    photos: Sequence[Seen], cams_from_rig: Sequence[pycolmap.Rigid3d]
) -> np.ndarray | None:
    """Return the `covariance` of the pose of a rig, of a small motion of it in its own frame.

    Args:
        photos: the inliers of each camera.
        cams_from_rig: the pose of each camera in the rig.

    Returns:
        (6, 6) float64; None if the inliers do not determine the pose.
    """
    information, squares, equations = np.zeros((POSE, POSE)), 0.0, 0
    least, depths = 0.0, []
    for seen, cam_from_rig in zip(photos, cams_from_rig, strict=True):
        if not len(seen.points2D):
            continue
        pose = seen.cam_from_world
        local = seen.points3D @ pose.rotation.matrix().T + pose.translation
        _, derivatives = project(local)
        jacobian = seen.camera.mean_focal_length() * np.concatenate(derivatives, axis=1)[:POSE].T
        moved = cam_from_rig.adjoint()
        information += (jacobian @ moved).T @ (jacobian @ moved)
        errors, _ = reprojection_errors(*seen[:4])
        squares, equations = squares + (errors**2).sum(), equations + 2 * len(errors)
        least = max(least, (LEAST_NOISE * photo_scale(seen.camera)) ** 2)
        depths.append(local[:, 2])
    if equations <= POSE:
        return None
    unit = np.ones(POSE)
    unit[3:] = np.median(np.concatenate(depths))
    noise = max(least, squares / (equations - POSE))
    try:
        found = noise * np.linalg.inv(information * np.outer(unit, unit))
    except np.linalg.LinAlgError:
        return None
    return found * np.outer(unit, unit) if (np.diag(found) > 0).all() else None


def uncertainty(
    points2D: np.ndarray,
    points3D: np.ndarray,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    degrees_of_freedom: int = POSE,
    independent: float = INDEPENDENT,
) -> Uncertainty:
    """Estimate how precisely inliers determine a pose, from its `covariance`.

    Args:
        points2D: (M, 2) image points of the inliers, COLMAP's pixels.
        points3D: (M, 3) their world points.
        cam_from_world: the pose.
        camera: intrinsics.
        degrees_of_freedom: the number of unknown parameters, see `projection`.
        independent: more inliers do not make the pose more precise.
    """
    found = covariance(points2D, points3D, cam_from_world, camera, degrees_of_freedom)
    depths = points3D @ cam_from_world.rotation.matrix()[2] + cam_from_world.translation[2]
    depth = float(np.median(depths)) if len(depths) else 1.0
    return standard_deviations(found, depth, len(points2D), independent)


def standard_deviations(
    covariance: np.ndarray | None, depth: float, number: int, independent: float = INDEPENDENT
) -> Uncertainty:
    """Return the `uncertainty` of a pose.

    Args:
        covariance: (F, F) of the pose, see `covariance`; None if it is not determined.
        depth: median depth of the inliers.
        number: of the inliers.
        independent: more of them do not make the pose more precise.
    """
    if covariance is None:
        return UNDETERMINED
    variance, bent = np.diag(covariance), max(1, number / independent)
    rotation, position, focal_length = variance[:3], variance[3:POSE], variance[POSE:FOCAL]
    return Uncertainty(
        position=float(np.sqrt(bent * position.sum()) / abs(depth)),
        rotation=float(np.degrees(np.sqrt(bent * rotation.sum()))),
        focal_length=float(np.sqrt(focal_length.sum())),
    )


def most_telling(
    photos: Sequence[Seen], cams_from_rig: Sequence[pycolmap.Rigid3d]
) -> tuple[int, np.ndarray]:
    """Find the place in a photo without whose keypoints a pose would be least certain.

    That is, without which the determinant of the inverse of its covariance is the smallest part.
    A wrong match far from all others may fit as well as they do, and what it alone determines looks
    certain: so a pose is only as certain as the others make it.

    Args:
        photos: the inliers of each camera, which determine the pose.
        cams_from_rig: the pose of each camera in the rig.

    Returns:
        The index of the camera, and which inliers (M,) bool of that are within SAME_PLACE.
    """
    of_places, total = [], np.zeros((POSE, POSE))
    for seen, cam_from_rig in zip(photos, cams_from_rig, strict=True):
        pose = seen.cam_from_world
        local = seen.points3D @ pose.rotation.matrix().T + pose.translation
        sides = project(local)[1][:, :POSE].transpose(2, 0, 1) @ cam_from_rig.adjoint()
        each = seen.camera.mean_focal_length() ** 2 * sides.swapaxes(1, 2) @ sides
        sums = _at_places(seen) @ each.reshape(len(each), POSE**2)
        of_places.append(sums.reshape(each.shape))
        total += each.sum(axis=0)
    # a pseudo-inverse, also of matches that do not determine the pose
    inverse = np.linalg.pinv(total, hermitian=True)
    left = [np.linalg.det(np.eye(POSE) - inverse @ places) for places in of_places]
    most = int(np.argmin([part.min(initial=np.inf) for part in left]))
    seen, place = photos[most], photos[most].points2D[left[most].argmin()]
    apart = np.linalg.norm(seen.points2D - place, axis=1)
    return most, apart <= SAME_PLACE * photo_scale(seen.camera)


def _at_places(seen: Seen):  # type: ignore[no-untyped-def]
    """Return a sparse matrix (M, M): 1 where one match is within SAME_PLACE of another, or it."""
    from scipy.sparse import coo_array, eye_array
    from scipy.spatial import cKDTree

    near = SAME_PLACE * photo_scale(seen.camera)
    pairs = cKDTree(seen.points2D).query_pairs(near, output_type="ndarray")
    one, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    number = len(seen.points2D)
    return eye_array(number, format="csr") + coo_array(
        (np.ones(len(one)), (one, other)), shape=(number, number)
    )


def independent_of(photos: Sequence[Seen]) -> float:
    """Return how many matches count as independent: each place once, INDEPENDENT at most."""
    places = sum((1 / _at_places(seen).sum(axis=1)).sum() for seen in photos)
    return min(INDEPENDENT, float(places))


def all_but_most_telling(seen: Seen, degrees_of_freedom: int = POSE) -> np.ndarray | None:
    """Return which inliers (M,) bool are not `most_telling`, None if they do not fix a pose."""
    if covariance(*seen[:4], degrees_of_freedom) is None:
        return None
    return ~most_telling([seen], [pycolmap.Rigid3d()])[1]


def uncertainty_without_one(
    seen: Seen, degrees_of_freedom: int = POSE, kept: np.ndarray | None = None
) -> Uncertainty:
    """Estimate the `uncertainty` of a pose by all inliers but those that tell most about it.

    Args:
        seen: the inliers.
        degrees_of_freedom: the number of unknown parameters, see `projection`.
        kept: (M,) bool, `all_but_most_telling` if they are known.
    """
    if kept is None and (kept := all_but_most_telling(seen, degrees_of_freedom)) is None:
        return UNDETERMINED
    left = seen._replace(points2D=seen.points2D[kept], points3D=seen.points3D[kept])
    return uncertainty(*left[:4], degrees_of_freedom, independent_of([left]))


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


class Alternative(NamedTuple):
    """Another pose of the same query, as one that fits with other intrinsics, or other matches.

    Args:
        ratio: its confidence as a multiple of that of the pose; of a pose by other images, the
            numbers of inliers instead.
        position: how far both positions differ, in units of the inliers' median depth.
        rotation: how far both rotations differ, in degrees.
        detail: what messages name: its focal length in pixels, or its number of inliers.
    """

    ratio: float
    position: float = 0.0
    rotation: float = 0.0
    detail: float = 0.0


@dataclass(frozen=True)
class Measures:
    """All that is measured of a pose, by which `gate` decides whether to trust it.

    Args:
        num_matches: number of different 2D-3D matches.
        num_inliers: number of RANSAC's inliers.
        confidence: see `confidence`; minus infinity without a pose.
        agreement: see `agreement`.
        uncertainty: see `uncertainty_without_one`, with the degrees of freedom of the estimation;
            if the focal length is known, at least how far the pose moves without the place that
            tells most.
        uncropped: see `uncertainty`, with all intrinsics unknown, as those of a photo that was
            cropped.
        degrees_of_freedom: of the estimation, see `projection`.
        may_be_cropped: whether the photo may have been cropped.
        longer_side: of the photo, in pixels.
        is_camera_given: whether the intrinsics are known, not those of the map's photos.
        is_focal_length_free: whether the focal length was estimated or refined.
        focal_length: that of the pose, in pixels.
        given_focal_length: that of the intrinsics before the estimation, in pixels.
        focal_range: the least and the largest plausible one, in pixels.
        off_centre: how far the principal point is from the centre, as a share of the size.
        off_centre_swapped: the same if its coordinates are swapped.
        alternatives: other poses by kind, a key of `gate.ALTERNATIVES`: of each kind the likeliest.
        mirror_image: confidence of the pose of the mirror image, None if that was not tried.
    """

    num_matches: int = 0
    num_inliers: int = 0
    confidence: float = -np.inf
    agreement: float = 0.0
    uncertainty: Uncertainty = UNDETERMINED
    uncropped: Uncertainty = UNDETERMINED
    degrees_of_freedom: int = POSE
    may_be_cropped: bool = False
    longer_side: int = 1
    is_camera_given: bool = False
    is_focal_length_free: bool = False
    focal_length: float = 0.0
    given_focal_length: float = 0.0
    focal_range: tuple[float, float] = (0.0, np.inf)
    off_centre: float = 0.0
    off_centre_swapped: float = 0.0
    alternatives: Mapping[str, Alternative] = field(default_factory=dict)
    mirror_image: float | None = None

    def to_dict(self) -> dict:
        """Return them as JSON values, with None for infinite numbers."""
        return _finite(asdict(self))

    @classmethod
    def from_dict(cls, values: Mapping) -> "Measures":
        """Return the measures of `to_dict`."""
        known = dict(values)
        for key in ("uncertainty", "uncropped"):
            known[key] = Uncertainty(*(np.inf if one is None else one for one in known[key]))
        known["confidence"] = -np.inf if known["confidence"] is None else known["confidence"]
        known["focal_range"] = tuple(known["focal_range"])
        others = known["alternatives"].items()
        return cls(**{**known, "alternatives": {kind: Alternative(*one) for kind, one in others}})


def _finite(value: Any) -> Any:
    """Replace numbers that JSON does not have by None, and tuples by lists."""
    if isinstance(value, Mapping):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
