"""The pose of a query from 2D-3D matches: RANSAC, other intrinsics, and whether to trust it."""

import copy
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pycolmap

from ..utils import colmap
from . import gate as gates
from .gate import ALTERNATIVES, Gate
from .hypotheses import Alternatives, alternative, rival, with_other_intrinsics
from .measures import (
    FINEST,
    MIN_MATCHES,
    UNDETERMINED,
    Measures,
    Seen,
    Uncertainty,
    agreement,
    all_but_most_telling,
    confidence,
    uncertainty,
    uncertainty_without_one,
)
from .pose import Matches, Pose, apart, quality
from .projection import ALL, FOCAL, POSE, photo_scale, reprojection_errors

SEED = 0
SAMPLE = 500  # matches, at most, from which a pose is tried before all, or a rival is estimated
# confidence of a pose at which no other matches are tried, one and a half times the highest of
# photos of other places in results/trials
CERTAIN = 85.0
STRICT = 1 / 2  # of an inlier threshold, the next one with which a pose is estimated again
LEAST_SCALE = 0.1  # pixels, the least error from which on a match counts less
LEAST_RATIO = 0.1  # of inliers, pycolmap's default
CLEAR = 0.25  # inlier ratio above which the matches of single images are not tried
MOST_SIMILAR = 100  # matches of an image that are tried by themselves
REESTIMATIONS = 3  # from the matches near the pose
WIDER = 5  # inlier thresholds, within which matches are near a pose
# a rival is looked for that has at least this share of the inliers of one that would count, as its
# confidence may be higher than inliers alone tell
RIVAL_SHARE = 0.75
# The lens of the map's photos has probably taken a photo if the confidence with it is at least this
# multiple of that with estimated intrinsics, and its focal length is within this many standard
# deviations of the estimated one or within this share of it, or the inliers fit better.
CONFIDENCE_RATIO, FOCAL_DEVIATIONS, FOCAL_SHARE = 0.98, 2.0, 0.025


def estimate(
    points2D: np.ndarray,
    points3D: np.ndarray,
    images: list[np.ndarray],
    camera: pycolmap.Camera,
    config: dict,
    gate: Gate,
    thorough: bool = True,
    workers: int = 1,
    likely: np.ndarray | None = None,
) -> Pose:
    """Estimate an absolute pose and judge it.

    First from the likeliest matches, of which more are right, so that RANSAC needs fewer trials; if
    the pose is not certain, also from all. If few of these agree with a pose, RANSAC may have
    missed the right one. So the most similar matches of each image are tried by themselves, too:
    those of an image that shows the same place agree much more often. The pose with the highest
    confidence among all matches wins, and is estimated with stricter thresholds, too.
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
        likely: (M,) bool, the matches that agree with a guess of the pose: it is estimated from
            these, and refined by all that agree with it. Default: it is found anew.
    """
    near_from_world = colmap.near_from_world(points3D)
    matches = Matches(points2D, colmap.transformed(near_from_world, points3D), camera, config)
    with ThreadPoolExecutor(workers) as pool:
        if likely is None:
            poses = _found_anew(matches, images, thorough, pool)
            first = _unbent(matches, max(poses, key=quality))
        else:
            poses = [first := _near(matches, images, likely)]
        first = _agreed(matches, first)
        outliers = pool.submit(_of_outliers, matches, first) if workers > 1 else None
        best, others = with_other_intrinsics(matches, first)
        poses += outliers.result() if outliers and best is first else _of_outliers(matches, best)
    if best.cam_from_world is not None:
        others |= rival(best, poses, matches.points3D)
    best = replace(best, measures=_measures(matches, best, images, others))
    best = _with_typical_lens(matches, best)
    best = replace(best, refusal=gates.refusal(best.measures, gate))
    if best.cam_from_world is None:
        return best
    world_from_near = near_from_world.inverse()
    return replace(best, cam_from_world=world_from_near.transform_camera_world(best.cam_from_world))


def _found_anew(
    matches: Matches, images: list[np.ndarray], thorough: bool, pool: ThreadPoolExecutor
) -> list[Pose]:
    """Return poses by RANSAC, see `estimate`."""
    number = len(matches)
    poses = [_estimate(matches, likeliest(images, number))]
    is_certain = poses[0].confidence >= CERTAIN
    if number > SAMPLE and not is_certain:
        poses.insert(0, _estimate(matches, np.arange(number)))
    if thorough and not is_certain and poses[0].num_inliers < CLEAR * number:
        tried = [chosen for chosen in images if MIN_MATCHES <= len(chosen) < number]
        poses += pool.map(lambda chosen: _estimate(matches, chosen[:MOST_SIMILAR]), tried)
    return poses


