"""What a map holds in memory to localize one photo at a time, whether a folder or one file."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from .. import extractors
from ..aggregators.vlad import read_vocabulary
from ..confs import matchers as matchers_confs
from ..extractors import Extractor
from ..localization import intrinsics
from ..localization.references import Reference, SfmMap
from ..pairs_from_retrieval import read_global
from ..utils import colmap
from ..utils.codes import FLOATS
from ..utils.feature_files import dimension, read_descriptors
from ..utils.h5 import open_h5
from .compact import CompactMap, is_compact
from .map import Map


@dataclass(frozen=True)
class Contents:
    """A map in memory.

    Args:
        extractor: of its feature.
        preprocessing: of photos.
        storage: of its descriptors.
        dim: of its descriptors.
        matcher: configuration of the matcher's model.
        cameras: what it tells about the intrinsics of other photos.
        vocabulary: (W, D) float32, of global descriptors.
        reference: its points.
        names: its images.
        global_descriptors: (I, G) float32 of the images.
        describe: returns the descriptors (N, D) float32 of an image.
        shown: of each image the rows of these that show a point (M,).
        on_demand: do not keep the descriptors of images in memory.
    """

    extractor: Extractor
    preprocessing: dict
    storage: str
    dim: int
    matcher: dict
    cameras: intrinsics.MapCameras
    vocabulary: torch.Tensor
    reference: Reference
    names: list[str]
    global_descriptors: np.ndarray
    describe: Callable[[str], np.ndarray]
    shown: dict[str, np.ndarray]
    on_demand: bool = False


def read(path: Path) -> Contents:
    """Read a map.

    Args:
        path: folder of a map of `maps.main`, or file of `hloc_reduce.compact`.

    Raises:
        InputError: if it is neither, or broken.
    """
    return _of_file(path) if is_compact(path) else _of_folder(path)


def _of_folder(path: Path) -> Contents:
    built = Map(path)
    reference = SfmMap(colmap.read_model(built.sfm))
    names = sorted(reference.images)

    def describe(name: str) -> np.ndarray:
        with open_h5(built.features) as file:
            return read_descriptors(file, name).restore(unbiased=built.storage not in FLOATS)

    return Contents(
        extractor=extractors.load(built.conf["model"]),
        preprocessing=built.conf["preprocessing"],
        storage=built.storage,
        dim=dimension(built.features),
        matcher=matchers_confs.confs[built.matcher]["model"],
        cameras=built.cameras,
        vocabulary=read_vocabulary(built.vocabulary),
        reference=reference,
        names=names,
        global_descriptors=read_global(built.descriptors, names),
        describe=describe,
        shown={name: np.flatnonzero(reference.point_rows(name) >= 0) for name in names},
    )


def _of_file(path: Path) -> Contents:
    compact = CompactMap(path)
    with TemporaryDirectory() as folder:
        extractor = extractors.load(compact.write_projection(Path(folder))["model"])
    return Contents(
        extractor=extractor,
        preprocessing=compact.conf["preprocessing"],
        storage=compact.storage,
        dim=compact.dim,
        matcher=matchers_confs.confs[compact.matcher]["model"],
        cameras=compact.cameras,
        vocabulary=compact.vocabulary,
        reference=compact,
        names=compact.names,
        global_descriptors=compact.global_descriptors,
        describe=partial(compact.descriptors, unbiased=compact.storage not in FLOATS),
        shown={name: np.arange(len(rows)) for name, rows in compact.visible.items()},
        on_demand=True,
    )
