"""Reduce the descriptors of a feature file that exists, without the photos.

For files of hloc, or of this project with a base such as colmap_sift, aliked or xfeat. Keypoints,
scores and all else are copied, so that pairs, matches and models made with the file stay valid with
the new one.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np

from . import logger, projections
from .confs import features as features_confs
from .descriptors import COLMAP
from .descriptors.normalization import NORMALIZATIONS, detect, to_colmap_sift
from .runtime import parallel
from .runtime.group_writer import Group, GroupWriter
from .utils import cli
from .utils.cli import InputError
from .utils.codes import STORAGES, store
from .utils.feature_files import get_descriptors, read_others
from .utils.h5 import file_provenance, list_h5_names, open_h5
from .utils.paths import strings_as_paths
from .utils.progress import progress

if TYPE_CHECKING:
    from .projections.network import Projection

SAMPLED = 20  # images whose descriptors tell how all are normalized
Described = tuple[str, np.ndarray, tuple[dict, dict]]  # name, (N, B), other arrays and attributes


@strings_as_paths
def main(
    features: Path,
    output: Path,
    feature: str,
    projection: Path | None = None,
    storage: str = STORAGES[0],
    normalization: str | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a feature file with projected descriptors; other data sets are copied.

    Args:
        features: feature file, with descriptors (B, N) of the base of `feature`.
        output: the new feature file. Images that it has already are skipped.
        feature: key of `confs.features`, such as colmap_sift_sv32, or a YAML file.
        projection: file of another projection of the same base.
        storage: of the new descriptors, one of `STORAGES`.
        normalization: of COLMAP's SIFT descriptors, one of `NORMALIZATIONS`; default: told by
            their numbers.
        overwrite: reduce all images again.

    Returns:
        `output`.

    Raises:
        InputError: when the input is missing or broken, has descriptors of another dimension, or
            both files are the same.
    """
    name, conf = features_confs.get(feature, projection, storage)
    levels = features_confs.levels(conf)
    if output.resolve() == features.resolve():
        raise InputError(f"{output} cannot be reduced to itself: choose another --output.")
    is_colmap = features_confs.descriptor_of(conf["model"]) == COLMAP
    if normalization is not None and not is_colmap:
        raise InputError(f"--normalization is for features of {COLMAP}; {name} is none.")
    names = list_h5_names(features)
    with open_h5(features) as file:
        if is_colmap:
            normalization = normalization or _normalization(file, names)
            cli.choose("normalization", normalization, NORMALIZATIONS)
        made_by = {
            "reduced": file_provenance(file),
            "feature": name,
            "storage": storage,
            "normalization": normalization,
        }
        if given := conf["model"].get("projection"):
            made_by["projection_sha256"] = projections.checksum(given)
        project, dim = _projection(name, conf)
        reduce = partial(_reduce, project, normalization, storage, levels)
        with GroupWriter(output, made_by, overwrite) as writer:
            todo = [image for image in names if image not in writer]
            groups = parallel.ordered("reduce", reduce, _read(file, todo, name, dim))
            for group in progress(groups, "Reducing features", "image", len(todo)):
                writer.add(*group)
    logger.info("%d images with %s, %s: %s", len(names), name, storage, output)
    return output


def _projection(name: str, conf: dict) -> tuple["Projection | None", int | None]:
    """Return the projection of a feature, if any, and the dimension of its base, if it is known."""
    if given := conf["model"].get("projection"):
        projection = projections.load(given)
        return projection, projection.sizes[0]
    return None, features_confs.dimension(name) if name in features_confs.confs else None


def _normalization(file: h5py.File, names: list[str]) -> str:
    """Tell how the descriptors of a file are normalized, by those of some images."""
    sampled = names[:: -(-len(names) // SAMPLED)]
    descriptors = [get_descriptors(file, name) for name in sampled]
    if len({part.shape[1] for part in descriptors}) != 1:
        raise InputError(f"{file.filename} has no descriptors, or they differ in size.")
    try:
        found = detect(np.concatenate(descriptors))
    except InputError as error:
        raise InputError(f"{file.filename}: {error}") from None
    logger.info("The descriptors of %s are normalized by %s.", file.filename, found)
    return found


def _read(file: h5py.File, names: list[str], feature: str, dim: int | None) -> Iterator[Described]:
    """Read the features of images."""
    for name in names:
        descriptors = get_descriptors(file, name)
        if dim not in (None, descriptors.shape[1]):
            raise InputError(
                f"{file.filename}: the descriptors of {name} are {descriptors.shape[1]}-D, "
                f"{feature} needs {dim}-D."
            )
        yield name, descriptors, read_others(file, name)


def _reduce(
    project: "Projection | None",
    normalization: str | None,
    storage: str,
    levels: np.ndarray | None,
    described: Described,
) -> Group:
    """Project the descriptors of an image."""
    name, descriptors, (arrays, attrs) = described
    if normalization is not None:
        descriptors = to_colmap_sift(descriptors, normalization)
    if project is not None:
        import torch

        with torch.no_grad():
            descriptors = project(torch.from_numpy(descriptors)).numpy()
    stored, own = store({"descriptors": descriptors.T}, storage, levels)
    return name, arrays | stored, attrs | own


def _main() -> None:
    parser = cli.Parser(
        __doc__,
        "--features feats-sift.h5 --feature colmap_sift_sv32 --storage uint4 --output small.h5",
    )
    parser.add_argument("--features", type=Path, required=True, help="feature file")
    parser.add_argument("--output", type=Path, required=True, help="the new feature file")
    parser.add_argument(
        "--feature",
        required=True,
        help="what to reduce to: colmap_sift_sv32 for SIFT of hloc or COLMAP, aliked_sv32 for "
        "hloc's aliked-n16, and others of pipelines.aachen --list_features",
    )
    parser.add_argument("--projection", type=Path, help="file of another projection of its base")
    features_confs.add_storage_option(parser)
    parser.add_argument(
        "--normalization",
        help=f"of SIFT descriptors, one of {', '.join(NORMALIZATIONS)}: COLMAP's names, and "
        "rootsift for hloc's (default: told by their numbers)",
    )
    parser.add_argument("--overwrite", action="store_true", help="reduce all images again")
    main(**vars(parser.parse_args()))


if __name__ == "__main__":
    cli.run(_main)
