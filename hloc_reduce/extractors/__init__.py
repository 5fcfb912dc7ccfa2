"""Extractors: image to features."""

import json
import pkgutil
import sys
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from threading import Lock

import numpy as np
import torch

from ..descriptors import DIM
from ..networks.noise import reduce_noise
from ..utils.base_model import BaseModel
from ..utils.cli import InputError
from ..utils.configured import dynamic_load
from ..utils.hloc import is_installed
from ..utils.images import Frame, in_original, resized

_gpu = Lock()  # of the thread whose image is in a network
# from an image (H, W) float32 in [0, 1], and perhaps a `mask` (H, W) bool, where keypoints may be,
# to what `utils.colmap.detect_dog` returns
Detect = Callable[..., tuple[np.ndarray, np.ndarray]]


class Extractor(BaseModel):
    """Maps an image to its local features.

    A subclass writes `_forward`: from `image` (1, C, H, W) float32 in [0, 1] to `keypoints`
    (1, N, 2) x, y in its pixels, centres at integers, `descriptors` (1, D, N) of unit norm, and
    perhaps `scores`, `scales` (pixels) and `oris` (degrees), all (1, N), and `blur` (1,), the
    standard deviation in pixels of the blur by which it reduced the noise of the image.

    Keypoints of masked pixels are dropped from what it returns. One that chooses the best keypoints
    leaves them out before, by `mask` (H, W) bool, if the image has one: where keypoints may be.

    Attributes:
        detection_noise: standard deviation of the keypoints in pixels.
        detect: detects the keypoints, if that can be done in another process (pickled), separately
            from describing them; `_forward` gets the result as `detected`.
        detection_blocks: `detect` lets no other thread of its process run meanwhile.
        dim: dimension of the descriptors, as far as it is known.
        rotation_invariant: photos match however they are turned. If that depends on the
            configuration, the subclass writes `is_rotation_invariant`, too.
        gpu_images: how many threads may give images to one extractor on a GPU.
        cpu_images: the same on a CPU, where each computes in one thread; of 1 image all do.
        stride: what the sides of an image are multiples of in `fixed`.
    """

    required_inputs = ("image",)
    detection_noise = 1.0
    detect: Detect | None = None
    detection_blocks = True
    dim = DIM
    rotation_invariant = False
    gpu_images = 1
    cpu_images = 1
    stride = 1

    @property
    def descriptor(self) -> str:
        """The name of these descriptors in the metadata of projections."""
        return type(self).__module__.rpartition(".")[2]

    @property
    def base(self) -> "Extractor":
        """The extractor whose features `reduce` takes; several extractors may share it."""
        return self

    @property
    def detection(self) -> dict:
        """What determines the keypoints, equal for extractors that share them."""
        return {**self.conf, "name": type(self).__module__}

    @classmethod
    def is_rotation_invariant(cls, conf: dict) -> bool:
        """Tell whether an extractor of this class with a configuration is `rotation_invariant`."""
        return cls.rotation_invariant

    def reduce(self, features: dict) -> dict:
        """Return the features of this extractor, computed from those of `base`."""
        return features

    def fixed(self, image: torch.Tensor) -> dict:
        """Return the features of an image in tensors of fixed length, for `hloc_reduce.export`.

        `NetworkExtractor`s have it, so that they can be written as ONNX.

        Args:
            image: (1, 3, H, W) float32 RGB in [0, 1]; H and W are multiples of `stride`.

        Returns:
            What `_forward` returns without noise reduction, for exactly `max_keypoints` keypoints.
            Missing ones have the score -inf.
        """
        raise NotImplementedError


class NetworkExtractor(Extractor):
    """An extractor that reduces the noise of noisy images if its option `denoise` is set.

    A subclass writes `_extract`, in place of `_forward`, and `fixed`. On a GPU, one image at a time
    is in the network, so that its memory does not depend on the number of threads.
    """

    gpu_images = 8

    def _forward(self, data: dict) -> dict:
        image, blur = data["image"], 0.0
        if self.conf["denoise"]:
            channels, blur = reduce_noise(image[0].cpu().numpy())
            image = torch.from_numpy(channels)[None].to(image) if blur else image
        with _gpu if image.is_cuda else nullcontext():
            features = self._extract(image, data.get("mask"))
        return {**features, "blur": torch.tensor([blur])}

    def _extract(self, image: torch.Tensor, mask: torch.Tensor | None) -> dict:
        """Return the features of an image (1, C, H, W), as `_forward` returns them.

        Args:
            image: the image.
            mask: (H, W) bool, where keypoints may be; None for everywhere.
        """
        raise NotImplementedError


