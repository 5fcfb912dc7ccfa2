"""The pose of a query from 2D-3D matches: RANSAC, other intrinsics, and whether to trust it."""

import copy
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from ..utils import colmap
from . import resection
from .confidence import (
    MAX_POSITION,
    MAX_ROTATION,
    MIN_MATCHES,
    RIVAL,
    Gate,
    agreement,
    confidence,
    focal_lengths,
    uncertainty,
)
from .projection import ALL, FOCAL, POSE, RADIAL, SKEW, reprojection_errors
from .resection import Resection, View

SEED = 0
MAX_ERROR = 12.0  # pixels, pycolmap's default
LEAST_RATIO = 0.1  # of inliers, pycolmap's default
CLEAR = 0.25  # inlier ratio above which the matches of single images are not tried
MOST_SIMILAR = 100  # matches of an image that are tried by themselves
ROUNDS = 3  # of estimation from the inliers among all matches
RIVAL_SAMPLE = 500  # matches, at most, from which a rival is estimated
# poses that differ by more are rivals
SAME_ROTATION = 10.0  # degrees
SAME_POSITION = 0.25  # of the median depth of the inliers
# ratios of the confidence with other intrinsics to the confidence with the assumed ones
DISTORTED = 1.02  # above it, the lens has a radial distortion
UNCLEAR = 1.05  # above it, the other intrinsics may be right
UNCLEAR_CROPPED = 0.8  # the same, if the photo may be cropped: their parameters cost confidence
RIGHT = 1.1  # above it, the other intrinsics are right
# multiples of MAX_POSITION and MAX_ROTATION
PRECISE = 0.6, 1.0  # uncertainty of a pose; one error in ten is more than 1.9 times as large
ESTIMATED = 0.4, 1.0  # the same, with all intrinsics estimated
TOLERANT = 1.2  # between poses with listed and other focal lengths: many lists are 5 % off
CROPPED = 3.0, 1.0  # uncertainty with unknown intrinsics, of a photo that may be cropped
ZOOMED = 1.15  # times the map's focal lengths: beyond, a photo may be cropped and enlarged
LISTED = 0.1, 50.0  # range of listed focal lengths, in longer sides
# distances of the principal point from the centre, as shares of the size
OFF_CENTRE, CENTRED = 0.15, 0.02


@dataclass(frozen=True)
class Pose:
    """A pose and how the matches agree with it.

    Args:
        cam_from_world: the pose, None if there is none.
        camera: intrinsics, refined if the configuration says so.
        inliers: (M,) bool.
        confidence: see `confidence.confidence`.
        agreement: see `confidence.agreement`.
        refusal: why it is not trusted, None if it is.
        degrees_of_freedom: the number of estimated parameters, see `projection`.
    """

    cam_from_world: pycolmap.Rigid3d | None
    camera: pycolmap.Camera
    inliers: np.ndarray
    confidence: float = -np.inf
    agreement: float = 0.0
    refusal: str | None = None
    degrees_of_freedom: int = POSE

    @property
    def num_inliers(self) -> int:
        """The number of inliers."""
        return int(self.inliers.sum())


@dataclass(frozen=True)
class _Matches:
    """All matches of a query, and its intrinsics with the configuration; see `estimate`."""

    points2D: np.ndarray
    points3D: np.ndarray
    camera: pycolmap.Camera
    config: dict

    def __len__(self) -> int:
        return len(self.points2D)

    @property
    def max_error(self) -> float:
        return self.config.get("estimation", {}).get("ransac", {}).get("max_error", MAX_ERROR)

    def may_be_cropped(self, pose: Pose) -> bool:
        """Return whether the photo may be cropped, or enlarged, too, by the focal length found."""
        photo = self.config.get("photo", {})
        low, high = photo.get("focal_lengths", (0, np.inf))
        fits = low / ZOOMED <= pose.camera.mean_focal_length() <= ZOOMED * high
        return bool(photo.get("cropped")) or not fits

    @property
    def is_focal_length_guessed(self) -> bool:
        return bool(self.config.get("estimation", {}).get("estimate_focal_length"))

    @property
    def is_focal_length_free(self) -> bool:
        refined = self.config.get("refinement", {}).get("refine_focal_length")
        return self.is_focal_length_guessed or bool(refined)


