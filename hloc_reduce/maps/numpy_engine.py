"""The engine of a map in memory that needs no torch."""

from pathlib import Path

import numpy as np

from ..descriptors import COLMAP_SIFT
from ..detectors import dog
from ..utils.images import in_original, resized
from .matching import IntegerMatching, Matching, is_integer_matcher
from .numpy_features import Extract


def is_colmap_sift(base: dict) -> bool:
    """Tell whether the configuration of a base extractor is of COLMAP's SIFT."""
    return base["name"] == "dog" and base.get("descriptor") == COLMAP_SIFT


class NumpyEngine:
    """Extracts and matches with NumPy, as `torch_engine.TorchEngine` does with torch.

    Args:
        extract: of the map's feature.
        lightglue: matches as LightGlue does, None if that is not needed.
    """

    def __init__(self, extract: Extract, lightglue: Matching | None = None):
        self._extract, self._lightglue = extract, lightglue
        self.rotation_invariant = extract.rotation_invariant

    def matching(self, matcher: dict) -> Matching:
        """Return what matches as a matcher with a configuration does."""
        if is_integer_matcher(matcher):
            return IntegerMatching(matcher)
        assert self._lightglue is not None
        return self._lightglue

    def extract(
        self, image: Path | np.ndarray, preprocessing: dict, mask: np.ndarray | None = None
    ) -> dict:
        """Extract the features of a photo, see `extractors.extract`.

        Args:
            image: its file, or its pixels (H, W) or (H, W, 3) RGB, uint8.
            preprocessing: see `utils.images.resized`.
            mask: (H, W) bool, which pixels of the photo may have keypoints.
        """
        pixels, frame = resized(image, preprocessing, mask)
        found = self._extract(pixels, frame.near_kept(pixels.shape))
        return in_original(found, pixels.shape, frame, dog.KEYPOINT_UNCERTAINTY_PIXELS)
