"""Find photos of a map whose poses contradict the other photos."""

from collections.abc import Collection, Iterable
from pathlib import Path

import h5py
import numpy as np
import pycolmap

from .. import logger
from ..localization import absolute_pose, intrinsics
from ..localization.confidence import DEFAULT_GATE
from ..localization.pose import MAX_ERROR, Pose, differ
from ..localization.projection import photo_scale, reprojection_errors
from ..localization.query import merged, ransac_options
from ..localization.references import SfmMap
from ..mapping import copies
from ..runtime import parallel
from ..utils import cli
from ..utils.h5 import open_h5
from ..utils.match_files import get_matches, list_pairs
from ..utils.progress import progress

OTHERS = 2  # photos that see a point by which another one is judged
# a pose contradicts the others if they place the photo farther away
FAR = 0.1  # of the median depth of its inliers
TURNED = 5.0  # degrees


def find(sfm: pycolmap.Reconstruction, matches: Path) -> list[str]:
    """Find the photos of a map whose poses contradict the other photos, see `judge`.

    So do copies of a place that is in the map twice, and sides of a place that were merged, see
    `mapping.copies`.

    Args:
        sfm: the map.
        matches: match file of its images.

    Returns:
        Their names.
    """
    names = [image.name for image in sfm.images.values()]
    return sorted({*judge(sfm, matches, names), *copies.find(sfm)})


def judge(sfm: pycolmap.Reconstruction, matches: Path, names: Collection[str]) -> list[str]:
    """Find photos whose poses contradict the other photos of a map.

    A photo whose pose agrees with less than half of its matches with points that at least two
    other photos see is localized by these, with the intrinsics of the map. It contradicts the
    others if that gives a pose elsewhere, with the confidence of a localized query, or if unknown
    intrinsics do, with a pose that is trusted. So do photos that were given wrong poses, or that
    the mapper placed wrongly, perhaps because they were cropped.

    Args:
        sfm: the map.
        matches: match file of its images.
        names: the photos to judge.

    Returns:
        The names of those that contradict the others.
    """
    reference, partners = SfmMap(sfm), _partners(sfm, matches)
    points = [np.unique(reference.point_rows(name)) for name in reference.images]
    seen = np.bincount(np.concatenate(points) + 1, minlength=len(reference.points) + 1)[1:]

    def work(name: str) -> str | None:
        with open_h5(matches) as file:
            return name if _contradicts(reference, name, partners[name], seen, file) else None

    names = sorted(names)
    judged = progress(parallel.ordered("judge", work, names), "Judging poses", "image", len(names))
    return [name for name in judged if name]


def warn(names: list[str]) -> None:
    """Warn of photos whose poses contradict the others, if there are any."""
    if names:
        logger.warning(
            "The map may be wrong: the other photos place %s elsewhere. Either these photos are "
            "misplaced, or the place looks the same at two positions: check their poses, or build "
            "the map without them. map.json lists all of them.",
            cli.some(names),
        )


def _partners(sfm: pycolmap.Reconstruction, matches: Path) -> dict[str, list[str]]:
    """Return for each image of a map those that it was matched with."""
    partners: dict[str, list[str]] = {image.name: [] for image in sfm.images.values()}
    for first, second in list_pairs(matches, partners):
        partners[first].append(second)
        partners[second].append(first)
    return partners


def _contradicts(
    reference: SfmMap, name: str, others: Iterable[str], seen: np.ndarray, file: h5py.File
) -> bool:
    """Return whether the points of other images place an image elsewhere.

    Args:
        reference: the map.
        name: of the image.
        others: images that it was matched with.
        seen: (P,) by how many images each point is seen.
        file: match file.
    """
    image, own = reference.images[name], np.zeros(len(seen) + 1, int)
    own[reference.point_rows(name)] = 1  # the last one is for keypoints without a point
    pairs = []
    for other in others:
        found, _ = get_matches(file, name, other)
        rows = reference.point_rows(other)[found[:, 1]]
        shared = (rows >= 0) & (seen[rows] - own[rows] >= OTHERS)
        pairs.append(np.stack([found[shared, 0], rows[shared]], axis=1))
    if not sum(map(len, pairs)):
        return False
    different, which = np.unique(np.concatenate(pairs), axis=0, return_inverse=True)
    images = np.split(which.reshape(-1), np.cumsum([len(part) for part in pairs])[:-1])
    points2D = np.array([point.xy for point in image.points2D])[different[:, 0]]
    points3D = reference.points[different[:, 1]]
    errors, _ = reprojection_errors(points2D, points3D, image.cam_from_world(), image.camera)
    if 2 * (errors <= MAX_ERROR * photo_scale(image.camera)).sum() >= len(errors):
        return False
    matches = points2D, points3D, images

    def elsewhere(pose: Pose) -> bool:
        placed = Pose(image.cam_from_world(), image.camera, pose.inliers)
        return differ(pose, placed, points3D, FAR, TURNED)

    config = ransac_options(MAX_ERROR, image.camera)
    pose = absolute_pose.estimate(*matches, image.camera, config, DEFAULT_GATE)
    enough = pose.num_inliers >= DEFAULT_GATE.min_inliers
    if enough and pose.confidence >= DEFAULT_GATE.min_confidence and elsewhere(pose):
        return True
    size = np.empty((image.camera.height, image.camera.width), np.uint8)
    guess, source = intrinsics.infer(size, intrinsics.MapCameras({}, set()))
    config = merged(config, intrinsics.REFINEMENTS[source])
    pose = absolute_pose.estimate(*matches, guess, config, DEFAULT_GATE)
    return pose.refusal is None and elsewhere(pose)
