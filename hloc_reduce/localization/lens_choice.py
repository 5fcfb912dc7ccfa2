"""The pose of a query whose lens may be one of several, or is not known at all."""

from dataclasses import replace

import numpy as np
import pycolmap

from . import absolute_pose
from . import gate as gates
from .gate import Gate
from .hypotheses import alternative
from .intrinsics import from_list
from .pose import Matches, Pose, quality


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
    """Estimate a pose with a camera and with each other lens that may have taken the photo.

    The pose with the highest confidence counts. If that of another lens is nearly as likely, but
    another pose, it is not trusted.

    Args:
        points2D: (M, 2) image points of all matches, COLMAP's pixels.
        points3D: (M, 3) their world points.
        images: of each map image the indices of its matches, the most similar first.
        camera: intrinsics.
        config: as in `absolute_pose.estimate`; under "photo" also the other "lenses", or a
            "refusal" if no lens is known, see `intrinsics.refinement`.
        gate: what a pose must have to be trusted.
        thorough: as in `absolute_pose.estimate`.
        workers: as in `absolute_pose.estimate`.
        likely: as in `absolute_pose.estimate`.
    """
    photo = config.get("photo", {})
    if reason := photo.get("refusal"):
        return Pose(None, camera, np.zeros(len(points2D), bool), refusal=reason)
    tried = [Matches(points2D, points3D, camera, config)]
    tried += [tried[0].with_lens(from_list(lens)) for lens in photo.get("lenses", ())]
    options = gate, thorough, workers, likely
    poses = [
        absolute_pose.estimate(points2D, points3D, images, matches.camera, matches.config, *options)
        for matches in tried
    ]
    best = max(poses, key=quality)
    if best.cam_from_world is None:
        return best
    found = [
        alternative(best, other, points3D)
        for other in poses
        if other is not best and other.cam_from_world is not None
    ]
    found = [one for one in found if gates.differ(one, gates.SAME_POSE)]
    if not found:
        return best
    others = {**best.measures.alternatives, "lens": max(found)}
    measures = replace(best.measures, alternatives=others)
    return replace(best, measures=measures, refusal=gates.refusal(measures, gate))