def estimate(
    points2D: np.ndarray,
    points3D: np.ndarray,
    images: list[np.ndarray],
    camera: pycolmap.Camera,
    config: dict,
    gate: Gate,
    thorough: bool = True,
    workers: int = 1,
) -> Pose:
    """Estimate an absolute pose and judge it.

    If few of all matches agree with a pose, RANSAC may have missed the right one. So the most
    similar matches of each image are tried by themselves, too: those of an image that shows the
    same place agree much more often. The pose with the highest confidence among all matches wins.

    Args:
        points2D: (M, 2) image points of all matches, COLMAP's pixels.
        points3D: (M, 3) their world points.
        images: of each map image the indices of its matches, the most similar first.
        camera: intrinsics.
        config: hloc's dict of options of pycolmap, under "estimation" and "refinement"; under
            "photo", whether it may be "cropped", or the range of the map's "focal_lengths".
        gate: what a pose must have to be trusted.
        thorough: try the matches of single images, too.
        workers: threads that estimate poses; the result does not depend on their number.
    """
    matches = _Matches(points2D, points3D, camera, config)
    number = len(matches)
    with ThreadPoolExecutor(workers) as pool:
        poses = [_estimate(matches, np.arange(number))]
        if thorough and poses[0].num_inliers < CLEAR * number:
            tried = [chosen for chosen in images if MIN_MATCHES <= len(chosen) < number]
            poses += pool.map(lambda chosen: _estimate(matches, chosen[:MOST_SIMILAR]), tried)
        first = max(poses, key=_quality)
        rivals = pool.submit(_rivals, matches, first) if workers > 1 else None
        best, doubt = _calibrate(matches, first)
        poses += rivals.result() if rivals and best is first else _rivals(matches, best)
    best = replace(best, agreement=agreement(best.inliers, images))
    return replace(best, refusal=_refusal(matches, best, poses, gate, doubt))


def _rivals(matches: _Matches, pose: Pose) -> list[Pose]:
    """Return the pose that the outliers of a pose give, none if they are few."""
    others = np.flatnonzero(~pose.inliers)
    if not len(others) >= RIVAL * pose.num_inliers > 0:
        return []
    # half as many inliers as a rival of this confidence is expected to have
    least = RIVAL / 2 * pose.num_inliers / len(others)
    sample = np.random.default_rng(SEED).permutation(others)[:RIVAL_SAMPLE]
    return [_estimate(matches, sample, max(LEAST_RATIO, least))]


def _quality(pose: Pose) -> tuple[float, int]:
    return pose.confidence, pose.num_inliers


def _estimate(matches: _Matches, chosen: np.ndarray, least_ratio: float = LEAST_RATIO) -> Pose:
    """Estimate a pose from chosen matches, then from all matches that agree with it.

    Args:
        matches: of the query.
        chosen: (N,) indices of some of them.
        least_ratio: share of inliers below which RANSAC need not find a pose among these.
    """
    points2D, points3D, number = matches.points2D, matches.points3D, len(matches)
    ransac = {"random_seed": SEED, "min_inlier_ratio": least_ratio}
    pose = Pose(None, matches.camera, np.zeros(number, bool))
    for _ in range(1 if len(chosen) == number else ROUNDS):
        camera = copy.deepcopy(pose.camera)
        chosen_points = points2D[chosen], points3D[chosen]
        found = colmap.estimate_pose(*chosen_points, camera, matches.config, ransac)
        if not found:
            break
        cam_from_world = found["cam_from_world"]
        if len(chosen) == number:
            inliers = np.asarray(found["inlier_mask"], bool)
        else:
            errors, _ = reprojection_errors(points2D, points3D, cam_from_world, camera)
            inliers = errors <= matches.max_error
        if inliers.sum() <= pose.num_inliers:
            break
        pose, chosen = Pose(cam_from_world, camera, inliers), np.flatnonzero(inliers)
    if pose.cam_from_world is None:
        return pose
    freedom = FOCAL if matches.is_focal_length_free else POSE
    view = pose.cam_from_world, pose.camera
    value = confidence(points2D, points3D, *view, matches.max_error, freedom)
    return replace(pose, confidence=value, degrees_of_freedom=freedom)


