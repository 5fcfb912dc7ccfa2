"""Convert how a feature file stores descriptors.

hloc reads only float16 and float32. uint8 takes half the space of float16: the range of the numbers
of each image is divided into 255 steps. uint4, uint2 and uint1 keep 4, 2 and 1 bits of a number:
the index of one of the levels in the file of the projection. All but floats are in data sets such
as `descriptors_uint8`, so that hloc reports missing descriptors instead of reading steps as
numbers. What rounding has lost stays lost when descriptors are converted back to floats.
"""

from contextlib import suppress
from pathlib import Path
from typing import Annotated

import numpy as np

from . import logger, projections
from .runtime.group_writer import GroupWriter
from .utils import cli, options
from .utils.cli import InputError
from .utils.codes import CODED, QUANTIZED, STORAGES, store
from .utils.feature_files import Levels, read_descriptors, read_others
from .utils.h5 import file_provenance, list_h5_names, open_h5
from .utils.options import Option
from .utils.paths import strings_as_paths
from .utils.progress import progress


@strings_as_paths
def main(
    features: Path,
    output: Path,
    storage: Annotated[str, Option("storage", STORAGES)] = "float16",
    overwrite: bool = False,
    projection: str | Path | None = None,
) -> Path:
    """Write a feature file with another storage of descriptors; other data sets are copied.

    Args:
        features: feature file.
        output: the new feature file. Images that it has already are skipped.
        storage: the new storage.
        overwrite: convert all images again.
        projection: projection of the features, by name or file; for uint4, uint2 and uint1, which
            need its levels, see hloc_reduce.training.levels.

    Returns:
        `output`.

    Raises:
        InputError: when the input is missing or broken, the storage is unknown, needs a
            projection or needs none, or both files are the same.
    """
    cli.choose("storage", storage, STORAGES)
    if storage in CODED and projection is None:
        raise InputError(f"--storage {storage} needs --projection, the one of the features.")
    if storage not in CODED and projection is not None:
        raise InputError(f"--storage {storage} needs no --projection: leave it out.")
    levels = None if projection is None else projections.levels(projection, storage)
    if output.resolve() == features.resolve():
        raise InputError(f"{output} cannot be converted to itself: choose another --output.")
    names = list_h5_names(features)
    known = None if projection is None else Levels(_levels(projection))
    with open_h5(features) as file:
        made_from = {"converted": file_provenance(file), "storage": storage}
        if projection is not None:
            made_from["projection_sha256"] = projections.checksum(projection)
        with GroupWriter(output, made_from, overwrite) as writer:
            todo = [name for name in names if name not in writer]
            for name in progress(todo, "Converting features", "image"):
                arrays, attrs = read_others(file, name)
                found = read_descriptors(file, name)
                descriptors = found.restore().T  # which checks them
                if known is not None:
                    known.check(found)
                if QUANTIZED.get(storage) == found.key:
                    stored, own = {found.key: found.array}, {found.key: found.attrs}
                else:
                    if levels is not None and len(levels) != len(descriptors):
                        raise InputError(
                            f"{features}: the descriptors of {name} are {len(descriptors)}-D, "
                            f"those of {projection} are {len(levels)}-D."
                        )
                    stored, own = store({"descriptors": descriptors}, storage, levels)
                writer.add(name, arrays | stored, attrs | own)
    logger.info("%d images, descriptors as %s: %s", len(names), storage, output)
    return output


def _levels(projection: str | Path) -> dict[str, tuple[np.ndarray, str]]:
    """Return the levels of a projection as `Levels` takes them, of all storages that it has."""
    found = {}
    for storage in CODED:
        with suppress(InputError):
            levels = projections.levels(projection, storage).astype(np.float16)
            found[QUANTIZED[storage]] = levels, Path(projection).name
    return found


def _main() -> None:
    options.call(main, __doc__, "--features feats-dog-sift_sv16.h5 --output for_hloc.h5")


if __name__ == "__main__":
    cli.run(_main)
