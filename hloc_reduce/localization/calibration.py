"""Whether other intrinsics than those of a pose fit the matches of a query better."""

import copy
from collections.abc import Iterable

import numpy as np

from ..utils import colmap
from . import resection
from .confidence import MAX_POSITION, MAX_ROTATION, confidence, uncertainty
from .lenses import is_bent
from .pose import Matches, Pose, differ, quality
from .projection import ALL, FOCAL, RADIAL, SKEW, reprojection_errors
from .refusals import CROPPED
from .resection import Resection, View

# ratios of the confidence with other intrinsics to the confidence with the assumed ones
DISTORTED = 1.02  # above it, the lens has a radial distortion
UNCLEAR = 1.05  # above it, the other intrinsics may be right
UNCLEAR_CROPPED = 0.8  # the same, if the photo may be cropped: their parameters cost confidence
RIGHT = 1.1  # above it, the other intrinsics are right
# multiple of MAX_POSITION and MAX_ROTATION between poses with listed and other focal lengths: many
# lists are 5 % off
TOLERANT = 1.2
# standard deviations between poses with the intrinsics of a map's own lens and with another focal
# length: photos of a flat scene hardly tell one, and errors of the map decide which fits better
POSE_DEVIATIONS = 1.5

OTHER_LENS = (
    "another lens than that of the map's photos of its size may have taken it: other parameters "
    "fit about as well, and the pose differs; known intrinsics would help"
)
STRETCHED = (
    "it may be cropped or stretched: another principal point and aspect ratio fit about as well, "
    "and the pose differs; known intrinsics would help"
)


def calibrate(matches: Matches, pose: Pose) -> tuple[Pose, str | None]:
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
    likelier = max(assumed, other or assumed, key=quality)
    fits = skewed is not None and skewed.confidence > RIGHT * likelier.confidence
    if skewed and fits and differ(skewed, likelier, points3D, MAX_POSITION, MAX_ROTATION):
        reason = "it may be warped, or a photo of a picture: a skew fits much better"
        return likelier if free else pose, reason
    if not free:
        centred = resection.centred(pose.cam_from_world, pose.camera)
        guesses = (image, start), (matches.points2D, centred)
        return pose, _contradiction(matches, pose, other, guesses)
    if other is None:
        return assumed, None
    unclear = UNCLEAR_CROPPED
    if not matches.may_be_cropped(assumed):
        # a scene that tells no principal point lets any error of the map move it
        unclear = UNCLEAR if _is_determined(matches, other) else RIGHT
    return choose(assumed, other, points3D, unclear)


def _is_determined(matches: Matches, pose: Pose) -> bool:
    """Tell whether the inliers of a pose determine it although all intrinsics are free."""
    assert pose.cam_from_world is not None
    inliers = matches.inliers(pose)
    position, rotation, _ = uncertainty(*inliers, pose.cam_from_world, pose.camera, ALL)
    return position <= CROPPED[0] * MAX_POSITION and rotation <= CROPPED[1] * MAX_ROTATION


def _resect(matches: Matches, points2D: np.ndarray, start: View, freedom: int) -> Pose | None:
    """Refine a pose and PINHOLE intrinsics from image points, and judge them."""
    found = resection.resect(points2D, matches.points3D, *start, matches.max_error, freedom)
    return _judged(matches, found, freedom)


def _judged(matches: Matches, found: Resection | None, freedom: int) -> Pose | None:
    """Return the pose of a resection, with its confidence."""
    if found is None:
        return None
    view, points2D = found[:2], found.points2D
    value = confidence(points2D, matches.points3D, *view, matches.max_error, freedom)
    return Pose(*found[:3], confidence=value, degrees_of_freedom=freedom)


def _contradiction(
    matches: Matches, pose: Pose, anew: Pose | None, guesses: Iterable[tuple[np.ndarray, View]]
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
    of_focal_length = limits
    if matches.is_lens_of_map and pose.cam_from_world is not None:
        inliers = matches.inliers(pose)
        position, rotation, _ = uncertainty(*inliers, pose.cam_from_world, pose.camera, FOCAL)
        uncertain = POSE_DEVIATIONS * position, POSE_DEVIATIONS * rotation
        of_focal_length = max(limits[0], uncertain[0]), max(limits[1], uncertain[1])
    for points2D, start in guesses:
        other = _resect(matches, points2D, start, FOCAL)
        if other is None or other.confidence <= pose.confidence:
            continue
        if differ(pose, other, matches.points3D, *of_focal_length):
            return (
                "its intrinsics contradict the map: a focal length of "
                f"{other.camera.mean_focal_length():.0f} pixels fits better, and the pose differs"
            )
    others = {
        "another principal point and aspect ratio fit": anew,
        f"other parameters of {pose.camera.model.name} fit": (refined := _refined(matches, pose)),
    }
    for what, other in others.items():
        fits = other is not None and other.confidence > RIGHT * pose.confidence
        if other and fits and differ(pose, other, matches.points3D, *limits):
            return f"its intrinsics contradict the map: {what} much better, and the pose differs"
    if refined is None or not matches.is_lens_by_size:
        return None
    fits = refined.confidence > UNCLEAR_CROPPED * pose.confidence
    return OTHER_LENS if fits and differ(pose, refined, matches.points3D, *limits) else None


def _refined(matches: Matches, pose: Pose) -> Pose | None:
    """Estimate a pose anew from its inliers, and the focal length and distortion of a bent lens.

    The others have so few parameters that `resection` estimates them.
    """
    if not is_bent(pose.camera):
        return None
    camera = copy.deepcopy(pose.camera)
    free = {"refinement": {"refine_focal_length": True, "refine_extra_params": True}}
    points = matches.inliers(pose)
    found = colmap.estimate_pose(*points, camera, matches.config | free, {})
    if not found:
        return None
    view = found["cam_from_world"], camera
    errors, _ = reprojection_errors(matches.points2D, matches.points3D, *view)
    value = confidence(matches.points2D, matches.points3D, *view, matches.max_error, FOCAL)
    return Pose(*view, errors <= matches.max_error, value, degrees_of_freedom=FOCAL)


def choose(
    assumed: Pose, other: Pose, points3D: np.ndarray, unclear: float
) -> tuple[Pose, str | None]:
    """Choose between poses with assumed and with other intrinsics, as `calibrate` returns them.

    Neither is trusted if the ratio of their confidences is above `unclear`, and they differ.
    """
    if other.confidence > RIGHT * assumed.confidence:
        return other, None
    if other.confidence <= unclear * assumed.confidence or not differ(
        assumed, other, points3D, MAX_POSITION, MAX_ROTATION
    ):
        return assumed, None
    return assumed, STRETCHED