def _near(matches: Matches, images: list[np.ndarray], likely: np.ndarray) -> Pose:
    """Estimate a pose from matches (M,) bool that are likely, then refine it by all that agree.

    As in `_unbent`, a refinement by matches that agree better may be likelier.
    """
    which = [chosen[likely[chosen]] for chosen in images]
    sample = likeliest(which, len(matches), min(SAMPLE, int(likely.sum())))
    pose = _found(matches, sample, LEAST_RATIO, 0, rounds=1)
    for share in (1.0, STRICT):
        pose = max(pose, _refined(matches, pose, share * matches.max_error), key=quality)
    return pose


def _refined(matches: Matches, pose: Pose, max_error: float) -> Pose:
    """Refine a pose by the matches that agree within a number of pixels."""
    if pose.cam_from_world is None:
        return pose
    view = pose.cam_from_world, pose.camera
    errors, _ = reprojection_errors(matches.points2D, matches.points3D, *view)
    found = _refined_by(matches, pose, errors <= max_error)
    return pose if found is None else _judged(matches, found)


def _refined_by(matches: Matches, pose: Pose, agree: np.ndarray) -> Pose | None:
    """Refine a pose by some matches (M,) bool, without its confidence; None if that fails."""
    assert pose.cam_from_world is not None
    camera, points = copy.deepcopy(pose.camera), (matches.points2D, matches.points3D)
    errors, _ = reprojection_errors(*points, pose.cam_from_world, camera)
    refinement = loss_options(errors[agree]) | matches.config.get("refinement", {})
    found = colmap.refine_pose(pose.cam_from_world, *points, agree, camera, refinement)
    if found is None:
        return None
    errors, _ = reprojection_errors(*points, found, camera)
    return Pose(found, camera, errors <= matches.max_error)


def loss_options(errors: np.ndarray) -> dict[str, float]:
    """Return options of a refinement in which a match counts the less, the larger its error is.

    With pycolmap's own scale of one pixel, small errors are squared, and those of the night are all
    taken for large.

    Args:
        errors: (N,) of the matches that agree, in pixels; their median is the scale.
    """
    scale = float(np.median(errors)) if len(errors) else LEAST_SCALE
    return {"loss_function_scale": max(LEAST_SCALE, scale)}


def likeliest(images: list[np.ndarray], number: int, most: int = SAMPLE) -> np.ndarray:
    """Return the indices, ascending, of the first of `ranked` matches.

    Args:
        images: of each map image the indices of its matches, the most similar first.
        number: of all matches.
        most: how many are returned, at most.
    """
    return np.sort(ranked(images, number)[:most])


def ranked(images: list[np.ndarray], number: int) -> np.ndarray:
    """Return the indices of a number of matches, those first that are right most often.

    These are matches of several images, and then the most similar ones of each image.

    Args:
        images: of each map image the indices of its matches, the most similar first.
        number: of all matches.
    """
    times, rank = np.zeros(number, np.int64), np.full(number, number)
    for chosen in images:
        times[chosen] += 1
        rank[chosen] = np.minimum(rank[chosen], np.arange(len(chosen)))
    return np.lexsort((rank, -times))


def _measures(
    matches: Matches, pose: Pose, images: list[np.ndarray], others: Alternatives
) -> Measures:
    """Measure a pose."""
    camera = matches.camera
    center = camera.principal_point_x, camera.principal_point_y
    measures = Measures(
        num_matches=len(matches),
        num_inliers=pose.num_inliers,
        confidence=pose.confidence,
        agreement=agreement(pose.inliers, images),
        degrees_of_freedom=pose.degrees_of_freedom,
        may_be_cropped=matches.may_be_cropped(pose),
        longer_side=max(camera.width, camera.height),
        is_camera_given=matches.is_camera_given,
        is_focal_length_free=matches.is_focal_length_free,
        focal_length=pose.camera.mean_focal_length(),
        given_focal_length=camera.mean_focal_length(),
        focal_range=gates.focal_lengths(camera, matches.is_focal_length_guessed),
        off_centre=_off_centre(camera, *center),
        off_centre_swapped=_off_centre(camera, *center[::-1]),
        alternatives=others,
    )
    if pose.cam_from_world is None:
        return measures
    view = pose.cam_from_world, pose.camera
    uncropped = uncertainty(*matches.inliers(pose), *view, ALL)
    return replace(measures, uncertainty=_precision_of(matches, pose), uncropped=uncropped)


