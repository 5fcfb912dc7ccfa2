"""Which points a small map keeps: those that fix the poses of photos like its images."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pycolmap

from ..matchers.integers import two_nearest
from ..utils.codes import to_integers
from ..utils.feature_files import get_descriptors
from ..utils.h5 import open_h5
from ..utils.progress import progress
from .points import POINTS_PER_CHUNK, Points

NOISE = 1e-3  # of a keypoint's direction, in radians
UNKNOWN = 0.1  # of a pose without points: radians, and shares of the median distance
MARGIN = 2.0  # how many times as far the next descriptor is if half of the photos are matched
AT_ONCE = 0.05  # points that are ranked at once, as a share of those ranked before
SPARE = 256  # points whose gains are computed besides


class Sights:
    """What points tell photos like a map's images about their poses.

    Each image has a matrix, the inverse of the covariance of its pose by points that it shows. How
    much it learns from them is the logarithm of the determinant (D-optimal design).

    Args:
        points: all points.
        model: the map.
        reliability: of each point (P,), a factor of its derivatives.

    Attributes:
        points: all points.
    """

    def __init__(self, points: Points, model: pycolmap.Reconstruction, reliability: np.ndarray):
        self.points = points
        point = np.concatenate(points.visible)
        by_point = np.argsort(point, kind="stable")
        self._derivatives = _derivatives(points, model)[by_point]
        weights = (reliability / NOISE).astype(np.float32)
        self._derivatives *= weights[point[by_point], None, None]
        sizes = [len(part) for part in points.visible]
        self._image = np.repeat(np.arange(len(points.names)), sizes)[by_point]
        self._numbers = np.bincount(point, minlength=len(points))
        self._starts = np.cumsum(self._numbers) - self._numbers

    def ranked(self, most: int | None = None) -> np.ndarray:
        """Rank points by how much more images learn with them, greedily.

        All images get points, spread over their parts and depths, and points that many images share
        come first.

        Args:
            most: stop at about this number of points; default: rank all.

        Returns:
            Their indices (K,) int64, those that are needed most first; the same for the same
            arguments.
        """
        information = self._unknown()
        number = len(self.points)
        most = number if most is None else min(most, number)
        parts = np.array_split(np.arange(number), 1 + number // POINTS_PER_CHUNK)
        gains = np.concatenate([self._gains(part, np.linalg.inv(information)) for part in parts])
        ranking = np.zeros(0, np.int64)
        while len(ranking) < most:
            covariances, left = np.linalg.inv(information), number - len(ranking)
            more = min(max(1, int(AT_ONCE * len(ranking))), left)
            is_fresh = np.zeros(number, bool)
            while True:  # gains only shrink: points whose old gains are too small need no new ones
                candidates = _largest(gains, min(more + SPARE, left))
                best, stale = candidates[:more], candidates[~is_fresh[candidates]]
                if is_fresh[best].all():
                    break
                gains[stale], is_fresh[stale] = self._gains(stale, covariances), True
            self._add(self._rows(best), information)
            gains[best] = -np.inf
            ranking = np.concatenate([ranking, best])
        return ranking

    def learned(self, chosen: np.ndarray, nearest: np.ndarray) -> np.ndarray:
        """Return how much each image learns (I,) if it is matched with another one alone.

        Args:
            chosen: the points (K,) that are kept.
            nearest: of each image the one (I,) that it is matched with, maybe itself.
        """
        rows = self._rows(chosen)
        point = np.repeat(chosen, self._numbers[chosen])
        shown = self._image[rows] * len(self.points) + point
        is_matched = np.isin(nearest[self._image[rows]] * len(self.points) + point, shown)
        information = self._unknown()
        self._add(rows[is_matched], information)
        return np.linalg.slogdet(information)[1]

    def _unknown(self) -> np.ndarray:
        """Return the matrices (I, 6, 6) of images without points."""
        return np.tile(np.eye(6) / UNKNOWN**2, (len(self.points.names), 1, 1))

    def _gains(self, chosen: np.ndarray, covariances: np.ndarray) -> np.ndarray:
        """Return how much more all images would learn with one more point, for each of some (K,).

        Args:
            chosen: the points.
            covariances: (I, 6, 6) of the poses of the images.
        """
        rows = self._rows(chosen)
        side, covariance = self._derivatives[rows], covariances[self._image[rows]]
        (a, b), (_, d) = (side @ covariance @ side.swapaxes(1, 2)).transpose(1, 2, 0)
        growth = np.log((1 + a) * (1 + d) - b * b)
        number = np.repeat(np.arange(len(chosen)), self._numbers[chosen])
        return np.bincount(number, growth, minlength=len(chosen))

    def _add(self, rows: np.ndarray, information: np.ndarray) -> None:
        """Add what points tell images, in rows (O,), to the matrices (I, 6, 6)."""
        side = self._derivatives[rows]
        np.add.at(information, self._image[rows], side.swapaxes(1, 2) @ side)

    def _rows(self, chosen: np.ndarray) -> np.ndarray:
        """Return the rows (O,) of the images that show points (K,), point by point."""
        numbers = self._numbers[chosen]
        before = np.cumsum(numbers) - numbers
        return np.repeat(self._starts[chosen] - before, numbers) + np.arange(numbers.sum())


def reliabilities(points: Points, features: Path) -> np.ndarray:
    """Estimate how often points are matched in photos that show them.

    Each image is taken for such a photo: the mean descriptor from the other images is compared with
    the image's own keypoint of the point and with the most similar other one.

    Args:
        points: all points.
        features: feature file of the images.

    Returns:
        (P,) from 0 to 1, lower for points of few images.
    """
    matched, number = np.zeros(len(points)), np.ones(len(points))
    for rows, own, other in _distances(points, features):
        matched[rows] += 1 / (1 + MARGIN**2 * own / np.maximum(other, 1e-6))
        number[rows] += 1
    return matched / number


def _distances(
    points: Points, features: Path
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield of each image its points (M,), and how far its keypoints are from their descriptors.

    These are squared distances (M,) of its own keypoint and of the nearest other one.
    """
    sums = points.descriptors * points.norms[:, None]
    shown = zip(points.names, points.visible, points.keypoints, strict=True)
    for name, rows, keypoints in progress([*shown], "Comparing descriptors", "image"):
        with open_h5(features) as file:
            described = get_descriptors(file, name)
        if len(described) < 2 or not len(rows):
            continue
        others = sums[rows] - described[keypoints]
        others /= np.maximum(np.linalg.norm(others, axis=1, keepdims=True), 1e-12)
        own = np.einsum("md,md->m", others, described[keypoints])
        index, best, second = two_nearest(to_integers(others), to_integers(described))
        other = np.where(index == keypoints, second, best)
        yield rows, 2 - 2 * np.minimum(own, 1), 2 - 2 * np.minimum(other, 1)


