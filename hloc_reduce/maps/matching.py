"""Matches of a photo with the images of a map in memory."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from ..matchers import integers
from ..utils.codes import to_integers

Features = Mapping[str, np.ndarray]  # hloc's dictionary, see `matchers.base.Matcher`


class Matching(Protocol):
    """Matches features as a matcher does.

    Attributes:
        feature_keys: what it needs of the features of an image, such as descriptors.
        takes_codes: whether it takes unbiased codes, see `matchers.base.Matcher`.
    """

    feature_keys: tuple[str, ...]
    takes_codes: bool

    def prepare(self, features: Features) -> Any:
        """Return the features of an image as `match` takes them."""

    def match(self, query: Any, image: Any, rows: np.ndarray) -> np.ndarray:
        """Match a photo with some keypoints of a map image.

        Args:
            query: from `prepare`.
            image: from `prepare`.
            rows: (K,) int64, ascending indices of keypoints of the image.

        Returns:
            (M, 2) int64, indices of keypoints of the photo and of the image, the most similar
            first.
        """

    def match_points(
        self, query: Any, descriptors: np.ndarray, images: Sequence[tuple[np.ndarray, Features]]
    ) -> list[np.ndarray]:
        """Match a photo with images that share descriptors, those of the points that they show.

        Args:
            query: from `prepare`.
            descriptors: (P, D) float32 of points.
            images: of each image the rows of its points (K,) int64, ascending, and its other
                features.

        Returns:
            For each image (M, 2) int64, indices of keypoints of the photo and of the image's rows,
            the most similar first.
        """


def is_integer_matcher(matcher: dict) -> bool:
    """Tell whether a configuration is of a matcher of `IntegerMatching`: mutual neighbours."""
    return matcher["name"] == "nearest_neighbor" and matcher.get("do_mutual_check", True)


class IntegerMatching:
    """Mutual nearest neighbours of descriptors that are rounded to integers, in NumPy.

    Args:
        matcher: a configuration that `is_integer_matcher`.
    """

    feature_keys: tuple[str, ...] = ("descriptors",)
    takes_codes = True

    def __init__(self, matcher: dict):
        self._limits = matcher.get("ratio_threshold"), matcher.get("distance_threshold")

    def prepare(self, features: Features) -> np.ndarray:
        """Return the descriptors (N, D) int16."""
        return to_integers(features["descriptors"].T)

    def match(self, query: np.ndarray, image: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Match a photo with some keypoints of a map image, see `Matching.match`."""
        ratio_threshold, distance_threshold = self._limits
        matches, cosine = integers.mutual_nearest(
            image, query, ratio_threshold, rows, distance_threshold
        )
        matched = matches >= 0
        return integers.most_similar_first(matches[matched], rows[matched], cosine[matched])

    def match_points(
        self,
        query: np.ndarray,
        descriptors: np.ndarray,
        images: Sequence[tuple[np.ndarray, Features]],
    ) -> list[np.ndarray]:
        """Match a photo with images that share descriptors, see `Matching.match_points`."""
        rows = [rows for rows, _ in images]
        return integers.match_images_of_points(to_integers(descriptors), query, rows, *self._limits)
