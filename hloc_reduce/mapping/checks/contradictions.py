"""Photos whose poses contradict the other photos of a map."""

from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager

import numpy as np

from ...localization import absolute_pose, intrinsics
from ...localization.gate import DEFAULT_GATE, Tolerance
from ...localization.lenses import is_bent
from ...localization.pose import MAX_ERROR, Pose, differ
from ...localization.projection import photo_scale, reprojection_errors
from ...localization.query import merged, ransac_options
from ...localization.references import SfmMap
from ...runtime import parallel
from ...utils.h5 import open_h5
from ...utils.match_files import get_matches, list_pairs
from ...utils.progress import progress
from ..findings import Finding
from .inputs import Inputs

# a pose contradicts the others if they place the photo farther away
ELSEWHERE = Tolerance(0.1, 4.0)

Read = Callable[[str, str], np.ndarray]  # the matches (M, 2) of two images


def find(inputs: Inputs) -> list[Finding]:
    """Find the photos whose poses contradict the other photos, see `judge`."""
    names = judge(inputs, inputs.names)
    return [finding(names)] if names else []


def finding(names: Iterable[str]) -> Finding:
    """Return the finding for photos that the others place elsewhere."""
    text = (
        "The map may be wrong: the other photos place {names} elsewhere. Either these photos are "
        "misplaced, or the place looks the same at two positions: check their poses, or build the "
        "map without them."
    )
    doubt = "photos that others place elsewhere"
    return Finding("contradictions", text, tuple(names), doubt=doubt)


def judge(inputs: Inputs, names: Collection[str]) -> list[str]:
    """Find photos whose poses contradict the other photos of a map.

    A photo whose pose agrees with less than half of its matches with points that at least two
    other photos see is localized by these, with the intrinsics of the map. It contradicts the
    others if that gives a pose elsewhere, with the confidence of a localized query, or if unknown
    intrinsics do, with a pose that is trusted. So do photos that were given wrong poses, or that
    the mapper placed wrongly, perhaps because they were cropped.

    Args:
        inputs: the map; without matches nothing is found.
        names: the photos to judge.

    Returns:
        The names of those that contradict the others, sorted.
    """
    pairs = _pairs(inputs)
    if not pairs:
        return []
    partners: dict[str, list[str]] = {name: [] for name in inputs.names}
    for first, second in pairs:
        partners[first].append(second)
        partners[second].append(first)
    reference = SfmMap(inputs.model)
    points = [np.unique(reference.point_rows(name)) for name in reference.images]
    seen = np.bincount(np.concatenate(points) + 1, minlength=len(reference.points) + 1)[1:]

    def work(name: str) -> str | None:
        with _reading(inputs) as read:
            return name if _contradicts(reference, name, partners[name], seen, read) else None

    names = sorted(names)
    judged = progress(parallel.ordered("judge", work, names), "Judging poses", "image", len(names))
    return [name for name in judged if name]


def _pairs(inputs: Inputs) -> list[tuple[str, str]]:
    """Return the pairs of images that are matched."""
    if inputs.matches is not None:
        return list_pairs(inputs.matches, inputs.names)
    inside = {*inputs.names}
    return [pair for pair in inputs.verified or () if inside.issuperset(pair)]


@contextmanager
def _reading(inputs: Inputs) -> Iterator[Read]:
    """Give what reads the matches of two images: of the match file, or verified ones."""
    if inputs.matches is not None:
        with open_h5(inputs.matches) as file:
            yield lambda name, other: get_matches(file, name, other)[0]
        return
    verified = inputs.verified or {}

    def read(name: str, other: str) -> np.ndarray:
        found = verified.get((name, other))
        return verified[other, name][:, ::-1] if found is None else found

    yield read


def _contradicts(
    reference: SfmMap, name: str, others: Iterable[str], seen: np.ndarray, read: Read
) -> bool:
    """Return whether the points of other images place an image elsewhere.

    Args:
        reference: the map.
        name: of the image.
        others: images that it was matched with.
        seen: (P,) by how many images each point is seen.
        read: reads matches.
    """
    image, own = reference.images[name], np.zeros(len(seen) + 1, int)
    own[reference.point_rows(name)] = 1  # the last one is for keypoints without a point
    pairs = []
    for other in others:
        found = read(name, other)
        rows = reference.point_rows(other)[found[:, 1]]
        shared = (rows >= 0) & (seen[rows] - own[rows] >= 2)
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

    def elsewhere(pose: Pose) -> bool:
        placed = Pose(image.cam_from_world(), image.camera, pose.inliers)
        return differ(pose, placed, points3D, ELSEWHERE)

    config = ransac_options(MAX_ERROR, image.camera)
    pose = absolute_pose.estimate(points2D, points3D, images, image.camera, config, DEFAULT_GATE)
    enough = pose.num_inliers >= DEFAULT_GATE.min_inliers
    if enough and pose.confidence >= DEFAULT_GATE.min_confidence and elsewhere(pose):
        return True
    if is_bent(image.camera):
        return False  # a guess is none
    size = np.empty((image.camera.height, image.camera.width), np.uint8)
    guess, source = intrinsics.infer(size, intrinsics.MapCameras({}, set()))
    config = merged(config, intrinsics.REFINEMENTS[source])
    pose = absolute_pose.estimate(points2D, points3D, images, guess, config, DEFAULT_GATE)
    return pose.refusal is None and elsewhere(pose)