def _off_centre(camera: pycolmap.Camera, x: float, y: float) -> float:
    """Return how far a point is from the centre, as a share of the size."""
    return float(np.abs(np.array([x / camera.width, y / camera.height]) - 0.5).max())


def _with_typical_lens(matches: Matches, pose: Pose) -> Pose:
    """Estimate a measured pose anew with the lens of the map's photos, if that fits.

    All photos of a map determine their lens better than the matches of one more photo do. But that
    this lens has taken the photo is likely, not certain: the new pose counts as no more precise
    than the old one.

    Returns:
        The new pose, or the old one if the lens is not known or does not fit. If all intrinsics
        were estimated, the pose with this lens is an alternative.
    """
    known = matches.with_typical_lens()
    if known is None or pose.cam_from_world is None or pose.measures.may_be_cropped:
        return pose
    typical = _agreed(known, _unbent(known, _estimate(known, np.flatnonzero(pose.inliers))))
    if typical.cam_from_world is None:
        return pose
    if pose.degrees_of_freedom == ALL:
        others = {"typical_lens": alternative(pose, typical, matches.points3D)}
        others = {**pose.measures.alternatives, **others}
        return replace(pose, measures=replace(pose.measures, alternatives=others))
    if typical.confidence < CONFIDENCE_RATIO * pose.confidence:
        return pose
    inliers, view = matches.inliers(pose), (pose.cam_from_world, pose.camera)
    ratio = pose.camera.mean_focal_length() / known.camera.mean_focal_length()
    deviation = pose.measures.uncertainty.focal_length
    errors, _ = reprojection_errors(*inliers, *view)
    its_errors, _ = reprojection_errors(*inliers, typical.cam_from_world, typical.camera)
    # an estimated focal length may be off by more if it makes up for a distortion, or for points
    # whose errors are alike
    is_better = (its_errors**2).sum() <= (errors**2).sum()
    if not (is_better or abs(np.log(ratio)) <= max(FOCAL_DEVIATIONS * deviation, FOCAL_SHARE)):
        return pose
    precision = pose.measures.uncertainty.at_least(*_precision_of(known, typical)[:2])
    measures = replace(pose.measures, uncertainty=precision)
    number, value = typical.num_inliers, typical.confidence
    return replace(typical, measures=replace(measures, num_inliers=number, confidence=value))


def _of_outliers(matches: Matches, pose: Pose) -> list[Pose]:
    """Return the pose that the outliers of a pose give, none if they are few or few agree."""
    others = np.flatnonzero(~pose.inliers)
    least = ALTERNATIVES["rival"].ratio * pose.num_inliers
    if not len(others) >= least > 0:
        return []
    sample = np.random.default_rng(SEED).permutation(others)[:SAMPLE]
    least_ratio = max(LEAST_RATIO, RIVAL_SHARE * least / len(others))
    return [_estimate(matches, sample, least_ratio, RIVAL_SHARE * least)]


def _estimate(
    matches: Matches, chosen: np.ndarray, least_ratio: float = LEAST_RATIO, least: float = 0
) -> Pose:
    """Estimate a pose from chosen matches, then from all matches that are near it, and judge it.

    Args:
        matches: of the query.
        chosen: (N,) indices of some of them.
        least_ratio: share of inliers below which RANSAC need not find a pose among these.
        least: number of inliers below which a pose counts as none.
    """
    return _judged(matches, _found(matches, chosen, least_ratio, least))


def _found(
    matches: Matches,
    chosen: np.ndarray,
    least_ratio: float,
    least: float,
    rounds: int = REESTIMATIONS,
) -> Pose:
    """Return the pose of `_estimate` without its confidence, after some rounds at most."""
    points2D, points3D, number = matches.points2D, matches.points3D, len(matches)
    ransac = {"min_inlier_ratio": least_ratio}
    pose = none = Pose(None, matches.camera, np.zeros(number, bool))
    for _ in range(1 if len(chosen) == number else rounds):
        camera = copy.deepcopy(pose.camera)
        chosen_points = points2D[chosen], points3D[chosen]
        found = colmap.estimate_pose(*chosen_points, camera, matches.config, ransac)
        if not found:
            break
        cam_from_world = found["cam_from_world"]
        errors, _ = reprojection_errors(points2D, points3D, cam_from_world, camera)
        inliers = errors <= matches.max_error
        if len(chosen) == number:
            inliers = np.asarray(found["inlier_mask"], bool)
        if inliers.sum() <= pose.num_inliers:
            break
        pose = Pose(cam_from_world, camera, inliers)
        chosen = np.flatnonzero(errors <= WIDER * matches.max_error)
    return pose if pose.num_inliers >= least else none


