"""A toy retrieval, as CONTRIBUTING.md says: one file, one class, `describe`."""

import cv2
import numpy as np

from hloc_reduce.retrieval import Retrieval
from hloc_reduce.utils.arrays import unit


class Thumbnail(Retrieval):
    """The mean colours of the cells of a grid, less their mean over the image."""

    required_inputs = ("image",)
    default_conf = {"cells": 8}

    def describe(self, data: dict[str, np.ndarray]) -> np.ndarray:
        """Return the global descriptor (cells * cells * 3,) of an `image` (H, W, 3)."""
        size = (self.conf["cells"], self.conf["cells"])
        colours = cv2.resize(data["image"], size, interpolation=cv2.INTER_AREA)
        return unit((colours - colours.mean(axis=(0, 1))).ravel()).astype(np.float32)
