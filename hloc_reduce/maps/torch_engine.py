"""The engine of a map in memory that uses torch, on a GPU if there is one."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from .. import extractors, matchers
from ..confs.matchers import for_features
from ..matchers.base import Matcher
from ..matchers.integers import is_worthwhile
from ..runtime import parallel
from ..utils.codes import FLOATS
from .matching import Features, IntegerMatching, Matching, is_integer_matcher

Tensors = dict[str, torch.Tensor]


class TorchEngine:
    """Extracts with torch, and matches with torch or as integers.

    Args:
        extractor: of the map's feature.
        storage: of the map's descriptors.
        made_from: of the map's features, see `extract_features.provenance`.
    """

    def __init__(self, extractor: extractors.Extractor, storage: str, made_from: dict):
        self._device = "cuda" if torch.cuda.is_available() else "cpu"
        self._extractor = extractor.eval().to(self._device)
        self.rotation_invariant = extractor.rotation_invariant
        self._by_integers = self._device == "cpu" and is_worthwhile(coded=storage not in FLOATS)
        self._made_from = made_from

    def matching(self, matcher: dict) -> Matching:
        """Return what matches as a matcher with a configuration does."""
        if self._by_integers and is_integer_matcher(matcher):
            return IntegerMatching(matcher)
        model = for_features(matcher, self._made_from)
        return TorchMatching(matchers.load(model), self._device)

    def extract(
        self, image: Path | np.ndarray, preprocessing: dict, mask: np.ndarray | None = None
    ) -> dict:
        """Extract the features of a photo, see `extractors.extract`."""
        return extractors.extract(self._extractor, image, preprocessing, self._device, mask)


class TorchMatching:
    """Matches by a matcher of torch.

    Args:
        matcher: the matcher.
        device: where it computes.
    """

    def __init__(self, matcher: Matcher, device: str):
        self._matcher, self._device = matcher.eval().to(device), device
        self.feature_keys, self.takes_codes = matcher.feature_keys(), matcher.takes_codes

    def prepare(self, features: Features) -> Tensors:
        """Return what the matcher needs of the features of an image."""
        return {key: self._tensor(features[key]) for key in self.feature_keys}

    def match(self, query: Tensors, image: Tensors, rows: np.ndarray) -> np.ndarray:
        """Match a photo with some keypoints of a map image, see `Matching.match`."""
        return self._matcher.match_rows(query, image, self._tensor(rows)).cpu().numpy()

    def match_points(
        self, query: Tensors, descriptors: np.ndarray, images: Sequence[tuple[np.ndarray, Features]]
    ) -> list[np.ndarray]:
        """Match a photo with images that share descriptors, see `Matching.match_points`."""
        described = self._tensor(descriptors)

        def match(image: tuple[np.ndarray, Features]) -> np.ndarray:
            rows, others = image
            features = {key: self._tensor(value) for key, value in others.items()}
            features["descriptors"] = described[self._tensor(rows)].T
            return self.match(query, features, np.arange(len(rows)))

        return list(parallel.ordered("match", match, images))

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(array).to(self._device)