def _judged(matches: Matches, pose: Pose) -> Pose:
    """Return an estimated pose with its confidence."""
    if pose.cam_from_world is None:
        return pose
    freedom = FOCAL if matches.is_focal_length_free else POSE
    view = pose.cam_from_world, pose.camera
    value = confidence(matches.points2D, matches.points3D, *view, matches.max_error, freedom)
    return replace(pose, confidence=value, degrees_of_freedom=freedom)


def _unbent(matches: Matches, pose: Pose) -> Pose:
    """Refine a pose, estimated with stricter thresholds first: if it is certain, with the last one.

    Wrong matches may have bent it until they agree, above all one of few. What a threshold finds
    that few matches meet is refined by all that meet the first. The likeliest pose is returned.
    """
    poses, first = [pose], STRICT * matches.max_error
    thresholds, max_error = list[float](), first
    while max_error >= FINEST * photo_scale(pose.camera):
        thresholds.append(max_error)
        max_error *= STRICT
    is_certain = pose.confidence >= CERTAIN
    for max_error in thresholds[-1:] if is_certain else thresholds:
        strict = matches.with_max_error(max_error)
        rounds = 1 if is_certain else REESTIMATIONS
        found = _found(strict, np.flatnonzero(pose.inliers), LEAST_RATIO, 0, rounds)
        poses.append(_refined(matches, found, first))
    best = max(poses, key=quality)
    refined = _refined(matches, best, matches.max_error)
    # intrinsics that few matches determine may leave them all behind
    return refined if 2 * refined.num_inliers > best.num_inliers else best


def _agreed(matches: Matches, pose: Pose) -> Pose:
    """Leave out the matches that tell most about a pose, as long as they contradict all others.

    One wrong match far from the others may bend a pose until it fits, too, and the others hardly
    worse: but refined by them alone, the pose is another one.
    """
    before: Pose | None = None
    for _ in range(REESTIMATIONS):
        if (kept := _all_but_most_telling(matches, pose)) is None:
            return pose
        if (others := _refined_by(matches, pose, kept)) is None:
            break
        assert others.cam_from_world is not None
        agree = others.inliers & pose.inliers
        given = matches.points2D[agree], matches.points3D[agree]
        view = others.cam_from_world, others.camera
        expected = uncertainty(*given, *view, pose.degrees_of_freedom)
        is_near = expected.allows(*apart(pose, others, matches.points3D))
        # nothing is left out if few of the others agree among themselves
        if is_near or not 2 * others.num_inliers > pose.num_inliers:
            return replace(pose, precision=_precision(matches, pose, kept, others))
        before, pose = pose, _judged(matches, others)
    kept = _all_but_most_telling(matches, pose)
    return replace(pose, precision=_precision(matches, pose, kept, before))


def _all_but_most_telling(matches: Matches, pose: Pose) -> np.ndarray | None:
    """Return the inliers (M,) bool of a pose without those that tell most about it.

    Returns:
        None without a pose, or if its inliers do not determine it.
    """
    if pose.cam_from_world is None:
        return None
    inliers = all_but_most_telling(_seen(matches, pose), pose.degrees_of_freedom)
    if inliers is None:
        return None
    kept = pose.inliers.copy()
    kept[kept] = inliers
    return kept


def _precision(
    matches: Matches, pose: Pose, kept: np.ndarray | None, other: Pose | None = None
) -> Uncertainty:
    """Return how precisely the inliers of a pose fix it, even without those that tell most.

    If the focal length is known, the pose is at least as uncertain as it is apart from another one:
    an estimated focal length makes up for motions along the optical axis.

    Args:
        matches: of the query.
        pose: the pose.
        kept: `_all_but_most_telling`.
        other: the pose by these, or before others were left out; None if there is none.
    """
    if kept is None:
        return UNDETERMINED
    seen, freedom = _seen(matches, pose), pose.degrees_of_freedom
    found = uncertainty_without_one(seen, freedom, kept[pose.inliers])
    if freedom > POSE or other is None:
        return found
    return found.at_least(*apart(pose, other, matches.points3D))


def _precision_of(matches: Matches, pose: Pose) -> Uncertainty:
    """Return the `_precision` of a pose, which may be known."""
    if pose.precision is not None:
        return pose.precision
    return _precision(matches, pose, _all_but_most_telling(matches, pose))


def _seen(matches: Matches, pose: Pose) -> Seen:
    """Return the inliers of a pose as what it is judged by."""
    assert pose.cam_from_world is not None
    return Seen(*matches.inliers(pose), pose.cam_from_world, pose.camera, matches.max_error)
