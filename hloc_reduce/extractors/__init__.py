"""Extractors: image to features."""

import json
import pkgutil
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch

from ..descriptors import DIM
from ..utils.base_model import BaseModel, dynamic_load
from ..utils.hloc import is_installed
from ..utils.images import convert, read_image

# finds the keypoints of an image (H, W) float32 in [0, 1], as `utils.colmap.detect_dog`
Detect = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


class Extractor(BaseModel):
    """Maps an image to its local features.

    A subclass writes `_forward`: from `image` (1, C, H, W) float32 in [0, 1] to `keypoints`
    (1, N, 2) x, y in its pixels, centres at integers, `descriptors` (1, D, N) of unit norm, and
    perhaps `scores`, `scales` (pixels) and `oris` (degrees), all (1, N).

    Attributes:
        detection_noise: standard deviation of the keypoints in pixels.
        detect: finds the keypoints, where that can be done apart from describing them, in another
            process: pickled. What it returns is then `_forward`'s `detected`.
        dim: number of dimensions of the descriptors, as far as it is known beforehand.
    """

    required_inputs = ("image",)
    detection_noise = 1.0
    detect: Detect | None = None
    dim = DIM

    @property
    def descriptor(self) -> str:
        """The name that projections of these descriptors are kept under."""
        return type(self).__module__.rpartition(".")[2]

    @property
    def base(self) -> "Extractor":
        """The extractor whose features `reduce` makes these of; several may share it."""
        return self

    @property
    def detection(self) -> dict:
        """What determines the keypoints; extractors that agree in it share them."""
        return {**self.conf, "name": type(self).__module__}

    def reduce(self, features: dict) -> dict:
        """Return these features, made of those of `base`."""
        return features


def load(conf: dict) -> Extractor:
    """Make the extractor of a model configuration.

    Its `name` is that of a module of this package, else of one of an installed hloc's
    extractors. `hloc.dog` is hloc's where both have a `dog`.

    Raises:
        InputError: when there is no such extractor, or its configuration is wrong.
    """
    name = str(conf.get("name"))
    ours = [module.name for module in pkgutil.iter_modules(__path__)]
    if name not in ours and (is_installed() or name.startswith("hloc.")):
        return load({"name": "hloc", "conf": conf})
    return dynamic_load(sys.modules[__name__], name)(conf)


def load_image(image: Path | np.ndarray, preprocessing: dict) -> tuple[torch.Tensor, np.ndarray]:
    """Read an image and resize it to at most `resize_max` pixels on its longer side.

    With `resize_force` smaller ones get so many, too.

    Args:
        image: its file, or its pixels (H, W) or (H, W, 3) RGB, uint8.
        preprocessing: `grayscale`, `resize_max`, `resize_force` of a feature's configuration.

    Returns:
        The image (1, C, H, W) float32 in [0, 1], and its original (width, height).

    Raises:
        InputError: when it cannot be read.
    """
    grayscale = preprocessing.get("grayscale", False)
    image = (
        convert(image, grayscale) if isinstance(image, np.ndarray) else read_image(image, grayscale)
    )
    image = image.astype(np.float32)
    size = np.array(image.shape[1::-1])
    resize_max = preprocessing.get("resize_max")
    if resize_max and (size.max() > resize_max or preprocessing.get("resize_force")):
        # one pixel at least: a panorama may be a thousand times wider than high
        new_size = np.maximum(1, np.round(size * (resize_max / size.max())).astype(int))
        smaller = (new_size <= size).all()
        interpolation = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR  # as hloc
        image = cv2.resize(image, new_size.tolist(), interpolation=interpolation)
    image = np.atleast_3d(image).transpose(2, 0, 1) / 255
    return torch.from_numpy(np.ascontiguousarray(image))[None], size


def extract(
    model: Extractor, image: Path | np.ndarray, preprocessing: dict, device: str = "cpu"
) -> dict[str, np.ndarray]:
    """Extract the features of one image.

    Args:
        model: an extractor.
        image: as of `load_image`.
        preprocessing: as of `load_image`.
        device: of the model.

    Returns:
        keypoints (N, 2) float32 (x, y) in pixels of the original image, centres at integers;
        descriptors (D, N); scores, scales (pixels), oris (degrees) (N,), as far as the model has
        them; image_size (2,) width, height; and the uncertainty of the keypoints in pixels.
    """
    return extract_several([model], image, preprocessing, device)[0]


@torch.no_grad()
def extract_several(
    models: list[Extractor],
    image: Path | np.ndarray,
    preprocessing: dict,
    device: str = "cpu",
    detect: Detect | None = None,
) -> list[dict[str, np.ndarray]]:
    """Extract several features of one image; what they have in common is computed once.

    Args:
        models: extractors that agree in `detection`.
        image: as of `load_image`.
        preprocessing: as of `load_image`.
        device: of the models.
        detect: does what theirs does, elsewhere.

    Returns:
        Of each model what `extract` returns.
    """
    image, size = load_image(image, preprocessing)
    data = {"image": image.to(device)}
    detect = detect or (models[0].detect if len(models) > 1 else None)
    if detect is not None:
        data["detected"] = detect(image[0, 0].numpy())
    ratio = (size / np.array(image.shape[:1:-1])).astype(np.float32)
    described, extracted = {}, []
    for model in models:
        key = json.dumps(model.base.conf, sort_keys=True, default=str)
        if key not in described:
            described[key] = model.base(data)
        found = model.reduce(described[key])
        features = {key: value[0].cpu().numpy() for key, value in found.items()}
        features["keypoints"] = (features["keypoints"] + 0.5) * ratio - 0.5
        if "scales" in features:
            features["scales"] = features["scales"] * ratio.mean()
        features["image_size"] = size
        features["uncertainty"] = model.detection_noise * ratio.mean()
        extracted.append(features)
    return extracted
