"""Features of photos: COLMAP's SIFT, or a network in an ONNX file."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from ..detectors import dog
from ..networks.noise import reduce_noise
from ..projections import layers as frozen
from ..utils.cli import InputError
from . import onnx_files


class Extract(Protocol):
    """Extracts the features of an image."""

    rotation_invariant: bool  # see `extractors.Extractor`

    def __call__(self, image: np.ndarray, mask: np.ndarray | None) -> dict:
        """Return the features of an image (H, W) or (H, W, 3) RGB float32 in [0, 1].

        Args:
            image: the image.
            mask: (H, W) bool, which pixels may have keypoints, None for all. Others are dropped
                later, so that only those that choose the best keypoints need it.

        Returns:
            `keypoints` (N, 2) x, y in its pixels, centres at integers; `descriptors` (D, N) of unit
            norm; and perhaps `blur`, the standard deviation in pixels of the blur by which the
            noise was reduced.
        """


class ColmapSift:
    """COLMAP's SIFT, reduced by a projection.

    Args:
        conf: configuration of the extractor `dog`.
        layers: of the projection, if any.

    Raises:
        InputError: for unknown options.
    """

    def __init__(self, conf: dict, layers: Sequence[frozen.Layer] | None):
        if unknown := set(conf) - set(dog.DEFAULT_CONF) - {"name"}:
            raise InputError(f"DoG has no option {', '.join(sorted(unknown))}.")
        self._conf, self._layers = {**dog.DEFAULT_CONF, **conf}, layers
        self._detect = dog.detector(self._conf)
        self.rotation_invariant = dog.is_rotation_invariant(self._conf)

    def __call__(self, image: np.ndarray, mask: np.ndarray | None) -> dict:
        """Return the features of an image (H, W)."""
        if image.ndim != 2:
            raise InputError("DoG needs grey images: preprocessing: {grayscale: true}.")
        number = self._conf["max_keypoints"]
        keypoints, descriptors = dog.strongest(*self._detect(image, mask=mask), number)
        if self._layers is not None:
            descriptors = frozen.project(descriptors, self._layers)
        return {"keypoints": keypoints[:, :2], "descriptors": descriptors.T}


class OnnxNetwork:
    """A feature that `hloc_reduce.export` wrote, run by ONNX Runtime.

    Args:
        path: the ONNX file.
        feature: the name of the feature that it must be.
        denoise: reduce the noise of noisy images first.

    Raises:
        InputError: when ONNX Runtime is not installed, or the file is broken or of another feature.
    """

    rotation_invariant = False

    def __init__(self, path: Path, feature: str, denoise: bool):
        self._session, metadata = onnx_files.read(path, "feature", ("stride", "feature"))
        if (name := metadata["feature"]) != feature:
            raise InputError(f"{path} has the feature {name}, the map has {feature}.")
        self._stride, self._denoise = int(metadata["stride"]), denoise

    def __call__(self, image: np.ndarray, mask: np.ndarray | None) -> dict:
        """Return the features of an image (H, W, 3); the file chooses among all keypoints."""
        if image.ndim != 3:
            raise InputError("ONNX files take RGB images: preprocessing: {grayscale: false}.")
        channels, blur = image.transpose(2, 0, 1), 0.0
        if self._denoise:
            channels, blur = reduce_noise(channels)
        given = np.array(image.shape[1::-1])
        size = np.maximum(1, given // self._stride) * self._stride
        shown = size.tolist()
        batch = np.stack([cv2.resize(channel, shown) for channel in channels])[None]
        outputs = self._session.run(["keypoints", "descriptors"], {"image": batch})
        keypoints, descriptors = outputs
        ratio = (given / size).astype(np.float32)
        moved = (keypoints + 0.5) * ratio - 0.5
        return {"keypoints": moved, "descriptors": descriptors.T, "blur": blur}
