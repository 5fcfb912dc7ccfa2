"""Convert how a feature file keeps descriptors: as floats, or in one byte a number.

hloc reads float16 and float32. uint8 takes half the space of float16: the range of the numbers of
each image is divided into 255 steps. Its data set is called `descriptors_uint8`, so that hloc,
which would take the steps for numbers, misses it and says so.
"""

import argparse
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np

from . import cli, io, logger
from .cli import InputError
from .group_writer import GroupWriter
from .io import get_array, get_dataset, iterate_h5_names, list_h5_names, open_h5, reading
from .paths import strings_as_paths
from .progress import progress

STORAGES = ("float16", "float32", "uint8")  # hloc's `as_half`, without it, and ours
QUANTIZED = "descriptors_uint8"
STEPS = 255


def store(
    features: dict[str, np.ndarray], storage: str
) -> tuple[dict[str, np.ndarray], dict[str, dict]]:
    """Return the features of an image as a file keeps them.

    Args:
        features: arrays of floats or integers, with `descriptors` (D, N).
        storage: one of `STORAGES`, of all floats but the keypoints; with uint8 those that are not
            descriptors are float16.

    Returns:
        The arrays, with `descriptors_uint8` in place of `descriptors` if they are quantized; and
        from the name of an array to its attributes: `scale` and `offset` of these.
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
    """Round descriptors to 256 levels between the least and the greatest number.

    Returns:
        Levels, uint8 of the same shape; scale and offset: descriptors are offset + scale * level.
    """
    if not descriptors.size:
        return descriptors.astype(np.uint8), 1.0, 0.0
    offset = float(descriptors.min())
    scale = (float(descriptors.max()) - offset) / STEPS or 1.0
    levels = np.round((descriptors.astype(np.float32) - offset) / scale)
    return levels.clip(0, STEPS).astype(np.uint8), scale, offset


def restore(stored: dict[str, np.ndarray], attrs: dict[str, dict]) -> np.ndarray:
    """Return the descriptors (N, D) float32 of what `store` returned, one row each.

    Quantized ones have unit norm again.
    """
    if QUANTIZED not in stored:
        return np.ascontiguousarray(stored["descriptors"].T, np.float32)
    scale, offset = (np.float32(attrs[QUANTIZED][key]) for key in ("scale", "offset"))
    descriptors = np.ascontiguousarray(stored[QUANTIZED].T, np.float32) * scale + offset
    norm = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return descriptors / np.maximum(norm, np.finfo(np.float32).tiny)


def stored_descriptors(file: h5py.File, name: str) -> h5py.Dataset:
    """Return the data set of the descriptors (D, N) of an image, floats or quantized.

    Raises:
        InputError: when the image is not there or has none, or not as many as keypoints.
    """
    with reading(file.filename):
        key = QUANTIZED if f"{name}/{QUANTIZED}" in file else "descriptors"
        dataset, keypoints = get_dataset(file, name, key), file[name].get("keypoints")
        shapes = [getattr(part, "shape", None) for part in (dataset, keypoints)]
    if all(shapes) and shapes[0][-1] != shapes[1][0]:
        raise InputError(
            f"{file.filename}: the descriptors of {name} are {shapes[0]}, its keypoints "
            f"{shapes[1]}: they are to be (D, N) and (N, 2)."
        )
    return dataset


def dimension(features: Path) -> int:
    """Return the dimension of the descriptors of a feature file, 0 if no image has sound ones."""
    with open_h5(features) as file:
        for name in iterate_h5_names(file.id):
            with suppress(InputError):
                shape = stored_descriptors(file, name).shape
                if len(shape) == 2:
                    return shape[0]
    return 0


def get_descriptors(file: h5py.File, name: str) -> np.ndarray:
    """Read the descriptors (N, D) float32 of an image, one row each.

    Raises:
        InputError: when the image is not there, or has none, or broken ones.
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


@strings_as_paths
def main(features: Path, output: Path, storage: str = "float16", overwrite: bool = False) -> Path:
    """Write a feature file with descriptors kept in another way; other data sets are copied.

    Args:
        features: feature file.
        output: the new one; images it holds already are skipped.
        storage: one of `STORAGES`.
        overwrite: convert anew what is there.

    Returns:
        The new file.

    Raises:
        InputError: when an input is missing or broken, the storage unknown, or the files the same.
    """
    cli.choose("storage", storage, STORAGES)
    if output.resolve() == features.resolve():
        raise InputError(f"{output} cannot be made of itself: choose another --output.")
    names = list_h5_names(features)
    with open_h5(features) as file:
        made_by = {"converted": io.provenance(file), "storage": storage}
        with GroupWriter(output, made_by, overwrite) as writer:
            todo = [name for name in names if name not in writer]
            for name in progress(todo, "Converting features", "image"):
                datasets = {
                    key: dataset
                    for key, dataset in file[name].items()
                    if isinstance(dataset, h5py.Dataset) and key != QUANTIZED
                    if dataset.shape is not None  # as of an empty one, which holds nothing
                }
                arrays = {key: np.asarray(d[()], d.dtype) for key, d in datasets.items()}
                attrs = {key: dict(dataset.attrs) for key, dataset in datasets.items()}
                if storage == "uint8" and QUANTIZED in file[name]:
                    file_attrs = dict(file[name][QUANTIZED].attrs)
                    stored, own = {QUANTIZED: file[name][QUANTIZED][()]}, {QUANTIZED: file_attrs}
                else:
                    stored, own = store({"descriptors": get_descriptors(file, name).T}, storage)
                arrays.pop("descriptors", None)
                writer.add(name, arrays | stored, attrs | own)
    logger.info("%d images, descriptors as %s: %s", len(names), storage, output)
    return output


def _main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python -m hloc_reduce.storage --features feats-dog-sift_sv16.h5 "
        "--output for_hloc.h5",
        formatter_class=cli.HelpFormatter,
    )
    parser.add_argument("--features", type=Path, required=True, help="feature file")
    parser.add_argument("--output", type=Path, required=True, help="the new feature file")
    parser.add_argument("--storage", default="float16", help=f"one of {', '.join(STORAGES)}")
    parser.add_argument("--overwrite", action="store_true", help="convert anew what is there")
    main(**vars(parser.parse_args()))


if __name__ == "__main__":
    cli.run(_main)
