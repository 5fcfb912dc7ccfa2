"""Features of COLMAP's SIFT, their retrieval and their matches, one photo at a time."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..descriptors import COLMAP
from ..detectors import dog
from ..utils.cli import InputError
from ..utils.codes import to_integers
from ..utils.images import in_original, resized
from . import matching, projection, vlad


def takes(model: dict, matcher: dict) -> bool:
    """Tell whether `LightEngine` can stand for models: COLMAP's SIFT, mutual nearest neighbours.

    Args:
        model: configuration of an extractor.
        matcher: configuration of a matcher.
    """
    base = model.get("base", model)
    nearest = matcher["name"] == "nearest_neighbor" and matcher.get("do_mutual_check", True)
    return base["name"] == "dog" and base.get("descriptor") == COLMAP and nearest


class LightEngine:
    """Computes with NumPy and pycolmap what `maps.engine.TorchEngine` does.

    Descriptors are matched as integers.

    Args:
        model: configuration of an extractor that `takes` accepts.
        layers: of the projection, if any.
        matcher: configuration of the matcher.
        vocabulary: (W, D) float32.
    """

    def __init__(
        self,
        model: dict,
        layers: Sequence[projection.Layer] | None,
        matcher: dict,
        vocabulary: np.ndarray,
    ):
        base = model.get("base", model)
        if unknown := set(base) - set(dog.CONF) - {"name"}:
            raise InputError(f"DoG has no option {', '.join(sorted(unknown))}.")
        self._conf = {**dog.CONF, **base}
        self._detect = dog.detector(self._conf)
        self._layers, self._vocabulary = layers, vocabulary
        limits = matcher.get("ratio_threshold"), matcher.get("distance_threshold")
        self._ratio_threshold, self._distance_threshold = limits

    def extract(self, image: Path | np.ndarray, preprocessing: dict) -> dict:
        """Extract the features of a photo, see `extractors.extract`.

        Args:
            image: see `utils.images.resized`.
            preprocessing: see `utils.images.resized`.
        """
        pixels, size = resized(image, preprocessing)
        if pixels.ndim != 2:
            raise InputError("DoG needs grey images: preprocessing: {grayscale: true}.")
        found = dog.strongest(*self._detect(pixels), self._conf["max_keypoints"])
        keypoints, descriptors = found
        if self._layers is not None:
            descriptors = projection.project(descriptors, self._layers)
        features = {"keypoints": keypoints[:, :2], "descriptors": descriptors.T}
        return in_original(features, pixels.shape, size, dog.NOISE)

    def aggregate(self, descriptors: np.ndarray) -> np.ndarray:
        """Return the global descriptor (1, G) float32 of local ones (N, D) float32."""
        return vlad.aggregate(descriptors, self._vocabulary)[None]

    def prepare(self, descriptors: np.ndarray) -> np.ndarray:
        """Return descriptors (N, D) float32 as `match` takes them: (N, D) int16."""
        return to_integers(descriptors)

    def match(self, query: np.ndarray, described: np.ndarray, shown: np.ndarray) -> np.ndarray:
        """Match the descriptors of a photo with some of a map image, see `Matcher.match_rows`.

        Args:
            query: (N, D) from `prepare`.
            described: (M, D) from `prepare`.
            shown: (K,) int64, ascending rows of these.
        """
        matches, cosine = matching.mutual_nearest(
            *(described, query, self._ratio_threshold, shown),
            distance_threshold=self._distance_threshold,
        )
        matched = np.flatnonzero(matches >= 0)
        matched = matched[np.argsort(-cosine[matched], kind="stable")]
        return np.stack([matches[matched], shown[matched]], axis=1)
