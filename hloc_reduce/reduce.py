"""Reduce the descriptors of a feature file that exists, without the photos.

For files of hloc, or of this project with a base such as colmap_sift, aliked or xfeat. Keypoints,
scores and all else are copied, so that pairs, matches and models made with the file stay valid with
the new one.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np

from . import logger, projections
from .confs import features as features_confs
from .descriptors import COLMAP_SIFT
from .descriptors.normalization import NORMALIZATIONS, Normalization, detect, to_colmap_sift
from .runtime import parallel
from .runtime.group_writer import Group, GroupWriter
from .utils import cli, options
from .utils.cli import InputError
from .utils.codes import STORAGES, Storage, store
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
    storage: Storage = STORAGES[0],
    normalization: Normalization | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a feature file with projected descriptors; other data sets are copied.

    Args:
        features: feature file, with descriptors (B, N) of the base of `feature`.
        output: the new feature file. Images that it has already are skipped.
        feature: target feature: colmap_sift_sv32 for SIFT of hloc or COLMAP, aliked_sv32 for hloc's
            aliked-n16, and others of pipelines.aachen --list_features, or a YAML file.
        projection: file of another projection of its base.
        storage: storage of descriptors.
        normalization: normalization of SIFT descriptors; default: detected.
        overwrite: write all images again.

    Returns:
        `output`.

    Raises:
        InputError: when the input is missing or broken, has descriptors of another dimension, or
            both files are the same.
    """
    reduction = Reduction(feature, projection, storage)
    name = reduction.name
    if output.resolve() == features.resolve():
        raise InputError(f"{output} cannot be reduced to itself: choose another --output.")
    if normalization is not None and not reduction.of_colmap:
        raise InputError(f"--normalization is for features of {COLMAP_SIFT}; {name} is none.")
    names = list_h5_names(features)
    with open_h5(features) as file:
        if reduction.of_colmap:
            normalization = normalization or _normalization(file, names)
            cli.choose("normalization", normalization, NORMALIZATIONS)
        made_from = {
            "reduced": file_provenance(file),
            "normalization": normalization,
            **reduction.provenance,
        }
        read = partial(_read, file, reduction)
        reduction.write(output, made_from, overwrite, names, read, normalization)
    logger.info("%d images with %s, %s: %s", len(names), name, storage, output)
    return output


class Reduction:
    """Converts base descriptors to those of a feature.

    Args:
        feature: name of a feature, or its YAML file.
        projection: projection file to use with the base descriptor of `feature`.
        storage: how descriptors are stored, one of `utils.codes.STORAGES`.

    Attributes:
        name: of the feature.
        conf: its configuration.
        of_colmap: whether its base is COLMAP's SIFT.

    Raises:
        InputError: for an unknown feature, or a projection that is broken or has no levels.
    """

    def __init__(self, feature: str, projection: Path | None = None, storage: str = STORAGES[0]):
        self.name, self.conf = features_confs.get(feature, projection, storage)
        self.of_colmap = features_confs.descriptor_of(self.conf["model"]) == COLMAP_SIFT
        self._storage, self._levels = storage, features_confs.levels(self.conf)
        self._project: Projection | None = None
        self._dim = None
        if given := self.conf["model"].get("projection"):
            self._project = projections.load(given)
            self._dim = self._project.sizes[0]
        elif self.name in features_confs.confs:
            self._dim = features_confs.dimension(self.name)

    @property
    def provenance(self) -> dict:
        """What determines the descriptors, besides those of the base."""
        made_from = {"feature": self.name, "storage": self._storage}
        if given := self.conf["model"].get("projection"):
            made_from["projection_sha256"] = projections.checksum(given)
        return made_from

    def check(self, dim: int, place: str) -> None:
        """Raise an InputError if the descriptors of a place are not as long as the base's."""
        if self._dim not in (None, dim):
            raise InputError(f"{place} are {dim}-D, {self.name} needs {self._dim}-D.")

    def reduce(self, normalization: str | None, described: Described) -> Group:
        """Project the descriptors of an image, and return its group.

        Args:
            normalization: of COLMAP's SIFT descriptors, a key of `NORMALIZATIONS`; None of others.
            described: of the image.
        """
        name, descriptors, (arrays, attrs) = described
        if normalization is not None:
            descriptors = to_colmap_sift(descriptors, normalization)
        if self._project is not None:
            import torch

            with torch.no_grad():
                descriptors = self._project(torch.from_numpy(descriptors)).numpy()
        stored, own = store({"descriptors": descriptors.T}, self._storage, self._levels)
        return name, arrays | stored, attrs | own

    def write(
        self,
        output: Path,
        made_from: dict,
        overwrite: bool,
        names: list[str],
        read: Callable[[list[str]], Iterable[Described]],
        normalization: str | None,
    ) -> None:
        """Write the reduced descriptors of those images that a feature file lacks.

        Args:
            output: the feature file.
            made_from: its provenance.
            overwrite: reduce all images again.
            names: the images.
            read: reads images.
            normalization: as in `reduce`.
        """
        reduce = partial(self.reduce, normalization)
        with GroupWriter(output, made_from, overwrite) as writer:
            todo = [name for name in names if name not in writer]
            with closing(parallel.ordered("reduce", reduce, read(todo))) as groups:
                for group in progress(groups, "Reducing features", "image", len(todo)):
                    writer.add(*group)


def _normalization(file: h5py.File, names: list[str]) -> str:
    """Tell how the descriptors of a file are normalized, by those of some images."""
    descriptors = [get_descriptors(file, name) for name in sampled(names)]
    if len({part.shape[1] for part in descriptors}) != 1:
        raise InputError(f"{file.filename} has no descriptors, or they differ in size.")
    return told_by(np.concatenate(descriptors), file.filename)


def sampled(names: list[str]) -> list[str]:
    """Return an even share of images, whose descriptors tell how all are normalized."""
    return names[:: max(1, -(-len(names) // SAMPLED))]


def told_by(descriptors: np.ndarray, place: str) -> str:
    """Detect how SIFT descriptors are normalized, and log it.

    Args:
        descriptors: (N, 128) of many keypoints.
        place: name of the file.

    Raises:
        InputError: see `normalization.detect`.
    """
    try:
        found = detect(descriptors)
    except InputError as error:
        raise InputError(f"{place}: {error}") from None
    logger.info("The descriptors of %s are normalized by %s.", place, found)
    return found


def _read(file: h5py.File, reduction: Reduction, names: list[str]) -> Iterator[Described]:
    """Read the features of images."""
    of_network = features_confs.network_of(reduction.conf["model"]) is not None
    for name in names:
        descriptors = get_descriptors(file, name)
        reduction.check(descriptors.shape[1], f"{file.filename}: the descriptors of {name}")
        if of_network and len(descriptors) and (descriptors >= 0).all():
            raise InputError(
                f"{file.filename}: the descriptors of {name} have no negative number, like those "
                f"of SIFT. {reduction.name} needs those of its network."
            )
        yield name, descriptors, read_others(file, name)


def _main() -> None:
    example = "--features feats.h5 --feature colmap_sift_sv32 --storage uint4 --output small.h5"
    options.call(main, __doc__, example)


if __name__ == "__main__":
    cli.run(_main)
