"""Feature files in hloc's format, and how they store descriptors."""

from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np

from .cli import InputError
from .h5 import get_array, get_dataset, iterate_h5_names, open_h5, reading


def get_keypoints(file: h5py.File, name: str) -> tuple[np.ndarray, float]:
    """Read keypoints (N, 2) float64, pixel centres at integers, and their uncertainty in pixels."""
    keypoints = get_array(file, name, "keypoints", (0, 2))[:, :2].astype(np.float64)
    with reading(file.filename):
        stored = get_dataset(file, name, "keypoints").attrs.get("uncertainty", 1.0)
    try:
        uncertainty = float(stored)
    except (TypeError, ValueError):
        uncertainty = np.nan
    if not 0 < uncertainty < np.inf:
        raise InputError(f"{file.filename}: the uncertainty of {name} is {stored!r}.")
    return keypoints, uncertainty


def get_image_size(file: h5py.File, name: str) -> tuple[int, int]:
    """Read the width and height of an image in an open feature file."""
    width, height = map(int, get_array(file, name, "image_size", (2,))[:2])
    if min(width, height) < 1:
        raise InputError(f"{file.filename}: the image_size of {name} is {width}x{height}.")
    return width, height


def get_colmap_keypoints(file: h5py.File, name: str) -> tuple[np.ndarray, float]:
    """Read keypoints with COLMAP's pixel origin, and their uncertainty; see `get_keypoints`."""
    keypoints, uncertainty = get_keypoints(file, name)
    return to_colmap(keypoints), uncertainty


def to_colmap(keypoints: np.ndarray) -> np.ndarray:
    """Move keypoints (N, 2) with pixel centres at integers to COLMAP's pixel origin, the corner.

    This is the only place where the half pixel is added.
    """
    return keypoints.astype(np.float64) + 0.5


STORAGES = ("float16", "float32", "uint8")  # hloc has the first two, as `as_half`
QUANTIZED = "descriptors_uint8"
STEPS = 255


def store(
    features: dict[str, np.ndarray], storage: str
) -> tuple[dict[str, np.ndarray], dict[str, dict]]:
    """Convert the features of an image to what a file stores.

    Args:
        features: arrays of floats or integers, with `descriptors` (D, N).
        storage: one of `STORAGES`. Keypoints stay float32; with uint8, floats that are not
            descriptors become float16.

    Returns:
        The arrays, with `descriptors_uint8` instead of quantized `descriptors`, and the attributes
        of each array: `scale` and `offset` of quantized descriptors.
    """
    floats = np.float32 if storage == "float32" else np.float16
    stored = {
        key: array.astype(floats) if key != "keypoints" and array.dtype.kind == "f" else array
        for key, array in features.items()
    }
    if storage != "uint8":
        return stored, {}
    del stored["descriptors"]
    quantized, scale, offset = quantize(features["descriptors"])
    return stored | {QUANTIZED: quantized}, {QUANTIZED: {"scale": scale, "offset": offset}}


def quantize(descriptors: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Round descriptors to 256 levels between their minimum and maximum.

    Returns:
        Levels (uint8, same shape), scale and offset: descriptors are offset + scale * level.
    """
    if not descriptors.size:
        return descriptors.astype(np.uint8), 1.0, 0.0
    offset = float(descriptors.min())
    scale = (float(descriptors.max()) - offset) / STEPS or 1.0
    levels = np.round((descriptors.astype(np.float32) - offset) / scale)
    return levels.clip(0, STEPS).astype(np.uint8), scale, offset


def restore(stored: dict[str, np.ndarray], attrs: dict[str, dict]) -> np.ndarray:
    """Return descriptors (N, D) float32 from what `store` returned.

    Quantized descriptors are normalized.
    """
    if QUANTIZED not in stored:
        return np.ascontiguousarray(stored["descriptors"].T, np.float32)
    scale, offset = (np.float32(attrs[QUANTIZED][key]) for key in ("scale", "offset"))
    descriptors = np.ascontiguousarray(stored[QUANTIZED].T, np.float32) * scale + offset
    norm = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return descriptors / np.maximum(norm, np.finfo(np.float32).tiny)


def stored_descriptors(file: h5py.File, name: str) -> h5py.Dataset:
    """Return the data set of an image's descriptors (D, N), floats or quantized.

    Raises:
        InputError: when it is missing, or their number is not that of the keypoints.
    """
    with reading(file.filename):
        key = QUANTIZED if f"{name}/{QUANTIZED}" in file else "descriptors"
        dataset, keypoints = get_dataset(file, name, key), file[name].get("keypoints")
        shape, others = dataset.shape, getattr(keypoints, "shape", None)
    if shape and others and shape[-1] != others[0]:
        raise InputError(
            f"{file.filename}: the descriptors of {name} are {shape}, its keypoints {others}: "
            "(D, N) and (N, 2) are expected."
        )
    return dataset


def dimension(features: Path) -> int:
    """Return the dimension of the descriptors in a feature file, 0 if no image has valid ones."""
    with open_h5(features) as file:
        for name in iterate_h5_names(file.id):
            with suppress(InputError):
                shape = stored_descriptors(file, name).shape
                if len(shape) == 2:
                    return shape[0]
    return 0


def get_descriptors(file: h5py.File, name: str) -> np.ndarray:
    """Read the descriptors (N, D) float32 of an image.

    Raises:
        InputError: when they are missing or broken.
    """
    dataset = stored_descriptors(file, name)
    key = dataset.name.rpartition("/")[2]
    array = get_array(file, name, key, (0, 0))
    try:
        with reading(file.filename):
            attrs = dict(dataset.attrs)
        return restore({key: array}, {key: attrs})
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{file.filename}: {name} has no scale and offset.") from None
