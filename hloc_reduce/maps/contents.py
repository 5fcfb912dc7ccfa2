"""What a map holds in memory to localize one photo at a time, whether a folder or one file."""

from dataclasses import dataclass
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
        descriptors: of each image (N, D) float32; several images may share them.
        shown: of each image the rows of `descriptors` that show a point (M,).
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
    descriptors: dict[str, np.ndarray]
    shown: dict[str, np.ndarray]


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
    with open_h5(built.features) as file:
        coded = built.storage not in FLOATS
        descriptors = {n: read_descriptors(file, n).restore(unbiased=coded) for n in names}
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
        descriptors=descriptors,
        shown={name: np.flatnonzero(reference.point_rows(name) >= 0) for name in names},
    )


def _of_file(path: Path) -> Contents:
    compact = CompactMap(path)
    with TemporaryDirectory() as folder:
        extractor = extractors.load(compact.write_projection(Path(folder))["model"])
    descriptors = compact.descriptors(unbiased=compact.storage not in FLOATS)
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
        descriptors=dict.fromkeys(compact.names, descriptors),
        shown=compact.visible,
    )
