"""The pose of a query from 2D-3D matches: RANSAC, other intrinsics, and whether to trust it."""

import copy
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pycolmap

from ..utils import colmap
from .calibration import STRETCHED, UNCLEAR_CROPPED, calibrate
from .confidence import (
    MAX_POSITION,
    MAX_ROTATION,
    MIN_MATCHES,
    RIVAL,
    Gate,
    agreement,
    confidence,
    uncertainty,
)
from .pose import Matches, Pose, differ, quality
from .projection import ALL, FOCAL, POSE, reprojection_errors
from .refusals import refusal

SEED = 0
LEAST_RATIO = 0.1  # of inliers, pycolmap's default
CLEAR = 0.25  # inlier ratio above which the matches of single images are not tried
MOST_SIMILAR = 100  # matches of an image that are tried by themselves
ROUNDS = 3  # of estimation from the inliers among all matches
RIVAL_SAMPLE = 500  # matches, at most, from which a rival is estimated
# The lens of the map's photos has probably taken a photo if the confidence with it is at least this
# multiple of that with estimated intrinsics, and its focal length is within this many standard
# deviations of the estimated one or within this share of it, or the inliers fit better.
CONFIDENCE_RATIO, DEVIATIONS, SHARE = 0.98, 2.0, 0.025


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
    If it is trusted although its intrinsics were guessed, and the lens of the map's photos fits as
    well, it is estimated with that. If its photo seems to be cropped or stretched, and that lens
    fits about as well with another pose, it is not trusted. All poses are estimated and compared
    in a frame near the points.

    Args:
        points2D: (M, 2) image points of all matches, COLMAP's pixels.
        points3D: (M, 3) their world points.
        images: of each map image the indices of its matches, the most similar first.
        camera: intrinsics.
        config: hloc's dict of options of pycolmap, under "estimation" and "refinement"; under
            "photo", whether it may be "cropped", or the map's "focal_lengths" and "typical" lens,
            see `intrinsics.refinement`.
        gate: what a pose must have to be trusted.
        thorough: try the matches of single images, too.
        workers: threads that estimate poses; the result does not depend on their number.
    """
    near_from_world = colmap.near_from_world(points3D)
    matches = Matches(points2D, colmap.transformed(near_from_world, points3D), camera, config)
    number = len(matches)
    with ThreadPoolExecutor(workers) as pool:
        poses = [_estimate(matches, np.arange(number))]
        if thorough and poses[0].num_inliers < CLEAR * number:
            tried = [chosen for chosen in images if MIN_MATCHES <= len(chosen) < number]
            poses += pool.map(lambda chosen: _estimate(matches, chosen[:MOST_SIMILAR]), tried)
        first = max(poses, key=quality)
        rivals = pool.submit(_rivals, matches, first) if workers > 1 else None
        best, doubt = calibrate(matches, first)
        poses += rivals.result() if rivals and best is first else _rivals(matches, best)
    best = replace(best, agreement=agreement(best.inliers, images))
    best = replace(best, refusal=refusal(matches, best, poses, gate, doubt))
    best = _with_typical_lens(matches, best, images, poses, gate) or best
    if best.cam_from_world is None:
        return best
    world_from_near = near_from_world.inverse()
    return replace(best, cam_from_world=world_from_near.transform_camera_world(best.cam_from_world))


def _with_typical_lens(
    matches: Matches, pose: Pose, images: list[np.ndarray], others: list[Pose], gate: Gate
) -> Pose | None:
    """Estimate a trusted pose anew with the lens of the map's photos.

    All photos of a map determine their lens better than the matches of one more photo do.

    Returns:
        The new pose, or the old one with a refusal. None if the lens is not known, may not have
        taken the photo, or gives no trusted pose.
    """
    known = matches.with_typical_lens()
    if known is None or pose.cam_from_world is None or pose.refusal is not None:
        return None
    if matches.may_be_cropped(pose):
        return None
    inliers = matches.inliers(pose)
    view = pose.cam_from_world, pose.camera
    typical = _estimate(known, np.flatnonzero(pose.inliers))
    if pose.degrees_of_freedom == ALL:
        fits = typical.confidence >= UNCLEAR_CROPPED * pose.confidence
        differs = differ(pose, typical, matches.points3D, MAX_POSITION, MAX_ROTATION)
        return replace(pose, refusal=STRETCHED) if fits and differs else None
    if typical.cam_from_world is None or typical.confidence < CONFIDENCE_RATIO * pose.confidence:
        return None
    ratio = pose.camera.mean_focal_length() / known.camera.mean_focal_length()
    deviation = uncertainty(*inliers, *view, pose.degrees_of_freedom).focal_length
    errors, _ = reprojection_errors(*inliers, *view)
    its_errors, _ = reprojection_errors(*inliers, typical.cam_from_world, typical.camera)
    # an estimated focal length may be off by more if it makes up for a distortion, or for points
    # whose errors are alike
    is_better = (its_errors**2).sum() <= (errors**2).sum()
    if not (is_better or abs(np.log(ratio)) <= max(DEVIATIONS * deviation, SHARE)):
        return None
    typical = replace(typical, agreement=agreement(typical.inliers, images))
    return None if refusal(known, typical, others, gate, None) else typical


def _rivals(matches: Matches, pose: Pose) -> list[Pose]:
    """Return the pose that the outliers of a pose give, none if they are few."""
    others = np.flatnonzero(~pose.inliers)
    if not len(others) >= RIVAL * pose.num_inliers > 0:
        return []
    # half as many inliers as a rival of this confidence is expected to have
    least = RIVAL / 2 * pose.num_inliers / len(others)
    sample = np.random.default_rng(SEED).permutation(others)[:RIVAL_SAMPLE]
    return [_estimate(matches, sample, max(LEAST_RATIO, least))]


def _estimate(matches: Matches, chosen: np.ndarray, least_ratio: float = LEAST_RATIO) -> Pose:
    """Estimate a pose from chosen matches, then from all matches that agree with it.

    Args:
        matches: of the query.
        chosen: (N,) indices of some of them.
        least_ratio: share of inliers below which RANSAC need not find a pose among these.
    """
    points2D, points3D, number = matches.points2D, matches.points3D, len(matches)
    ransac = {"min_inlier_ratio": least_ratio}
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