def _derivatives(points: Points, model: pycolmap.Reconstruction) -> np.ndarray:
    """Return how the directions of points move with the poses of the images that show them.

    Returns:
        (O, 2, 6) float32 of each point of each image: across the direction, in radians, by rotation
        in radians and by translation in median distances of the image's points.
    """
    images = {image.name: image for image in model.images.values()}
    derivatives = [np.zeros((0, 2, 6), np.float32)]
    for name, rows in zip(points.names, points.visible, strict=True):
        local = images[name].cam_from_world() * points.xyz[rows]
        distances = np.maximum(np.linalg.norm(local, axis=1), 1e-12)
        ahead = local / distances[:, None]
        # any two directions across, the first one away from an axis that is far from the point
        axes = np.eye(3)[np.abs(ahead).argmin(axis=1)]
        aside = np.cross(ahead, axes)
        aside /= np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-12)
        across = np.stack([aside, np.cross(ahead, aside)], axis=1)
        turned = np.cross(ahead[:, None], across)
        scale = np.median(distances) if len(rows) else 1.0
        moved = across * (scale / distances)[:, None, None]
        derivatives.append(np.concatenate([turned, moved], axis=2).astype(np.float32))
    return np.concatenate(derivatives)


def _largest(values: np.ndarray, number: int) -> np.ndarray:
    """Return the indices of the largest values, the largest first, of equal ones the first."""
    if number < len(values):
        least = np.partition(values, len(values) - number)[len(values) - number]
        chosen = np.flatnonzero(values >= least)
    else:
        chosen = np.arange(len(values))
    return chosen[np.argsort(-values[chosen], kind="stable")][:number]
