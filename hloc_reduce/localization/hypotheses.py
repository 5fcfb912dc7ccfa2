"""Other poses that may be right: with other intrinsics or lenses, or by other matches."""

import copy

import numpy as np

from ..utils import colmap
from . import gate, resection
from .lenses import is_bent
from .measures import INDEPENDENT_IF_BENT, Alternative, confidence, uncertainty
from .pose import Matches, Pose, apart, differ, quality
from .projection import ALL, FOCAL, RADIAL, SKEW, reprojection_errors
from .resection import Resection, View

DISTORTED = 1.02  # ratio of confidences above which the lens has a radial distortion

Alternatives = dict[str, Alternative]  # by kind, see `gate.ALTERNATIVES`


def alternative(pose: Pose, other: Pose, points3D: np.ndarray, detail: float = 0.0) -> Alternative:
    """Compare a pose with another one of the same matches, whose points (M, 3) are given."""
    ratio = other.confidence / max(1.0, pose.confidence)
    return Alternative(ratio, *apart(pose, other, points3D), detail)


def with_other_intrinsics(matches: Matches, pose: Pose) -> tuple[Pose, Alternatives]:
    """Try whether other intrinsics than those of a pose fit the matches better.

    If the focal length is unknown, they replace them: a distortion, or the aspect ratio and the
    principal point, too, of a photo that was cropped or stretched; and a skew, which no lens has,
    reveals a photo of a picture. If it is known, another one contradicts it.

    Returns:
        The likelier pose, and those with other intrinsics.
    """
    if pose.cam_from_world is None or pose.num_inliers < ALL:
        return pose, {}
    if pose.camera.mean_focal_length() <= 0:  # as RANSAC may estimate it
        return pose, {}
    image, pinhole = resection.undistort(matches.points2D, pose.camera)
    start = pose.cam_from_world, pinhole
    if not matches.is_focal_length_free or resection.is_distorted(pose.camera):
        return pose, _contradicting(matches, pose, image, start)
    points3D, assumed = matches.points3D, pose
    radial = _resect(matches, image, start, RADIAL) or pose
    if radial.confidence > DISTORTED * pose.confidence:
        assumed = radial
    found = resection.resect_anew(image, points3D, *start, matches.max_error)
    other = _judged(matches, found, ALL)
    likelier = max(assumed, other or assumed, key=quality)
    others: Alternatives = {}
    if skewed := _resect(matches, image, found[:2] if found else start, SKEW):
        others["skew"] = alternative(likelier, skewed, points3D)
        if gate.is_doubtful("skew", others["skew"]):
            return likelier, others
    if other is None:
        return assumed, others
    if other.confidence > gate.MUCH_LIKELIER * assumed.confidence:
        return other, others
    is_cropped = matches.may_be_cropped(assumed)
    # a scene that tells no principal point lets any error of the map move it
    if is_cropped or _is_determined(matches, other):
        kind = "cropped" if is_cropped else "stretched"
        others[kind] = alternative(assumed, other, points3D)
    return assumed, others


def _is_determined(matches: Matches, pose: Pose) -> bool:
    """Tell whether the inliers of a pose determine it although all intrinsics are free."""
    assert pose.cam_from_world is not None
    inliers = matches.inliers(pose)
    view = pose.cam_from_world, pose.camera
    return gate.is_determined(uncertainty(*inliers, *view, ALL, INDEPENDENT_IF_BENT))


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


def _contradicting(matches: Matches, pose: Pose, image: np.ndarray, start: View) -> Alternatives:
    """Return the poses with other intrinsics than known ones, by kind.

    Args:
        matches: of the query.
        pose: with the known intrinsics.
        image: (M, 2) image points without the distortion.
        start: the pose, and its PINHOLE intrinsics.
    """
    assert pose.cam_from_world is not None
    others: Alternatives = {}
    starts = [(image, start)]
    if not resection.is_plain(pose.camera):
        starts += [(matches.points2D, resection.centred(pose.cam_from_world, pose.camera))]
    for points2D, begin in starts:
        other = _contradiction(matches, pose, points2D, begin, FOCAL)
        if other is None or other.confidence <= pose.confidence:
            continue
        found = alternative(pose, other, matches.points3D, other.camera.mean_focal_length())
        if matches.is_lens_of_map:
            # photos of a flat scene hardly tell a focal length: errors of the map decide which fits
            view = pose.cam_from_world, pose.camera
            inliers = matches.inliers(pose)
            if gate.is_within(found, uncertainty(*inliers, *view, FOCAL, INDEPENDENT_IF_BENT)):
                continue
        if "focal_length" not in others or found.position > others["focal_length"].position:
            others["focal_length"] = found
    if other := _contradiction(matches, pose, image, start, ALL):
        others["principal_point"] = alternative(pose, other, matches.points3D)
    if matches.is_lens_by_size and (refined := _refined(matches, pose)):
        others["lens_by_size"] = alternative(pose, refined, matches.points3D)
    return others


def _contradiction(
    matches: Matches, pose: Pose, points2D: np.ndarray, start: View, freedom: int
) -> Pose | None:
    """Return what `_resect` does if it is another pose, None if it is about the same."""
    found = resection.resect(points2D, matches.points3D, *start, matches.max_error, freedom)
    if found is None or not differ(pose, Pose(*found[:3]), matches.points3D, gate.SAME_POSE):
        return None
    return _judged(matches, found, freedom)


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


def rival(pose: Pose, others: list[Pose], points3D: np.ndarray) -> Alternatives:
    """Return the likeliest pose of other matches, none if there is none that is another pose.

    Args:
        pose: the best one.
        others: from the same matches (M).
        points3D: (M, 3) their points.
    """
    found = []
    for other in others:
        shared = (other.inliers & pose.inliers).sum()
        if other.cam_from_world is not None and 2 * shared < other.num_inliers:
            one = alternative(pose, other, points3D, other.num_inliers)
            if gate.differ(one, gate.RIVALS):
                found.append(one)
    return {"rival": max(found)} if found else {}