class Graph(torch.nn.Module):
    """An extractor as a graph of tensors that ONNX can express.

    Args:
        extractor: one that has `fixed`, or a projection of its features.
    """

    def __init__(self, extractor: Extractor):
        super().__init__()
        self.extractor = extractor

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Compute the features of an image.

        Args:
            image: (1, 3, H, W) float32 RGB in [0, 1]; H and W are multiples of `stride`.

        Returns:
            Keypoints (N, 2) x, y in pixels, centres at integers; scores (N,); and descriptors
            (N, dim) of unit norm; float32.
        """
        features = self.extractor.reduce(self.extractor.base.fixed(image))
        scores = features["scores"][0]
        rows = torch.nonzero(scores > -torch.inf)[:, 0]
        values = features["keypoints"][0], scores, features["descriptors"][0].T
        keypoints, scores, descriptors = (value.index_select(0, rows) for value in values)
        return keypoints, scores, descriptors


def load(conf: dict) -> Extractor:
    """Make the extractor of a model configuration.

    Its `name` is a module of this package, or else an extractor of an installed hloc. `hloc.dog`
    is hloc's `dog`, although this package has one too.

    Raises:
        InputError: when there is no such extractor, or its configuration is wrong.
    """
    name = str(conf.get("name"))
    if not _is_ours(name) and (is_installed() or name.startswith("hloc.")):
        return load({"name": "hloc", "conf": conf})
    try:
        extractor = dynamic_load(sys.modules[__name__], name, Extractor)
    except InputError as error:
        raise InputError(f"{error} hloc's own extractors need hloc to be installed.") from None
    model = extractor(conf)
    if isinstance(model, NetworkExtractor) and not torch.cuda.is_available():
        for weights in model.parameters():
            if weights.dim() == 4:  # a fifth faster on a CPU
                weights.data = weights.data.contiguous(memory_format=torch.channels_last)
    return model


def is_rotation_invariant(conf: dict) -> bool:
    """Tell whether the extractor of a model configuration is `rotation_invariant`.

    It is not made, so that neither its weights nor an installed hloc are needed.
    """
    name = str(conf.get("name"))
    if not _is_ours(name):
        name, conf = "hloc", {"conf": conf}
    return dynamic_load(sys.modules[__name__], name, Extractor).is_rotation_invariant(conf)


def _is_ours(name: str) -> bool:
    """Tell whether an extractor is a module of this package."""
    return name in [module.name for module in pkgutil.iter_modules(__path__)]


def load_image(
    image: Path | np.ndarray, preprocessing: dict, mask: np.ndarray | None = None
) -> tuple[torch.Tensor, Frame]:
    """Return what `utils.images.resized` does, the image as a tensor (1, C, H, W)."""
    pixels, frame = resized(image, preprocessing, mask)
    pixels = np.atleast_3d(pixels).transpose(2, 0, 1)
    return torch.from_numpy(np.ascontiguousarray(pixels))[None], frame


def extract(
    model: Extractor,
    image: Path | np.ndarray,
    preprocessing: dict,
    device: str = "cpu",
    mask: np.ndarray | None = None,
) -> dict[str, np.ndarray]:
    """Extract the features of one image.

    Args:
        model: an extractor.
        image: its file, or its pixels (H, W) or (H, W, 3) RGB, uint8.
        preprocessing: see `utils.images.resized`.
        device: of the model.
        mask: (H, W) bool, in which pixels of the original image keypoints may be.

    Returns:
        keypoints (N, 2) float32 (x, y) in pixels of the original image, centres at integers;
        descriptors (D, N); scores, scales (pixels), oris (degrees) (N,), if the model has them;
        image_size (2,) width, height; the uncertainty of the keypoints, and the blur that reduced
        the noise, both in pixels; and the quarter turns, counterclockwise, by which the image was
        shown to the model.
    """
    return extract_several([model], image, preprocessing, device, mask=mask)[0]


@torch.no_grad()
def extract_several(
    models: list[Extractor],
    image: Path | np.ndarray,
    preprocessing: dict,
    device: str = "cpu",
    detect: Detect | None = None,
    mask: np.ndarray | None = None,
) -> list[dict[str, np.ndarray]]:
    """Extract several features of one image; what they have in common is computed once.

    Args:
        models: extractors with equal `detection`.
        image: its file, or its pixels (H, W) or (H, W, 3) RGB, uint8.
        preprocessing: see `utils.images.resized`.
        device: of the models.
        detect: replaces `detect` of the models, for example by a call in another process.
        mask: (H, W) bool, in which pixels of the original image keypoints may be.

    Returns:
        What `extract` returns, for each model.
    """
    pixels, frame = load_image(image, preprocessing, mask)
    data: dict = {"image": pixels.to(device)}
    detect = detect or models[0].detect
    if (near_kept := frame.near_kept(pixels.shape[2:])) is not None:
        data["mask"] = torch.from_numpy(near_kept).to(device)
        detect = detect and partial(detect, mask=near_kept)
    if detect is not None:
        data["detected"] = detect(pixels[0, 0].numpy())
    described: dict[str, dict] = {}
    extracted = []
    for model in models:
        base = json.dumps(model.base.conf, sort_keys=True, default=str)
        if base not in described:
            described[base] = model.base(data)
        found = model.reduce(described[base])
        features = {key: value[0].cpu().numpy() for key, value in found.items()}
        shape = tuple(pixels.shape[2:])
        extracted.append(in_original(features, shape, frame, model.detection_noise))
    return extracted