def _calibrate(matches: _Matches, pose: Pose) -> tuple[Pose, str | None]:
    """Test whether other intrinsics than those of a pose fit the matches better.

    If the focal length is unknown, they replace them: a distortion, or the aspect ratio and the
    principal point, too, of a photo that was cropped or stretched. If it is known, another one
    contradicts it. A skew, which no lens has, reveals a photo of a picture.

    Returns:
        The likelier pose, and a reason not to trust it, if any.
    """
    if pose.cam_from_world is None or pose.num_inliers < ALL:
        return pose, None
    if pose.camera.mean_focal_length() <= 0:  # as RANSAC may estimate it
        return pose, None
    image, pinhole = resection.undistort(matches.points2D, pose.camera)
    start = pose.cam_from_world, pinhole
    free = matches.is_focal_length_free and not resection.is_distorted(pose.camera)
    points3D, assumed = matches.points3D, pose
    if free:
        radial = _resect(matches, image, start, RADIAL) or pose
        if radial.confidence > DISTORTED * pose.confidence:
            assumed = radial
    found = resection.resect_anew(image, points3D, *start, matches.max_error)
    other = _judged(matches, found, ALL)
    skewed = _resect(matches, image, found[:2] if found else start, SKEW)
    likelier = max(assumed, other or assumed, key=_quality)
    fits = skewed is not None and skewed.confidence > RIGHT * likelier.confidence
    if skewed and fits and differ(skewed, likelier, points3D, MAX_POSITION, MAX_ROTATION):
        reason = "it may be warped, or a photo of a picture: a skew fits much better"
        return likelier if free else pose, reason
    if not free:
        centred = resection.centred(pose.cam_from_world, pose.camera)
        guesses = (image, start), (matches.points2D, centred)
        return pose, _contradiction(matches, pose, other, guesses)
    unclear = UNCLEAR_CROPPED if matches.may_be_cropped(assumed) else UNCLEAR
    return _choose(assumed, other, points3D, unclear) if other else (assumed, None)


def _resect(matches: _Matches, points2D: np.ndarray, start: View, freedom: int) -> Pose | None:
    """Refine a pose and PINHOLE intrinsics from image points, and judge them."""
    found = resection.resect(points2D, matches.points3D, *start, matches.max_error, freedom)
    return _judged(matches, found, freedom)


def _judged(matches: _Matches, found: Resection | None, freedom: int) -> Pose | None:
    """Return the pose of a resection, with its confidence."""
    if found is None:
        return None
    view, points2D = found[:2], found.points2D
    value = confidence(points2D, matches.points3D, *view, matches.max_error, freedom)
    return Pose(*found[:3], confidence=value, degrees_of_freedom=freedom)


def _contradiction(
    matches: _Matches, pose: Pose, anew: Pose | None, guesses: Iterable[tuple[np.ndarray, View]]
) -> str | None:
    """Say which intrinsics contradict those of a pose, None if none do.

    Args:
        matches: of the query.
        pose: with the listed intrinsics.
        anew: with intrinsics that do not depend on them, all of them estimated.
        guesses: image points (M, 2), and a pose with PINHOLE intrinsics from which another focal
            length is estimated.
    """
    limits = TOLERANT * MAX_POSITION, TOLERANT * MAX_ROTATION
    for points2D, start in guesses:
        other = _resect(matches, points2D, start, FOCAL)
        if other is None or other.confidence <= pose.confidence:
            continue
        if differ(pose, other, matches.points3D, *limits):
            return (
                "its intrinsics contradict the map: a focal length of "
                f"{other.camera.mean_focal_length():.0f} pixels fits better, and the pose differs"
            )
    if anew is None or anew.confidence <= RIGHT * pose.confidence:
        return None
    if not differ(pose, anew, matches.points3D, *limits):
        return None
    return (
        "its intrinsics contradict the map: another principal point and aspect ratio fit much "
        "better, and the pose differs"
    )


def _choose(
    assumed: Pose, other: Pose, points3D: np.ndarray, unclear: float
) -> tuple[Pose, str | None]:
    """Choose between poses with assumed and with other intrinsics, as `_calibrate` returns them.

    Neither is trusted if the ratio of their confidences is above `unclear`, and they differ.
    """
    if other.confidence > RIGHT * assumed.confidence:
        return other, None
    if other.confidence <= unclear * assumed.confidence or not differ(
        assumed, other, points3D, MAX_POSITION, MAX_ROTATION
    ):
        return assumed, None
    return assumed, (
        "it may be cropped or stretched: another principal point and aspect ratio fit about as "
        "well, and the pose differs"
    )


def _refusal(
    matches: _Matches, pose: Pose, others: list[Pose], gate: Gate, doubt: str | None
) -> str | None:
    """Return why a pose is not trusted in view of other poses and of `doubt`, None if it is."""
    number, listed = pose.num_inliers, matches.camera.mean_focal_length()
    relative = listed / max(matches.camera.width, matches.camera.height)
    if not (matches.is_focal_length_free or LISTED[0] <= relative <= LISTED[1]):
        return f"no lens has its listed focal length of {listed:g} pixels: is it in millimetres?"
    if number < gate.min_inliers:
        return f"too few inliers: {number}, at least {gate.min_inliers} are needed"
    if pose.cam_from_world is None or pose.confidence < gate.min_confidence:
        return (
            f"{number} inliers of {len(matches)} matches may be chance: confidence "
            f"{_down(max(0, pose.confidence), 1)}, at least {gate.min_confidence:g} is needed"
        )
    focal_length = pose.camera.mean_focal_length()
    low, high = focal_lengths(matches.camera, matches.is_focal_length_guessed)
    if matches.is_focal_length_free and not low <= focal_length <= high:
        found = f"{focal_length:.0f} pixels" if 0 < focal_length < 100 * high else "none"
        return f"no plausible focal length: {found}, {low:.0f} to {high:.0f} were expected"
    if _is_swapped(matches.camera):
        return "the x and y of its listed principal point are swapped"
    if reason := doubt or _imprecision(matches, pose, pose.cam_from_world):
        return reason
    least = gate.least_agreement(pose.confidence)
    if pose.agreement < least:
        return (
            "the matches of no image agree with the pose: agreement "
            f"{_down(pose.agreement, 2)}, at least {least:g} is needed"
        )
    for other in others:
        if is_rival(pose, other, matches.points3D):
            return f"ambiguous: another pose has {other.num_inliers} inliers, this one {number}"
    return None


