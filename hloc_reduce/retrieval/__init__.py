"""Retrieval: global descriptors of images, and which images they find."""

import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..utils.cli import InputError
from ..utils.configured import configure, dynamic_load
from ..utils.images import resized

HELPERS = ("ranking",)  # modules that are no retrieval


class Retrieval:
    """Gives an image one global descriptor, by which similar images are found.

    A subclass writes `describe` and, if it `learns`, `fit`. It sees the image and its local
    features as far as it declares them.

    Args:
        conf: overrides of `default_conf`, and optionally the key `name`.

    Attributes:
        required_inputs: what `describe` needs: `image`, or keys of hloc's dictionary of features.
        learns: whether it has a vocabulary, which `fit` learns from the local descriptors of a map.
        vocabulary: (W, D) float32, of one that learns.

    Raises:
        InputError: for an unknown configuration key, or a value of another type than its default.
    """

    default_conf: dict = {}
    required_inputs: tuple[str, ...] = ()
    learns = False
    vocabulary: np.ndarray

    def __init__(self, conf: dict):
        self.conf = configure(type(self).__name__, self.default_conf, conf)
        self._init(self.conf)

    @property
    def needs_image(self) -> bool:
        """Whether `describe` needs the image."""
        return "image" in self.required_inputs

    @property
    def feature_keys(self) -> tuple[str, ...]:
        """What `describe` needs of the features."""
        return tuple(key for key in self.required_inputs if key != "image")

    def fit(self, descriptors: np.ndarray) -> None:
        """Learn the vocabulary from local descriptors (N, D) float32, N > 0."""
        raise NotImplementedError

    def describe(self, data: dict[str, np.ndarray]) -> np.ndarray:
        """Return the global descriptor of an image; several threads may call this.

        Args:
            data: what `required_inputs` names: `image` (H, W) or (H, W, 3) RGB, float32 in [0, 1],
                after the `preprocessing` of the configuration; and float32 features of the original
                image: `descriptors` (D, N), `keypoints` (N, 2) x, y in pixels, centres at integers,
                `scores`, `scales`, `oris` (N,), `image_size` (2,) width, height.

        Returns:
            (G,) float32 of unit norm, or zero where it knows nothing of the image.
        """
        raise NotImplementedError

    def describe_photo(
        self,
        features: Mapping[str, np.ndarray],
        image: Path | np.ndarray | None,
        preprocessing: Mapping,
    ) -> np.ndarray:
        """Return the global descriptor of a photo, (G,) float16 as files have it.

        Args:
            features: at least those that `feature_keys` names, see `describe`.
            image: the photo's file, or its pixels (H, W) or (H, W, 3) RGB, uint8.
            preprocessing: of the image.

        Raises:
            InputError: when something that it needs is missing, or the image cannot be read.
        """
        given = {"image": image, **features}
        if missing := [key for key in self.required_inputs if given.get(key) is None]:
            raise InputError(f"{type(self).__name__} needs {', '.join(missing)}.")
        data = {key: features[key] for key in self.feature_keys}
        if image is not None and self.needs_image:
            data["image"], _ = resized(image, preprocessing)
        return self.describe(data).astype(np.float16)

    def _init(self, conf: dict) -> None:
        pass


def find(conf: dict) -> type[Retrieval]:
    """Return the class of a model configuration, whose `name` is a module of this package.

    Raises:
        InputError: when there is none.
    """
    return dynamic_load(sys.modules[__name__], str(conf.get("name")), Retrieval)


def load(conf: dict) -> Retrieval:
    """Make the retrieval of a model configuration.

    Raises:
        InputError: when there is no such retrieval, or its configuration is wrong.
    """
    return find(conf)(conf)
