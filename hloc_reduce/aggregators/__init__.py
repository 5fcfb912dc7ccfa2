"""Aggregators: local features to a global descriptor."""

import sys

import numpy as np

from ..utils.base_model import BaseModel, dynamic_load


class Aggregator(BaseModel):
    """Maps the local descriptors of an image to a global descriptor.

    A subclass writes `fit`, which learns the vocabulary from local descriptors (N, D), N > 0, and
    `_forward`: from `descriptors` (1, D, N) to `global_descriptor` (1, G) of unit norm.
    """

    required_inputs = ("descriptors",)
    vocabulary: np.ndarray

    def fit(self, descriptors: np.ndarray) -> None:
        """Learn the vocabulary from local descriptors (N, D), N > 0."""
        raise NotImplementedError


def load(conf: dict) -> Aggregator:
    """Make the aggregator of a model configuration, whose `name` is a module of this package.

    Raises:
        InputError: when there is no such aggregator, or its configuration is wrong.
    """
    return dynamic_load(sys.modules[__name__], str(conf.get("name")), Aggregator)(conf)
