"""Why a pose is not trusted."""

import numpy as np
import pycolmap

from .confidence import MAX_POSITION, MAX_ROTATION, Gate, focal_lengths, uncertainty
from .pose import Matches, Pose, is_rival
from .projection import ALL

# multiples of MAX_POSITION and MAX_ROTATION
PRECISE = 0.6, 1.0  # uncertainty of a pose; one error in ten is more than 1.9 times as large
ESTIMATED = 0.4, 1.0  # the same, with all intrinsics estimated
CROPPED = 3.0, 1.0  # uncertainty with unknown intrinsics, of a photo that may be cropped
LISTED = 0.1, 50.0  # range of listed focal lengths, in longer sides
# distances of the principal point from the centre, as shares of the size
OFF_CENTRE, CENTRED = 0.15, 0.02


def refusal(
    matches: Matches, pose: Pose, others: list[Pose], gate: Gate, doubt: str | None
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
    if reason := doubt or imprecision(matches, pose, pose.cam_from_world):
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


def imprecision(matches: Matches, pose: Pose, cam_from_world: pycolmap.Rigid3d) -> str | None:
    """Return how the inliers fail to determine a pose, None if they determine it."""
    inliers = matches.inliers(pose)
    precise = ESTIMATED if pose.degrees_of_freedom == ALL else PRECISE
    limits = [(pose.degrees_of_freedom, precise, "the inliers do not fix the pose: its")]
    if matches.may_be_cropped(pose):
        reason = "it may be cropped, and without its intrinsics its"
        limits.append((ALL, CROPPED, reason))
    elif _is_off_centre(matches.camera):
        reason = "its principal point is far from the centre, and without its intrinsics its"
        limits.append((ALL, CROPPED, reason))
    for freedom, (far, turned), reason in limits:
        position, rotation, _ = uncertainty(*inliers, cam_from_world, pose.camera, freedom)
        hint = "; known intrinsics would help" if matches.is_focal_length_free else ""
        if position > far * MAX_POSITION or rotation > turned * MAX_ROTATION:
            return (
                f"{reason} position is uncertain by {_up_to(100, 100 * position)} % of the "
                f"distance (at most {100 * far * MAX_POSITION:.0f} %), its rotation by "
                f"{_up_to(180, rotation)} degrees (at most {turned * MAX_ROTATION:.0f}){hint}"
            )
    return None


def _up_to(most: float, value: float) -> str:
    """Round up to tenths: what is above a limit is not to be printed as the limit."""
    return f"{np.ceil(10 * value) / 10:.1f}" if value < most else f"at least {most:.0f}"


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
