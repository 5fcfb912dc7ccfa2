"""Localize one query: 2D-3D matches through retrieved images, PnP + RANSAC."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pycolmap

from . import gate as gates
from . import lens_choice
from .gate import DEFAULT_GATE, Gate
from .measures import Alternative, covariance
from .near import Guess
from .pose import Pose, apart
from .projection import POSE, photo_scale
from .references import Reference


def localize(
    reference: Reference,
    keypoints: np.ndarray,
    camera: pycolmap.Camera,
    matches: Mapping[str, np.ndarray],
    config: dict,
    gate: Gate = DEFAULT_GATE,
    thorough: bool = True,
    workers: int = 1,
    guess: Guess | None = None,
) -> tuple[pycolmap.Rigid3d | None, dict]:
    """Localize a query.

    Args:
        reference: the map.
        keypoints: (N, 2) of the query, COLMAP's pixels.
        camera: intrinsics.
        matches: from map images, best first, to (M, 2) indices of the keypoints of the query and
            of the image, the most similar first.
        config: hloc's dict of options of pycolmap, under "estimation" and "refinement"; under
            "photo", what `absolute_pose.estimate` reads.
        gate: what a pose must have to be trusted.
        thorough: where few matches agree with a pose, try those of single images, too.
        workers: threads that estimate poses.
        guess: of the pose; RANSAC begins with the matches that fit it, but all matches decide.

    Returns:
        The pose (camera from world) or None, and info on the cluster of map images with the best
        pose: `reason`, why the pose is not trusted, None if it is; `probability`, see
        `gate.probability`; `measures`, see `Measures`, and of these `confidence`, at least 0, and
        `agreement`; `num_inliers`; `num_matches`, matches with a 3D point, and
        `num_correspondences`, the different ones of these (M); `num_without_point`, the other
        matches; `camera`, the intrinsics of the pose; `db`, the best retrieved image; `keypoints`
        (M,), indices of the query's; `point3D_ids` (M,); `points3D` (M, 3); `inliers` (M,) bool;
        `covariance` (6, 6) of the pose, None if the inliers do not determine it, see
        `measures.covariance`.
    """
    solved = []
    for names in reference.clusters(list(matches)) if matches else [[]]:
        info, images = correspondences(reference, names, matches)
        points = keypoints[info["keypoints"]], info["points3D"]
        likely = None if guess is None else guess.fits(*points, camera)
        settings = camera, config, gate, thorough, workers, likely
        found = lens_choice.estimate(points[0], points[1], images, *settings)
        info |= {
            **gates.verdict(found.measures, gate),
            "reason": _reason(len(keypoints), names, info) or found.refusal,
            "camera": found.camera,
            "num_inliers": found.num_inliers,
            "inliers": found.inliers,
            "covariance": _covariance(*points, found),
            "db": names[0] if names else None,
        }
        solved.append((found, info))
    best, info = max(solved, key=lambda both: _quality(both[1]))
    if best.cam_from_world is not None and info["num_matches"]:
        rivals = []
        for other, its_info in solved:
            if other is not best and other.cam_from_world is not None and not its_info["reason"]:
                ratio = other.num_inliers / best.num_inliers
                distance = apart(best, other, info["points3D"])
                rivals.append(Alternative(ratio, *distance, detail=other.num_inliers))
        if rivals := [one for one in rivals if gates.differ(one, gates.RIVALS)]:
            others = {**best.measures.alternatives, "other_images": max(rivals)}
            info |= gates.verdict(replace(best.measures, alternatives=others), gate)
    info["confidence"] = round(max(0.0, info["measures"].confidence), 2)
    info["agreement"] = round(info["measures"].agreement, 3)
    return best.cam_from_world, info


def _covariance(points2D: np.ndarray, points3D: np.ndarray, pose: Pose) -> np.ndarray | None:
    """Return the covariance (6, 6) of a pose, None if its inliers do not determine it."""
    if pose.cam_from_world is None:
        return None
    view = pose.cam_from_world, pose.camera, pose.degrees_of_freedom
    found = covariance(points2D[pose.inliers], points3D[pose.inliers], *view)
    return None if found is None else found[:POSE, :POSE]


def _quality(info: dict) -> tuple[bool, float, int]:
    return info["reason"] is None, info["measures"].confidence, info["num_inliers"]


def _reason(num_keypoints: int, names: list[str], info: dict) -> str | None:
    """Return why a query has no correspondences, None if it has some."""
    if not num_keypoints:
        return "no keypoints"
    if not names:
        return "no map image was retrieved"
    return None if info["num_matches"] else "no match with a 3D point"


def correspondences(
    reference: Reference, names: list[str], matches: Mapping[str, np.ndarray]
) -> tuple[dict, list[np.ndarray]]:
    """Collect the different 2D-3D matches through some images, sorted.

    Args:
        reference: the map.
        names: the images.
        matches: see `localize`.

    Returns:
        The first part of the info of `localize`, and of each image the indices of its matches, in
        their order.
    """
    pairs, points = [np.zeros((0, 2), np.int64)], [np.zeros((0, 3))]
    for name in names:
        ids, xyz = reference.lift(name, matches[name][:, 1])
        pairs.append(np.stack([matches[name][:, 0], ids], axis=1))
        points.append(xyz)
    pair = np.concatenate(pairs)
    image = np.repeat(np.arange(len(names)), [len(matches[name]) for name in names])
    known = np.flatnonzero(pair[:, 1] >= 0)
    span = pair[:, 1].max(initial=0) + 1
    number = pair[known] @ [span, 1]  # sorted as the pairs, and much faster
    _, first, which = np.unique(number, return_index=True, return_inverse=True)
    different = pair[known[first]]
    images = [_different(which[image[known] == i]) for i in range(len(names))]
    return {
        "num_matches": len(known),
        "num_without_point": len(pair) - len(known),
        "num_correspondences": len(different),
        "keypoints": different[:, 0],
        "point3D_ids": different[:, 1],
        "points3D": np.concatenate(points)[known[first]],
    }, images


def _different(numbers: np.ndarray) -> np.ndarray:
    """Keep the first of equal numbers (N,)."""
    return numbers[np.sort(np.unique(numbers, return_index=True)[1])]


def ransac_options(ransac_thresh: float, camera: pycolmap.Camera) -> dict:
    """Return the options of `localize` for an inlier threshold.

    Args:
        ransac_thresh: in pixels, for photos whose longer side is at most 1,600 pixels. That of a
            larger photo, whose keypoints are less precise, is larger in proportion.
        camera: intrinsics of the photo.
    """
    return {"estimation": {"ransac": {"max_error": ransac_thresh * photo_scale(camera)}}}


def merged(config: dict, refinement: dict) -> dict:
    """Merge two dicts of options under "estimation" and "refinement"; the second one wins."""
    keys = config.keys() | refinement.keys()
    return {key: {**config.get(key, {}), **refinement.get(key, {})} for key in keys}
