"""The pose of a query from 2D-3D matches: RANSAC, other intrinsics, and whether to trust it."""

import copy
from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from . import colmap, resection
from .confidence import (
    MAX_POSITION,
    MAX_ROTATION,
    RIVAL,
    Gate,
    agreement,
    confidence,
    focal_lengths,
    reprojection_errors,
    uncertainty,
)

SEED = 0
MAX_ERROR = 12.0  # pixels, pycolmap's default
CLEAR = 0.25  # inlier ratio above which images are not tried by themselves
MAX_IMAGES = 20  # tried by themselves, those with most matches
MIN_MATCHES = 6  # of an image that is tried
ROUNDS = 3  # of estimation from the inliers among all matches
# two poses that differ by more are rivals
SAME_ROTATION = 10.0  # degrees
SAME_POSITION = 0.25  # of the inliers' median depth
# confidence with other intrinsics, by that with the assumed ones: above these a distortion is
# right, all others may be, and all others are
DISTORTED, UNCLEAR, RIGHT = 1.02, 1.05, 1.1
# times the limits of uncertainty: by how much other intrinsics than given ones must move the pose
# to contradict them, as many lists give focal lengths of EXIF data; and how uncertain a pose may be
# if guessed intrinsics are all wrong, as those of a cropped photo
LENIENT, CROPPED = 2.0, 3.0
OFF_CENTRE = 0.15  # of the size of a photo, from its centre to its principal point


@dataclass(frozen=True)
class Pose:
    """A pose and how the matches agree with it.

    Args:
        cam_from_world: the pose, None where there is none.
        camera: intrinsics, refined where the configuration says so.
        inliers: (M,) bool.
        confidence: `confidence.confidence`.
        agreement: `confidence.agreement`.
        refusal: why it is not to be trusted, None if it is.
        degrees_of_freedom: 6 for the pose alone, 7 with the focal length, 8 with a distortion too,
            11 with the aspect ratio and the principal point too.
    """

    cam_from_world: pycolmap.Rigid3d | None
    camera: pycolmap.Camera
    inliers: np.ndarray
    confidence: float = -np.inf
    agreement: float = 0.0
    refusal: str | None = None
    degrees_of_freedom: int = 6

    @property
    def num_inliers(self) -> int:
        """The number of inliers."""
        return int(self.inliers.sum())


def estimate(
    points2D: np.ndarray,
    points3D: np.ndarray,
    images: list[np.ndarray],
    camera: pycolmap.Camera,
    config: dict,
    gate: Gate,
) -> Pose:
    """Estimate an absolute pose and judge it.

    Where few of all matches agree with a pose, RANSAC may have missed the right one, so the matches
    of each image are tried by themselves, too: those of an image that shows the same place agree
    much more often. The pose of the highest confidence among all matches wins.

    Args:
        points2D: (M, 2) image points of all matches, COLMAP's pixels.
        points3D: (M, 3) their world points.
        images: of each map image the indices of its matches.
        camera: intrinsics.
        config: hloc's dict of options of pycolmap, under "estimation" and "refinement".
        gate: what is trusted.
    """
    number = len(points2D)
    poses = [_estimate(points2D, points3D, np.arange(number), camera, config)]
    if poses[0].num_inliers < CLEAR * number:
        tried = [matches for matches in images if MIN_MATCHES <= len(matches) < number]
        for chosen in sorted(tried, key=len, reverse=True)[:MAX_IMAGES]:
            poses.append(_estimate(points2D, points3D, chosen, camera, config))
    best = max(poses, key=_quality)
    if 0 < best.num_inliers < number / (1 + RIVAL):  # then a rival may be among the others
        others = np.flatnonzero(~best.inliers)
        poses.append(_estimate(points2D, points3D, others, camera, config))
        best = max(poses, key=_quality)
    rivals = [pose for pose in poses if differ(best, pose, points3D)]
    best, doubt = _calibrate(best, points2D, points3D, config)
    best = replace(best, agreement=agreement(best.inliers, images))
    refusal = _refusal(best, rivals, points2D, points3D, camera, config, gate) or doubt
    return replace(best, refusal=refusal)