def _imprecision(matches: _Matches, pose: Pose, cam_from_world: pycolmap.Rigid3d) -> str | None:
    """Return how the inliers fail to determine a pose, None if they determine it."""
    inliers = matches.points2D[pose.inliers], matches.points3D[pose.inliers]
    precise = ESTIMATED if pose.degrees_of_freedom == ALL else PRECISE
    limits = [(pose.degrees_of_freedom, precise, "the inliers do not fix the pose: its")]
    if matches.may_be_cropped(pose):
        reason = "it may be cropped, and without its intrinsics its"
        limits.append((ALL, CROPPED, reason))
    elif _is_off_centre(matches.camera):
        reason = "its principal point is far from the centre, and without its intrinsics its"
        limits.append((ALL, CROPPED, reason))
    for freedom, (far, turned), reason in limits:
        position, rotation = uncertainty(*inliers, cam_from_world, pose.camera, freedom)
        hint = "; known intrinsics would help" if matches.is_focal_length_free else ""
        if position > far * MAX_POSITION or rotation > turned * MAX_ROTATION:
            return (
                f"{reason} position is uncertain by {_up(100 * position):.1f} % of the distance "
                f"(at most {100 * far * MAX_POSITION:.0f} %), its rotation by "
                f"{_up(rotation):.1f} degrees (at most {turned * MAX_ROTATION:.0f}){hint}"
            )
    return None


def _up(value: float) -> float:
    """Round up to tenths: what is above a limit is not to be printed as the limit."""
    return np.ceil(10 * value) / 10


def _down(value: float, digits: int) -> str:
    """Round down: what is below a limit is not to be printed as the limit."""
    return f"{np.floor(value * 10**digits) / 10**digits:.{digits}f}"


def _is_off_centre(camera: pycolmap.Camera) -> bool:
    """Tell whether listed intrinsics belong to a cropped photo, or are wrong."""
    x, y = camera.principal_point_x, camera.principal_point_y
    return _off_centre(camera, x, y) > OFF_CENTRE


def _is_swapped(camera: pycolmap.Camera) -> bool:
    """Tell whether the principal point is in the centre only if its coordinates are swapped."""
    x, y = camera.principal_point_x, camera.principal_point_y
    return _off_centre(camera, y, x) < CENTRED < _off_centre(camera, x, y) / 2


def _off_centre(camera: pycolmap.Camera, x: float, y: float) -> float:
    """Return how far a point is from the centre, as a share of the size."""
    return float(np.abs(np.array([x / camera.width, y / camera.height]) - 0.5).max())


def is_rival(pose: Pose, other: Pose, points3D: np.ndarray) -> bool:
    """Return whether another pose, from other matches, makes a pose ambiguous.

    Args:
        pose: the best one.
        other: from the same matches (M).
        points3D: (M, 3) their points.
    """
    if other.confidence < RIVAL * pose.confidence:
        return False
    shared = (other.inliers & pose.inliers).sum()
    return bool(2 * shared < other.num_inliers) and differ(pose, other, points3D)


def differ(
    pose: Pose,
    other: Pose,
    points3D: np.ndarray,
    position: float = SAME_POSITION,
    rotation: float = SAME_ROTATION,
) -> bool:
    """Return whether two poses differ by more than a position or a rotation.

    Args:
        pose: one of them.
        other: the other one.
        points3D: (M, 3) the points of the first one's matches.
        position: in units of the median depth of the first one's inliers.
        rotation: in degrees.
    """
    if pose.cam_from_world is None or other.cam_from_world is None:
        return False
    relative = pose.cam_from_world * other.cam_from_world.inverse()
    inliers = points3D[pose.inliers]
    depths = inliers @ pose.cam_from_world.rotation.matrix().T + pose.cam_from_world.translation
    moved = np.linalg.norm(relative.translation) / np.median(depths[:, 2])
    return np.degrees(relative.rotation.angle()) > rotation or moved > position
