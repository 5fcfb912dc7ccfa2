"""The pose of a rig of cameras that are fixed to each other, from the 2D-3D matches of all."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pycolmap

from ..utils import colmap
from . import absolute_pose
from . import gate as gates
from .absolute_pose import CERTAIN
from .gate import Gate
from .measures import (
    INDEPENDENT,
    MIN_MATCHES,
    Alternative,
    Measures,
    Seen,
    Uncertainty,
    agreement,
    independent_of,
    joint_confidence,
    most_telling,
    rig_covariance,
    standard_deviations,
)
from .pose import MAX_ERROR, Pose, motion
from .projection import reprojection_errors
from .query import correspondences
from .references import Reference

# kinds of alternatives of the own pose of a camera that speak against its intrinsics
OTHER_INTRINSICS = "focal_length", "principal_point", "skew"


@dataclass(frozen=True)
class Sight:
    """What a camera of a rig sees.

    Args:
        name: of the camera, for messages.
        points2D: (M, 2) image points of all matches, COLMAP's pixels.
        points3D: (M, 3) their world points.
        images: of each map image the indices of its matches, the most similar first.
        camera: intrinsics, which are exact.
        cam_from_rig: its pose in the rig, in the units of the map.
        config: as in `absolute_pose.estimate`, with RANSAC's inlier threshold.
        gate: what a pose by this camera alone must have to be trusted.
    """

    name: str
    points2D: np.ndarray
    points3D: np.ndarray
    images: list[np.ndarray]
    camera: pycolmap.Camera
    cam_from_rig: pycolmap.Rigid3d
    config: dict
    gate: Gate

    @property
    def max_error(self) -> float:
        """The inlier threshold in pixels."""
        return self.config["estimation"]["ransac"].get("max_error", MAX_ERROR)

    def seen(self, rig_from_world: pycolmap.Rigid3d) -> Seen:
        """Return the matches with the pose of the camera that a pose of the rig gives it."""
        pose = self.cam_from_rig * rig_from_world
        return Seen(self.points2D, self.points3D, pose, self.camera, self.max_error)


def sight(
    reference: Reference,
    keypoints: np.ndarray,
    matches: Mapping[str, np.ndarray],
    config: dict,
    gate: Gate,
    name: str,
    camera: pycolmap.Camera,
    cam_from_rig: pycolmap.Rigid3d,
) -> tuple[Sight, dict]:
    """Return what a camera of a rig sees, and the first part of the info of `query.localize`.

    Args:
        reference: the map.
        keypoints: (N, 2) of the photo, COLMAP's pixels.
        matches: see `query.localize`.
        config: see `query.localize`; intrinsics are exact, so that only RANSAC's options count.
        gate: what a pose by this camera alone must have to be trusted.
        name: of the camera.
        camera: intrinsics.
        cam_from_rig: its pose in the rig.
    """
    info, images = correspondences(reference, list(matches), matches)
    points = keypoints[info["keypoints"]], info["points3D"]
    ransac = config.get("estimation", {}).get("ransac", {})
    options = {"estimation": {"ransac": ransac}}
    return Sight(name, *points, images, camera, cam_from_rig, options, gate), info


@dataclass(frozen=True)
class RigPose:
    """The pose of a rig, and how the matches of its cameras agree with it.

    Args:
        rig_from_world: the pose, None if there is none.
        inliers: of each camera (M,) bool.
        measures: those of all cameras together.
        refusal: why it is not trusted, None if it is.
        covariance: (6, 6) of a small motion of the rig in its own frame, see
            `measures.rig_covariance`; None if the inliers do not determine it.
    """

    rig_from_world: pycolmap.Rigid3d | None
    inliers: list[np.ndarray]
    measures: Measures = Measures()
    refusal: str | None = None
    covariance: np.ndarray | None = None

    @property
    def may_gain(self) -> bool:
        """Whether matches with the map images about it may make the pose certain, or another."""
        is_certain = self.refusal is None and self.measures.confidence >= CERTAIN
        return self.rig_from_world is not None and not is_certain


def estimate(sights: Sequence[Sight], gate: Gate) -> RigPose:
    """Estimate the pose of a rig and judge it by the measures of a single photo, over all cameras.

    Each camera gives a candidate by its own matches, and minimal samples of all cameras (GP3P) give
    another. Each is refined by all matches that agree with it, and the likeliest is taken. It is
    not trusted if cameras contradict it, see `_contradiction`.

    Args:
        sights: what each camera sees.
        gate: what a pose must have to be trusted.
    """
    near_from_world = colmap.near_from_world(np.concatenate([one.points3D for one in sights]))
    near = [_moved(one, near_from_world) for one in sights]
    own = [_by_itself(one) for one in near]
    starts = [
        one.cam_from_rig.inverse() * pose.cam_from_world
        for one, pose in zip(near, own, strict=True)
        if pose.cam_from_world is not None
    ]
    everything = [np.ones(len(one.points2D), bool) for one in near]
    starts += _sampled(near, everything)
    found = [_judged(near, _refined(near, start)) for start in starts]
    if not found:
        return RigPose(None, [~chosen for chosen in everything], refusal=_none(near, gate))
    best = _agreed(near, max(found, key=_quality))
    outliers = [~chosen for chosen in best.inliers]
    found += [_judged(near, _refined(near, start)) for start in _sampled(near, outliers)]
    best = _measured(near, best, found)
    refusal = _contradiction(near, own, best) or gates.refusal(best.measures, gate)
    world_from_near = near_from_world.inverse()
    assert best.rig_from_world is not None
    covariance = None
    if best.covariance is not None:  # translations are in the units of the map again
        unit = np.repeat([1.0, 1 / near_from_world.scale], 3)
        covariance = best.covariance * np.outer(unit, unit)
    return replace(
        best,
        rig_from_world=world_from_near.transform_camera_world(best.rig_from_world),
        refusal=refusal,
        covariance=covariance,
    )


def best_of(found: Sequence[RigPose], gate: Gate) -> tuple[int, RigPose]:
    """Return the index and the best of the poses on all floors, each by its own images.

    It is not trusted if another would be, too, and has nearly as many inliers.

    Args:
        found: a pose for each floor, at least one.
        gate: what a pose must have to be trusted.
    """
    number = max(range(len(found)), key=lambda i: (not found[i].refusal, *_quality(found[i])))
    best = found[number]
    others = [one.measures.num_inliers for one in found if one is not best and not one.refusal]
    if best.refusal or not others:
        return number, best
    ratio = max(others) / best.measures.num_inliers
    other = Alternative(ratio, position=np.inf, rotation=180.0, detail=max(others))
    measures = replace(
        best.measures, alternatives={**best.measures.alternatives, "other_images": other}
    )
    return number, replace(best, measures=measures, refusal=gates.refusal(measures, gate))


def _moved(one: Sight, near_from_world: pycolmap.Sim3d) -> Sight:
    """Return what a camera sees in a frame near the points, which has another unit."""
    pose = pycolmap.Rigid3d(
        one.cam_from_rig.rotation, near_from_world.scale * one.cam_from_rig.translation
    )
    points3D = colmap.transformed(near_from_world, one.points3D)
    return replace(one, points3D=points3D, cam_from_rig=pose)


def _by_itself(one: Sight) -> Pose:
    """Estimate the pose of a camera by its own matches, and judge it."""
    if len(one.points2D) < MIN_MATCHES:
        return Pose(None, one.camera, np.zeros(len(one.points2D), bool))
    given = one.points2D, one.points3D, one.images, one.camera, one.config, one.gate
    return absolute_pose.estimate(*given)


class _Cameras(NamedTuple):
    """Which camera each match is of, and the cameras, as pycolmap takes them."""

    camera_of: np.ndarray
    cams_from_rig: list[pycolmap.Rigid3d]
    cameras: list[pycolmap.Camera]


def _together(
    sights: Sequence[Sight], chosen: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, _Cameras]:
    """Return chosen matches of all cameras: image points (N, 2), world points (N, 3), cameras."""
    points2D = np.concatenate([s.points2D[c] for s, c in zip(sights, chosen, strict=True)])
    points3D = np.concatenate([s.points3D[c] for s, c in zip(sights, chosen, strict=True)])
    camera_of = np.repeat(np.arange(len(sights)), [int(c.sum()) for c in chosen])
    poses, cameras = [s.cam_from_rig for s in sights], [s.camera for s in sights]
    return points2D, points3D, _Cameras(camera_of, poses, cameras)


def _sampled(sights: Sequence[Sight], chosen: Sequence[np.ndarray]) -> list[pycolmap.Rigid3d]:
    """Return the pose that minimal samples of chosen matches of all cameras give, if any.

    Of these, the likeliest ones are sampled, of each camera as many: RANSAC's time grows with them.
    """
    most = -(-absolute_pose.SAMPLE // len(sights))
    few = []
    for one, of_one in zip(sights, chosen, strict=True):
        which = [image[of_one[image]] for image in one.images]
        few.append(np.zeros(len(of_one), bool))
        few[-1][absolute_pose.likeliest(which, len(of_one), min(most, int(of_one.sum())))] = True
    points2D, points3D, cameras = _together(sights, few)
    least = min(one.max_error for one in sights)
    found = colmap.estimate_rig_pose(points2D, points3D, *cameras, max_error=least)
    return [] if found is None else [found]


def _errors(sights: Sequence[Sight], rig_from_world: pycolmap.Rigid3d) -> list[np.ndarray]:
    """Return the reprojection errors (M,) of the matches of each camera in pixels."""
    return [reprojection_errors(*one.seen(rig_from_world)[:4])[0] for one in sights]


def _chosen(
    sights: Sequence[Sight], rig_from_world: pycolmap.Rigid3d, chosen: Sequence[np.ndarray]
) -> list[Seen]:
    """Return chosen matches (M,) bool of each camera with the pose that the rig gives it."""
    photos = [one.seen(rig_from_world) for one in sights]
    return [
        seen._replace(points2D=seen.points2D[which], points3D=seen.points3D[which])
        for seen, which in zip(photos, chosen, strict=True)
    ]


def _refined(sights: Sequence[Sight], start: pycolmap.Rigid3d) -> pycolmap.Rigid3d:
    """Refine a pose by the matches of all cameras that agree with it, as long as more do.

    It is refined once even if fewer do then: that of a sample has not the least errors.
    """
    everything = [np.ones(len(one.points2D), bool) for one in sights]
    points2D, points3D, cameras = _together(sights, everything)
    most = np.array([one.max_error for one in sights])[cameras.camera_of]
    pose, errors = start, np.concatenate(_errors(sights, start))
    for number in range(absolute_pose.REESTIMATIONS):
        mask = errors <= most
        if mask.sum() < colmap.MIN_OF_POSE:
            break
        options = absolute_pose.loss_options(errors[mask])
        refined = colmap.refine_rig_pose(pose, points2D, points3D, mask, *cameras, options)
        if refined is None:
            break
        its_errors = np.concatenate(_errors(sights, refined))
        more = (its_errors <= most).sum() - mask.sum()
        if more < 0 and number:
            break
        pose, errors = refined, its_errors
        if more == 0 and number:
            break
    return pose


def _judged(sights: Sequence[Sight], pose: pycolmap.Rigid3d) -> RigPose:
    """Return a pose with its inliers and confidence."""
    found = _with_inliers(sights, pose)
    value = joint_confidence([one.seen(pose) for one in sights])
    return replace(found, measures=replace(found.measures, confidence=value))


def _with_inliers(sights: Sequence[Sight], pose: pycolmap.Rigid3d) -> RigPose:
    """Return a pose with its inliers."""
    errors = _errors(sights, pose)
    inliers = [its <= one.max_error for its, one in zip(errors, sights, strict=True)]
    number = int(sum(map(np.sum, inliers)))
    return RigPose(pose, inliers, Measures(num_inliers=number))


def _agreed(sights: Sequence[Sight], found: RigPose) -> RigPose:
    """Leave out the place that tells most about a pose, as long as it contradicts all others.

    As `absolute_pose.estimate` does with that of a photo. The pose that is returned has its
    uncertainty, unless the inliers do not determine it.
    """
    before: RigPose | None = None
    for _ in range(absolute_pose.REESTIMATIONS):
        if (kept := _all_but_most_telling(sights, found)) is None:
            return found
        if (others := _refined_by(sights, found, kept)) is None:
            break
        agree = [a & b for a, b in zip(others.inliers, found.inliers, strict=True)]
        expected = _uncertainty(sights, others, agree, INDEPENDENT)
        is_near = expected.allows(*_apart(sights, found, others))
        if is_near or not 2 * others.measures.num_inliers > found.measures.num_inliers:
            return _with_uncertainty(sights, found, kept, others)
        assert others.rig_from_world is not None
        before, found = found, _judged(sights, others.rig_from_world)
    kept = _all_but_most_telling(sights, found)
    return found if kept is None else _with_uncertainty(sights, found, kept, before)


def _all_but_most_telling(sights: Sequence[Sight], found: RigPose) -> list[np.ndarray] | None:
    """Return of each camera the inliers (M,) bool without those that tell most about a pose.

    Returns:
        None if the inliers do not determine it.
    """
    assert found.rig_from_world is not None
    cams_from_rig = [one.cam_from_rig for one in sights]
    agreeing = _chosen(sights, found.rig_from_world, found.inliers)
    if rig_covariance(agreeing, cams_from_rig) is None:
        return None
    camera, telling = most_telling(agreeing, cams_from_rig)
    kept = [inliers.copy() for inliers in found.inliers]
    kept[camera][found.inliers[camera]] = ~telling
    return kept


def _refined_by(
    sights: Sequence[Sight], found: RigPose, chosen: Sequence[np.ndarray]
) -> RigPose | None:
    """Refine a pose by chosen matches (M,) bool of each camera, without judging it.

    Returns:
        None if that fails.
    """
    assert found.rig_from_world is not None
    everything = [np.ones(len(one.points2D), bool) for one in sights]
    points2D, points3D, cameras = _together(sights, everything)
    mask = np.concatenate(chosen)
    if mask.sum() < colmap.MIN_OF_POSE:
        return None
    errors = np.concatenate(_errors(sights, found.rig_from_world))
    options = absolute_pose.loss_options(errors[mask])
    start = found.rig_from_world
    refined = colmap.refine_rig_pose(start, points2D, points3D, mask, *cameras, options)
    return None if refined is None else _with_inliers(sights, refined)


def _apart(sights: Sequence[Sight], found: RigPose, other: RigPose) -> tuple[float, float]:
    """Return how far apart two poses are, as `pose.apart` does for those of a photo."""
    assert found.rig_from_world is not None and other.rig_from_world is not None
    moved, degrees = motion(found.rig_from_world, other.rig_from_world)
    return moved / _median_depth(_chosen(sights, found.rig_from_world, found.inliers)), degrees


def _uncertainty(
    sights: Sequence[Sight],
    found: RigPose,
    chosen: Sequence[np.ndarray],
    independent: float | None = None,
) -> Uncertainty:
    """Return how precisely chosen matches (M,) bool of each camera fix a pose.

    Args:
        sights: what each camera sees.
        found: the pose.
        chosen: the matches.
        independent: more of them do not make the pose more precise; default: `independent_of` them.
    """
    assert found.rig_from_world is not None
    photos = _chosen(sights, found.rig_from_world, chosen)
    covariance = rig_covariance(photos, [one.cam_from_rig for one in sights])
    number = sum(len(seen.points2D) for seen in photos)
    most = independent_of(photos) if independent is None else independent
    return standard_deviations(covariance, _median_depth(photos), number, most)


def _with_uncertainty(
    sights: Sequence[Sight], found: RigPose, kept: list[np.ndarray], other: RigPose | None
) -> RigPose:
    """Return a pose with its uncertainty, at least as large as it is apart from another one.

    Args:
        sights: what each camera sees.
        found: the pose.
        kept: of each camera the inliers (M,) bool, `_all_but_most_telling`.
        other: the pose by these, or before others were left out; None if there is none.
    """
    value = _uncertainty(sights, found, kept)
    if other is not None:
        value = value.at_least(*_apart(sights, found, other))
    return replace(found, measures=replace(found.measures, uncertainty=value))


def _quality(found: RigPose) -> tuple[float, int]:
    return found.measures.confidence, found.measures.num_inliers


def _measured(sights: Sequence[Sight], best: RigPose, found: list[RigPose]) -> RigPose:
    """Return the best pose with all that is measured of it.

    Args:
        sights: what each camera sees.
        best: the pose.
        found: all poses, of which some may be the same.
    """
    assert best.rig_from_world is not None
    agreeing = _chosen(sights, best.rig_from_world, best.inliers)
    covariance = rig_covariance(agreeing, [one.cam_from_rig for one in sights])
    depth = _median_depth(agreeing)
    start, images = 0, []
    for one in sights:
        images += [start + chosen for chosen in one.images]
        start += len(one.points2D)
    others = [one for one in found if _shares_few(best, one)]
    rivals = [rival for one in others if (rival := _rival(best, one, depth))]
    measures = replace(
        best.measures,
        num_matches=start,
        agreement=agreement(np.concatenate(best.inliers), images),
        is_camera_given=True,
        focal_range=(0.0, np.inf),
        alternatives={"rival": max(rivals)} if rivals else {},
        **_intrinsics(sights),
    )
    return replace(best, measures=measures, covariance=covariance)


def _intrinsics(sights: Sequence[Sight]) -> dict:
    """Return what the gate needs of the intrinsics: those whose focal length is least plausible."""

    def oddness(camera: pycolmap.Camera) -> float:
        return abs(np.log(max(1e-9, camera.mean_focal_length()) / max(camera.width, camera.height)))

    camera = max((one.camera for one in sights), key=oddness)
    length = camera.mean_focal_length()
    side = max(camera.width, camera.height)
    return {"longer_side": side, "focal_length": length, "given_focal_length": length}


def _median_depth(photos: Sequence[Seen]) -> float:
    depths = [
        seen.points3D @ seen.cam_from_world.rotation.matrix()[2]
        + seen.cam_from_world.translation[2]
        for seen in photos
    ]
    together = np.concatenate(depths)
    return float(np.median(together)) if len(together) else 1.0


def _rival(best: RigPose, other: RigPose, depth: float) -> Alternative | None:
    """Compare another pose with the best one; None if both are about the same."""
    assert best.rig_from_world is not None and other.rig_from_world is not None
    position, rotation = motion(best.rig_from_world, other.rig_from_world)
    ratio = other.measures.confidence / max(1.0, best.measures.confidence)
    found = Alternative(ratio, position / depth, rotation, other.measures.num_inliers)
    return found if gates.differ(found, gates.RIVALS) else None


def _shares_few(best: RigPose, other: RigPose) -> bool:
    """Tell whether less than half of the inliers of another pose are those of the best one."""
    shared = sum((a & b).sum() for a, b in zip(best.inliers, other.inliers, strict=True))
    return 2 * shared < other.measures.num_inliers


def _contradiction(sights: Sequence[Sight], own: Sequence[Pose], best: RigPose) -> str | None:
    """Say what the own poses of cameras have against the rig, None if they have nothing.

    Those with other intrinsics are likelier, and differ, and no other camera supports the rig; or
    the poses would be trusted, but have few of their inliers in the rig, however near they are: a
    camera that is turned by a degree has hardly an inlier left.
    """
    doubts = [_doubt(one, pose) for one, pose in zip(sights, own, strict=True)]
    support = [
        inliers.sum() for doubt, inliers in zip(doubts, best.inliers, strict=True) if doubt is None
    ]
    if any(doubts) and max(support, default=0) < sights[0].gate.min_inliers:
        return next(doubt for doubt in doubts if doubt)
    names = [
        one.name
        for one, pose, inliers in zip(sights, own, best.inliers, strict=True)
        if pose.cam_from_world and not pose.refusal and 2 * inliers.sum() < pose.num_inliers
    ]
    if not names:
        return None
    return (
        f"{' and '.join(names)}: their own matches contradict the rig; is it calibrated, in the "
        "units of the map, and are its photos of one moment?"
    )


def _doubt(one: Sight, own: Pose) -> str | None:
    """Return why the intrinsics of a camera may be wrong, by its own pose; None if they fit."""
    if own.cam_from_world is None or own.confidence < one.gate.min_confidence:
        return None
    for kind in OTHER_INTRINSICS:
        other = own.measures.alternatives.get(kind)
        if other and gates.is_doubtful(kind, other):
            reason = gates.ALTERNATIVES[kind].reason
            return f"{one.name}: {reason.format(detail=other.detail, inliers=own.num_inliers)}"
    return None


def _none(sights: Sequence[Sight], gate: Gate) -> str | None:
    """Return why there is no pose."""
    number = sum(len(one.points2D) for one in sights)
    return gates.refusal(Measures(num_matches=number, given_focal_length=1.0), gate)
