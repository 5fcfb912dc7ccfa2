"""Convert the storage of the descriptors of a feature file: float16, float32 or uint8.

hloc reads float16 and float32. uint8 takes half the space of float16: the range of the numbers of
each image is divided into 255 steps. Its data set is `descriptors_uint8`, so that hloc reports
missing descriptors instead of reading steps as numbers.
"""

import argparse
from pathlib import Path

import h5py
import numpy as np

from . import logger
from .runtime.group_writer import GroupWriter
from .utils import cli
from .utils.cli import InputError
from .utils.feature_files import QUANTIZED, STORAGES, get_descriptors, store
from .utils.h5 import file_provenance, list_h5_names, open_h5
from .utils.paths import strings_as_paths
from .utils.progress import progress


@strings_as_paths
def main(features: Path, output: Path, storage: str = "float16", overwrite: bool = False) -> Path:
    """Write a feature file with another storage of descriptors; other data sets are copied.

    Args:
        features: feature file.
        output: the new feature file. Images that it has already are skipped.
        storage: one of `STORAGES`.
        overwrite: convert all images again.

    Returns:
        `output`.

    Raises:
        InputError: when the input is missing or broken, the storage is unknown, or both files are
            the same.
    """
    cli.choose("storage", storage, STORAGES)
    if output.resolve() == features.resolve():
        raise InputError(f"{output} cannot be converted to itself: choose another --output.")
    names = list_h5_names(features)
    with open_h5(features) as file:
        made_by = {"converted": file_provenance(file), "storage": storage}
        with GroupWriter(output, made_by, overwrite) as writer:
            todo = [name for name in names if name not in writer]
            for name in progress(todo, "Converting features", "image"):
                datasets = {
                    key: dataset
                    for key, dataset in file[name].items()
                    if isinstance(dataset, h5py.Dataset) and dataset.shape is not None
                }
                arrays = {key: np.asarray(d[()], d.dtype) for key, d in datasets.items()}
                attrs = {key: dict(dataset.attrs) for key, dataset in datasets.items()}
                if storage != "uint8" or QUANTIZED not in arrays:
                    stored, own = store({"descriptors": get_descriptors(file, name).T}, storage)
                    arrays, attrs = arrays | stored, attrs | own
                arrays.pop("descriptors" if storage == "uint8" else QUANTIZED, None)
                writer.add(name, arrays, attrs)
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
    parser.add_argument("--overwrite", action="store_true", help="convert all images again")
    main(**vars(parser.parse_args()))


if __name__ == "__main__":
    cli.run(_main)