def _quality(pose: Pose) -> tuple[float, int]:
    return pose.confidence, pose.num_inliers


def _estimate(
    points2D: np.ndarray,
    points3D: np.ndarray,
    chosen: np.ndarray,
    camera: pycolmap.Camera,
    config: dict,
) -> Pose:
    """Estimate a pose from chosen matches, then from those of all that agree with it."""
    number, found = len(points2D), None
    threshold = _max_error(config)
    pose = Pose(None, camera, np.zeros(number, bool))
    for _ in range(1 if len(chosen) == number else ROUNDS):
        refined = copy.deepcopy(pose.camera)
        found = colmap.estimate_pose(points2D[chosen], points3D[chosen], refined, config, SEED)
        if not found:
            break
        cam_from_world = found["cam_from_world"]
        if len(chosen) == number:
            inliers = np.asarray(found["inlier_mask"], bool)
        else:
            errors, _ = reprojection_errors(points2D, points3D, cam_from_world, refined)
            inliers = errors <= threshold
        if inliers.sum() <= pose.num_inliers:
            break
        pose, chosen = Pose(cam_from_world, refined, inliers), np.flatnonzero(inliers)
    if pose.cam_from_world is None:
        return pose
    arguments = points2D, points3D, pose.cam_from_world, pose.camera
    freedom = 6 + _is_focal_length_free(config)
    value = confidence(*arguments, threshold, freedom)
    return replace(pose, confidence=value, degrees_of_freedom=freedom)


def _calibrate(
    pose: Pose, points2D: np.ndarray, points3D: np.ndarray, config: dict
) -> tuple[Pose, str | None]:
    """Look whether other intrinsics than those of a pose fit the matches better.

    Where the focal length is not known, a distortion is estimated, too, and if that fits much
    better aspect ratio and principal point: the photo was cropped or stretched. Where it is known,
    such a fit contradicts it. A skew, which no lens has, tells a photo that shows a picture.

    Returns:
        The pose that is likelier, and a reason not to trust it, if any.
    """
    if pose.num_inliers < resection.ALL or pose.camera.mean_focal_length() <= 0:
        return pose, None
    threshold = _max_error(config)
    image, pinhole = resection.undistort(points2D, pose.camera)
    matches, start = (image, points3D), (pose.cam_from_world, pinhole, threshold)

    def judged(found: resection.Resection | None, freedom: int) -> Pose:
        if found is None:
            return replace(pose, camera=pinhole)
        cam_from_world, lens, inliers, points = found
        value = confidence(points, points3D, cam_from_world, lens, threshold, freedom)
        return Pose(cam_from_world, lens, inliers, value, degrees_of_freedom=freedom)

    free = _is_focal_length_free(config) and not resection.is_distorted(pose.camera)
    assumed = pose
    if free:
        radial = judged(resection.resect(*matches, *start, resection.RADIAL), resection.RADIAL)
        if radial.confidence > DISTORTED * pose.confidence:
            assumed = radial
    other = judged(resection.resect_anew(*matches, *start), resection.ALL)
    near = other.cam_from_world, other.camera, threshold
    skewed = judged(resection.resect(*matches, *near, resection.SKEW), resection.SKEW)
    likelier = max(assumed, other, key=_quality)
    if skewed.confidence > RIGHT * likelier.confidence and differ(
        skewed, likelier, points3D, MAX_POSITION, MAX_ROTATION
    ):
        reason = "it was warped, or is a photo of a picture: a skew fits much better"
        return likelier if free else assumed, reason
    if other.confidence <= (UNCLEAR if free else RIGHT) * assumed.confidence:
        return assumed, None
    if free and other.confidence > RIGHT * assumed.confidence:
        return other, None
    limit = 1 if free else LENIENT
    if not differ(assumed, other, points3D, limit * MAX_POSITION, limit * MAX_ROTATION):
        return assumed, None
    if free:
        return assumed, (
            "it may be cropped or stretched: another principal point and aspect ratio fit about as "
            "well, and the pose differs"
        )
    reason = "its intrinsics contradict the map: others fit much better, and the pose differs"
    return assumed, reason


