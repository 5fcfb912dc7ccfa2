"""Parts of a map that show the same place twice, merged by mistake.

Two sides of a symmetric building, or two copies of a thing, have some matches, by which a mapper
may put one upon the other. Then their photos seem to be taken from the same viewpoints, but few
points are seen by both: what differs between the sides does not match. Of photos that were not
matched with each other, as frames of a video at different times, that tells nothing.
"""

from collections.abc import Collection

import numpy as np
import pycolmap

from ...localization.projection import reprojection_errors
from ...utils.colmap import point3D_ids
from ..epipolar import Pair
from ..findings import Finding
from . import groups
from .inputs import MIN_TELLING_POINTS, Inputs

# a point is expected in a photo if another photo sees it from a direction that differs by at most
# as many degrees, and from a distance that differs by at most this factor; and if what the photo
# sees there is not nearer by more than this factor, such as a pillar that passes by
MAX_ANGLE_DEGREES, MAX_DISTANCE_RATIO = 15.0, 1.5
# the largest distance between two such photos, in distances from the first one to the point
REACH = np.sqrt(
    1 + MAX_DISTANCE_RATIO**2 - 2 * MAX_DISTANCE_RATIO * np.cos(np.radians(MAX_ANGLE_DEGREES))
)
# Two groups of photos that share less of the expected points contradict each other, if a photo of
# one expects `MIN_TELLING_POINTS` in one of the other, on average. Sound maps share a quarter and
# more, the two that were merged by mistake 1 and 10 % (docs/maps.md).
JOINED_SHARE = 0.15
# The same for any two groups, also of sides that the mapper did not connect directly: sound maps
# share a tenth and more, a pillar with two equal sides 0 %.
APART_SHARE = 0.05
MAX_TESTS = 2e8  # of points in photos: above, only some of the points are used


def find(inputs: Inputs) -> list[Finding]:
    """Find the photos that show another side of the place, or a copy of it.

    They are the smaller one of two groups that contradict each other. Photos that a rig took at one
    moment are found together, if those in the group see most of their points.
    """
    images = inputs.images
    if len(images) < 4:
        return []
    expected, shared, used = _count(inputs.model, images)
    compared = None if inputs.matched is None else _compared(images, inputs.matched)

    def enough(wanted: np.ndarray, pairs: np.ndarray, smaller: np.ndarray) -> np.ndarray:
        return (smaller > 1) & (wanted >= MIN_TELLING_POINTS * used * 2 * pairs)

    limits = JOINED_SHARE, enough, APART_SHARE
    found = groups.contradicting(shared, expected, *limits, compared=compared)
    if not found:
        return []
    text = (
        "These photos show another side of the place that looks the same, or a copy of it: "
        "{names}. From where they are placed, they would see many points of the others, but they "
        "match few of them. Make a map of each side, because other photos may be at the wrong "
        "side, too, or add photos all the way from one side to the other."
    )
    points = np.array([image.num_points3D for image in images])
    inside = np.isin(np.arange(len(images)), found)
    most = 2 * np.bincount(inputs.frames, points * inside) > np.bincount(inputs.frames, points)
    names = tuple(sorted(images[i].name for i in np.flatnonzero(most[inputs.frames])))
    if not names:
        return []
    doubt = "photos that others place elsewhere"
    return [Finding("copies", text, names, {}, "drop", doubt)]


def _compared(images: list[pycolmap.Image], matched: Collection[Pair]) -> np.ndarray:
    """Tell which pairs of photos may share points as they were matched (N, N)."""
    rows = {image.name: i for i, image in enumerate(images)}
    pairs = [(rows[a], rows[b]) for a, b in matched if a in rows and b in rows]
    first, second = np.array(pairs, np.int64).reshape(-1, 2).T
    compared = np.zeros((len(images), len(images)), bool)
    compared[first, second] = compared[second, first] = True
    unlisted = ~compared.any(axis=1, keepdims=True)
    return compared | unlisted | unlisted.T


def _count(
    model: pycolmap.Reconstruction, images: list[pycolmap.Image]
) -> tuple[np.ndarray, np.ndarray, float]:
    """Count the points that pairs of photos are expected to share, and that they share.

    Returns:
        Both counts (N, N), symmetric: the sums of both directions; and the share of the points that
        was used.
    """
    number, points = len(images), model.points3D
    used = min(1.0, MAX_TESTS / (number * sum(image.num_points3D for image in images) or 1))
    chosen = np.random.default_rng(0).random(len(points)) < used
    ids = np.array(sorted(points), np.int64)[chosen]
    xyz = np.array([points[i].xyz for i in ids.tolist()]).reshape(-1, 3)
    centres = np.array([image.projection_center() for image in images])
    seen = np.array([np.isin(ids, point3D_ids(image)) for image in images])
    visible = np.array([_visible(*one, xyz) for one in zip(images, seen, strict=True)])
    expected, shared = np.zeros((2, number, number))
    for i in range(number):
        its = np.flatnonzero(seen[i])
        ray, moved = xyz[its] - centres[i], centres - centres[i]
        squared = (ray**2).sum(axis=1)
        near = np.flatnonzero((moved**2).sum(axis=1) <= REACH**2 * squared.max(initial=0))
        # from a centre that is near, the ray to each point is `ray - moved`
        along = moved[near] @ ray.T
        product = squared - along  # of both rays
        its_squared = squared - 2 * along + (moved[near] ** 2).sum(axis=1)[:, None]
        least = np.cos(np.radians(MAX_ANGLE_DEGREES)) ** 2 * squared * its_squared
        alike = (product > 0) & (product**2 > least)
        ratio = MAX_DISTANCE_RATIO**2
        alike &= (its_squared > squared / ratio) & (its_squared < squared * ratio)
        wanted = alike & visible[np.ix_(near, its)]
        expected[i, near] = np.count_nonzero(wanted, axis=1)
        shared[i, near] = np.count_nonzero(wanted & seen[np.ix_(near, its)], axis=1)
    np.fill_diagonal(expected, 0)
    np.fill_diagonal(shared, 0)
    return expected + expected.T, shared + shared.T, used


def _visible(image: pycolmap.Image, seen: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    """Return which points (P, 3) a photo may see (P,).

    They are within it, and nothing is before them: the point that it sees next to each, of those
    (P,) that it sees, is not so much nearer.
    """
    from scipy.spatial import cKDTree

    camera = image.camera
    assert camera is not None  # the image belongs to a model
    _, projected = reprojection_errors(np.zeros((len(xyz), 2)), xyz, image.cam_from_world(), camera)
    # comparisons with NaN, behind the camera, are false
    size = np.array([camera.width, camera.height])
    visible = np.all((projected > 0) & (projected < size), axis=1)
    if not (visible & seen).any():
        return visible
    distances = np.linalg.norm(xyz - image.projection_center(), axis=1)
    own = np.flatnonzero(visible & seen)
    inside = np.flatnonzero(visible)
    _, nearest = cKDTree(projected[own]).query(projected[inside])
    hidden = distances[inside] > MAX_DISTANCE_RATIO * distances[own[nearest]]
    visible[inside[hidden]] = False
    return visible
