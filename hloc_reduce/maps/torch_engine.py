"""The torch engine of a map in memory."""

from pathlib import Path

import numpy as np
import torch

from .. import extractors, matchers
from ..matchers.integers import match_images_of_points
from ..runtime import parallel
from ..utils.codes import FLOATS, to_integers
from .numpy_engine import takes


class TorchEngine:
    """Features and matches of one photo at a time, on a GPU if there is one.

    Args:
        extractor: of the map's feature.
        matcher: configuration of the matcher.
        storage: of the map's descriptors.
    """

    def __init__(self, extractor: extractors.Extractor, matcher: dict, storage: str):
        self._device = "cuda" if torch.cuda.is_available() else "cpu"
        self._extractor = extractor.eval().to(self._device)
        self.rotation_invariant = extractor.rotation_invariant
        self._matcher = matchers.load(matcher).eval()
        self.takes_codes = self._matcher.takes_codes
        coded = storage not in FLOATS and self.takes_codes
        # a code is rounded much more than integers are, and they are faster
        self._as_integers = coded and self._device == "cpu"

    def extract(self, image: Path | np.ndarray, preprocessing: dict) -> dict:
        """Extract the features of a photo, see `extractors.extract`."""
        return extractors.extract(self._extractor, image, preprocessing, self._device)

    def prepare(self, descriptors: np.ndarray) -> torch.Tensor:
        """Return descriptors (N, D) float32 as `match` takes them."""
        matched = to_integers(descriptors) if self._as_integers else descriptors
        return torch.from_numpy(matched).to(self._device)

    def match(self, query: torch.Tensor, described: torch.Tensor, rows: np.ndarray) -> np.ndarray:
        """Match the descriptors of a photo with some of a map image, see `Matcher.match_rows`.

        Args:
            query: (N, D) from `prepare`.
            described: (M, D) from `prepare`.
            rows: (K,) int64, ascending rows of these.
        """
        chosen = torch.from_numpy(rows).to(self._device)
        return self._matcher.match_rows(query, described, chosen).cpu().numpy()

    def match_points(
        self, query: torch.Tensor, described: torch.Tensor, images: list[np.ndarray]
    ) -> list[np.ndarray]:
        """Match the descriptors of a photo with images, see `NumpyEngine.match_points`."""
        if self._as_integers and takes(self._matcher.conf):
            limits = self._matcher.conf["ratio_threshold"], self._matcher.conf["distance_threshold"]
            return match_images_of_points(described.numpy(), query.numpy(), images, *limits)

        def match(rows: np.ndarray) -> np.ndarray:
            return self.match(query, described[rows], np.arange(len(rows)))

        return list(parallel.ordered("match", match, images))
