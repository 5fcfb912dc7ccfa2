"""Features and matches of one photo at a time."""

from pathlib import Path

import numpy as np

from ..descriptors import COLMAP
from ..detectors import dog
from ..matchers import integers
from ..utils.codes import to_integers
from ..utils.images import in_original, resized
from .numpy_features import Extract


def takes(matcher: dict) -> bool:
    """Tell whether `NumpyEngine` has a matcher: mutual nearest neighbours."""
    return matcher["name"] == "nearest_neighbor" and matcher.get("do_mutual_check", True)


def is_colmap_sift(base: dict) -> bool:
    """Tell whether the configuration of a base extractor is of COLMAP's SIFT."""
    return base["name"] == "dog" and base.get("descriptor") == COLMAP


class NumpyEngine:
    """Computes with NumPy what `torch_engine.TorchEngine` does with torch.

    Descriptors are matched as integers.

    Args:
        extract: of the map's feature.
        matcher: configuration of a matcher that `takes` accepts.
    """

    takes_codes = True  # as the matcher does, see `matchers.Matcher`

    def __init__(self, extract: Extract, matcher: dict):
        self._extract = extract
        self.rotation_invariant = extract.rotation_invariant
        self._ratio_threshold = matcher.get("ratio_threshold")
        self._distance_threshold = matcher.get("distance_threshold")

    def extract(self, image: Path | np.ndarray, preprocessing: dict) -> dict:
        """Extract the features of a photo, see `extractors.extract`.

        Args:
            image: its file, or its pixels (H, W) or (H, W, 3) RGB, uint8.
            preprocessing: of the feature's configuration, and `mirrored`, to swap left and right.
        """
        pixels, size = resized(image, preprocessing)
        return in_original(self._extract(pixels), pixels.shape, size, dog.NOISE)

    def prepare(self, descriptors: np.ndarray) -> np.ndarray:
        """Return descriptors (N, D) float32 as `match` takes them: (N, D) int16."""
        return to_integers(descriptors)

    def match_points(
        self, query: np.ndarray, described: np.ndarray, images: list[np.ndarray]
    ) -> list[np.ndarray]:
        """Match the descriptors of a photo with images, see `integers.match_images_of_points`.

        Args:
            query: (N, D) from `prepare`.
            described: (P, D) from `prepare`, of points.
            images: of each image the rows of its points (K,) int64, ascending.
        """
        limits = self._ratio_threshold, self._distance_threshold
        return integers.match_images_of_points(described, query, images, *limits)
