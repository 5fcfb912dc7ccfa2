"""Feature files in hloc's format."""

import json
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from .cli import InputError
from .codes import CODED, QUANTIZED, restore
from .h5 import get_array, get_dataset, get_text, iterate_h5_names, open_h5, reading
from .images import Frame, turned


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


def get_blur(file: h5py.File, name: str) -> float:
    """Read the blur in pixels that reduced the noise of an image; files of hloc have none."""
    with reading(file.filename):
        blur = get_dataset(file, name, "keypoints").attrs.get("blur", 0.0)
    return float(blur) if isinstance(blur, int | float | np.number) else 0.0


def get_turns(file: h5py.File, name: str) -> int:
    """Read the quarter turns, counterclockwise, by which an extractor saw an image; default: 0."""
    with reading(file.filename):
        turns = get_dataset(file, name, "keypoints").attrs.get("turns", 0)
    return int(turns) % 4 if isinstance(turns, int | np.integer) else 0


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


def stored_descriptors(file: h5py.File, name: str) -> h5py.Dataset:
    """Return the data set of an image's descriptors (D, N), floats or quantized.

    Raises:
        InputError: when it is missing, or their number is not that of the keypoints.
    """
    with reading(file.filename):
        keys = (key for key in QUANTIZED.values() if f"{name}/{key}" in file)
        key = next(keys, "descriptors")
        dataset, keypoints = get_dataset(file, name, key), file[name].get("keypoints")
        shape, others = dataset.shape, getattr(keypoints, "shape", None)
    if shape and others and shape[-1] != others[0]:
        raise InputError(
            f"{file.filename}: the descriptors of {name} are {shape}, its keypoints {others}: "
            "(D, N) and (N, 2) are expected."
        )
    return dataset


def read_others(file: h5py.File, name: str) -> tuple[dict[str, np.ndarray], dict[str, dict]]:
    """Read all arrays of an image but its descriptors, their attributes, and its own ("")."""
    with reading(file.filename):
        datasets = {
            key: dataset
            for key, dataset in file[name].items()
            if isinstance(dataset, h5py.Dataset) and dataset.shape is not None
        }
        for key in ("descriptors", *QUANTIZED.values()):
            datasets.pop(key, None)
        arrays = {key: np.asarray(d[()], d.dtype) for key, d in datasets.items()}
        attrs = {key: dict(dataset.attrs) for key, dataset in datasets.items()}
        return arrays, attrs | {"": {key: get_text(file[name], key) for key in file[name].attrs}}


def dimension(features: Path) -> int:
    """Return the dimension of the descriptors in a feature file, 0 if no image has valid ones."""
    with open_h5(features) as file:
        for name in iterate_h5_names(file.id):
            with suppress(InputError):
                dataset = stored_descriptors(file, name)
                if len(dataset.shape) == 2:
                    return len(dataset.attrs.get("levels", range(dataset.shape[0])))
    return 0


def coded_by(file: h5py.File) -> str | None:
    """Return the checksum of the projection whose levels the codes of a file are of, if known."""
    first = first_descriptors(file)
    if first is None or first.key.rpartition("_")[2] not in CODED:
        return None
    try:
        return dict(json.loads(get_text(file, "conf", "{}"))).get("projection_sha256")
    except (TypeError, ValueError):  # a file of others
        return None


@dataclass(frozen=True)
class StoredDescriptors:
    """The descriptors of an image as a file stores them.

    Args:
        place: file and image, for messages.
        key: name of their data set.
        array: (D, N) floats or steps, or packed codes.
        attrs: attributes of the data set.
    """

    place: str
    key: str
    array: np.ndarray
    attrs: dict

    @property
    def is_float(self) -> bool:
        """Whether they are floats."""
        return self.key not in QUANTIZED.values()

    @property
    def dim(self) -> int:
        """Numbers of a descriptor."""
        return len(self.attrs.get("levels", self.array))

    def restore(self, unbiased: bool = False) -> np.ndarray:
        """Return them as (N, D) float32, see `codes.restore`.

        Raises:
            InputError: if they are broken.
        """
        try:
            return restore({self.key: self.array}, {self.key: self.attrs}, unbiased)
        except KeyError as error:
            raise InputError(f"{self.place}: its {self.key} have no {error.args[0]}.") from None
        except (TypeError, ValueError) as error:
            raise InputError(f"{self.place}: its {self.key} have {error}.") from None


class Levels:
    """Checks that codes that are compared have the same levels.

    Args:
        known: levels (D, 2**bits) by the name of the data set, with what has them; those of other
            data sets are taken from the first image.
    """

    def __init__(self, known: Mapping[str, tuple[np.ndarray, str]] | None = None):
        self._known = dict(known or {})

    def check(self, stored: StoredDescriptors) -> None:
        """Raise an InputError for codes with other levels: they are of another projection."""
        levels = stored.attrs.get("levels")
        if levels is None:
            return
        known, first = self._known.setdefault(stored.key, (levels, stored.place))
        if not np.array_equal(known, levels):
            raise InputError(
                f"The codes of {stored.place} have other levels than those of {first}: they are "
                "of different projections."
            )


def read_descriptors(file: h5py.File, name: str) -> StoredDescriptors:
    """Read the descriptors of an image; raise an InputError if they are missing or broken."""
    dataset = stored_descriptors(file, name)
    key = dataset.name.rpartition("/")[2]
    array = get_array(file, name, key, (0, 0))
    with reading(file.filename):
        attrs = dict(dataset.attrs)
    return StoredDescriptors(f"{name} in {file.filename}", key, array, attrs)


def first_descriptors(file: h5py.File) -> StoredDescriptors | None:
    """Read the descriptors of the first image that has sound ones, None if there is none."""
    for name in iterate_h5_names(file.id):
        with suppress(InputError):
            return read_descriptors(file, name)
    return None


def get_descriptors(file: h5py.File, name: str) -> np.ndarray:
    """Read the descriptors (N, D) float32 of an image.

    Raises:
        InputError: when they are missing or broken.
    """
    return read_descriptors(file, name).restore()


def upright(features: Mapping[str, np.ndarray], turns: int) -> dict[str, np.ndarray]:
    """Return features as an extractor saw them, which learned matchers need.

    Args:
        features: hloc's dictionary, or a part of it; of photos with turns `image_size`, too.
        turns: quarter turns, counterclockwise, by which the photo was shown to the extractor.
    """
    if not turns or "image_size" not in features:
        return {**features}
    frame = Frame(features["image_size"], turns)
    found = {**features, "image_size": frame.shown.copy()}
    if "keypoints" in features:
        found["keypoints"] = turned(features["keypoints"], frame.size, turns)
    return found


def get_features(file: h5py.File, name: str, keys: Iterable[str]) -> dict[str, np.ndarray]:
    """Read some of hloc's dictionary of the features of an image, as float32.

    Args:
        file: an open feature file.
        name: of the image.
        keys: such as `descriptors` (D, N), `keypoints` (N, 2), `scores`, `scales`, `oris` (N,) and
            `image_size` (2,). With the last one, keypoints are `upright`.

    Raises:
        InputError: when one is missing or broken.
    """
    found: dict[str, np.ndarray] = {}
    for key in keys:
        if key == "descriptors":
            found[key] = get_descriptors(file, name).T
        elif key == "keypoints":
            found[key] = get_keypoints(file, name)[0].astype(np.float32)
        else:
            found[key] = get_array(file, name, key, (0,)).astype(np.float32)
    return upright(found, get_turns(file, name) if "image_size" in found else 0)