def _max_error(config: dict) -> float:
    """Return RANSAC's inlier threshold in pixels."""
    return config.get("estimation", {}).get("ransac", {}).get("max_error", MAX_ERROR)


def _is_focal_length_free(config: dict) -> bool:
    return bool(
        config.get("estimation", {}).get("estimate_focal_length")
        or config.get("refinement", {}).get("refine_focal_length")
    )


def _is_off_centre(camera: pycolmap.Camera) -> bool:
    """Tell whether listed intrinsics are those of a crop, or wrong."""
    point = np.array([camera.principal_point_x, camera.principal_point_y])
    return bool((np.abs(point / [camera.width, camera.height] - 0.5) > OFF_CENTRE).any())


def _refusal(
    pose: Pose,
    rivals: list[Pose],
    points2D: np.ndarray,
    points3D: np.ndarray,
    camera: pycolmap.Camera,
    config: dict,
    gate: Gate,
) -> str | None:
    """Say why a pose is not to be trusted, if it is not."""
    number = pose.num_inliers
    if number < gate.min_inliers:
        return f"too few inliers: {number}, at least {gate.min_inliers} are needed"
    if pose.confidence < gate.min_confidence:
        return (
            f"{number} inliers of {len(points2D)} matches may be chance: confidence "
            f"{max(0, pose.confidence):.1f}, at least {gate.min_confidence:g} is needed"
        )
    focal_length = pose.camera.mean_focal_length()
    guessed = bool(config.get("estimation", {}).get("estimate_focal_length"))
    low, high = focal_lengths(camera, guessed)
    if _is_focal_length_free(config) and not low <= focal_length <= high:
        return (
            f"no plausible focal length: {focal_length:.0f} pixels, {low:.0f} to {high:.0f} were "
            "expected"
        )
    chosen = points2D[pose.inliers], points3D[pose.inliers]
    freedom = pose.degrees_of_freedom
    position, rotation = uncertainty(*chosen, pose.cam_from_world, pose.camera, freedom)
    if position > MAX_POSITION or rotation > MAX_ROTATION:
        return (
            f"the inliers do not fix the pose: its position is uncertain by {100 * position:.0f} % "
            f"of their distance, its rotation by {rotation:.1f} degrees"
        )
    is_cropped = config.get("photo", {}).get("cropped")  # perhaps
    if is_cropped or _is_off_centre(camera):
        position, rotation = uncertainty(*chosen, pose.cam_from_world, pose.camera, resection.ALL)
        if position > CROPPED * MAX_POSITION or rotation > CROPPED * MAX_ROTATION:
            why = (
                "it may be cropped"
                if is_cropped
                else "its principal point is far from the centre of the photo"
            )
            return (
                f"{why}, and without its intrinsics its position is uncertain by "
                f"{100 * position:.0f} % of the distance, its rotation by {rotation:.1f} degrees"
            )
    least = gate.least_agreement(pose.confidence)
    if pose.agreement < least:
        return (
            "the matches of no image agree with the pose: agreement "
            f"{pose.agreement:.2f}, at least {least:g} is needed"
        )
    for rival in rivals:
        if rival.num_inliers >= RIVAL * number and differ(pose, rival, points3D):
            return f"ambiguous: another pose has {rival.num_inliers} inliers, this one {number}"
    return None


def differ(
    pose: Pose,
    other: Pose,
    points3D: np.ndarray,
    position: float = SAME_POSITION,
    rotation: float = SAME_ROTATION,
) -> bool:
    """Tell whether two poses differ by more than a position or a rotation.

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
