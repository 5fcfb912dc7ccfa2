"""A map in memory, read from a folder or a compact file."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Protocol

import numpy as np

from ..confs import features as features_confs
from ..confs import matchers as matchers_confs
from ..confs import retrieval as retrieval_confs
from ..hlm.reader import CompactMap, check_feature_keys, is_compact
from ..localization import intrinsics
from ..localization.references import Reference, SfmMap
from ..retrieval import load as load_retrieval
from ..retrieval.ranking import read_global, similarity
from ..retrieval.vlad import read_vocabulary
from ..runtime import parallel
from ..utils import colmap
from ..utils.arrays import distinct
from ..utils.cli import InputError, naming
from ..utils.feature_files import dimension, get_features, read_descriptors
from ..utils.h5 import open_h5
from .map import Map
from .matching import Features, Matching, is_integer_matcher
from .numpy_engine import NumpyEngine, is_colmap_sift
from .numpy_features import ColmapSift, Extract, OnnxNetwork


class Engine(Protocol):
    """Computes for a map, see `numpy_engine.NumpyEngine` and `torch_engine.TorchEngine`."""

    matching: Matching
    rotation_invariant: bool  # of its extractor, see `extractors.Extractor`

    def extract(self, image: Path | np.ndarray, preprocessing: dict) -> dict:
        """Extract the features of a photo, see `extractors.extract`."""


@dataclass(frozen=True)
class Contents:
    """A map in memory.

    Args:
        engine: extracts and matches features.
        preprocessing: of photos.
        storage: of its descriptors.
        dim: of its descriptors.
        matcher: configuration of the matcher's model.
        cameras: what it tells about the intrinsics of other photos.
        doubts: why it may be wrong, see `Map.doubts`.
        reference: its points.
        names: its images.
        describe: returns the global descriptor (G,) float32 of a photo, rounded as in files, given
            its features and its file or pixels.
        similarity: returns the similarity (I,) of a global descriptor (G,) to those of its images.
        match: matches the features of a photo, at least those that the matcher needs, with images;
            returns for each of these names the rows (M, 2) int64 of the photo's and of the image's
            keypoints.
    """

    engine: Engine
    preprocessing: dict
    storage: str
    dim: int
    matcher: dict
    cameras: intrinsics.MapCameras
    doubts: list[str]
    reference: Reference
    names: list[str]
    describe: Callable[[dict, Path | np.ndarray], np.ndarray]
    similarity: Callable[[np.ndarray], np.ndarray]
    match: Callable[[Features, list[str]], dict[str, np.ndarray]]


def read(path: Path, onnx: Path | None = None) -> Contents:
    """Read a map.

    Args:
        path: folder of a map of `maps.main`, or file of `hloc_reduce.compact`.
        onnx: file of its feature from `hloc_reduce.export`, in which features are extracted from
            photos; only for a file.

    Raises:
        InputError: if it is neither, or broken, or the ONNX file is of another feature.
    """
    if is_compact(path):
        return _of_file(path, onnx)
    if onnx is not None:
        raise InputError(f"An ONNX file needs a compact map, a file; {path} is none.")
    _check_torch(path, "a map folder")
    return _of_folder(path)


def _check_torch(path: Path, kind: str) -> None:
    """Raise an InputError if torch is not installed."""
    try:
        import torch  # noqa: F401
    except ModuleNotFoundError:
        raise InputError(
            f"{path} is {kind}, which needs torch. Without torch, compact maps of colmap_sift "
            "features can be used, and those of networks with the network's ONNX file."
        ) from None


def _of_folder(path: Path) -> Contents:
    from .. import extract_features, extractors
    from .torch_engine import TorchEngine

    built = Map(path)
    matcher = matchers_confs.confs[built.matcher]["model"]
    reference = SfmMap(colmap.read_model(built.sfm))
    names = sorted(reference.images)
    made_from = extract_features.provenance(built.conf)
    engine = TorchEngine(extractors.load(built.conf["model"]), matcher, built.storage, made_from)
    matching, levels, prepared = engine.matching, built.levels(), {}
    others = [key for key in matching.feature_keys if key != "descriptors"]
    with open_h5(built.features) as file:
        for name in names:
            features = get_features(file, name, others)
            if "descriptors" in matching.feature_keys:
                stored = read_descriptors(file, name)
                levels.check(stored)
                features["descriptors"] = stored.restore(unbiased=matching.takes_codes).T
            prepared[name] = matching.prepare(features)
    shown = {name: np.flatnonzero(reference.point_rows(name) >= 0) for name in names}
    global_descriptors = read_global(built.descriptors, names)
    vocabulary = None if built.vocabulary is None else read_vocabulary(built.vocabulary)

    def match(features: Features, names: list[str]) -> dict[str, np.ndarray]:
        query = matching.prepare(features)

        def match_image(name: str) -> np.ndarray:
            return matching.match(query, prepared[name], shown[name])

        return dict(zip(names, parallel.ordered("match", match_image, names), strict=True))

    return Contents(
        engine=engine,
        preprocessing=built.conf["preprocessing"],
        storage=built.storage,
        dim=dimension(built.features),
        matcher=matcher,
        cameras=built.cameras,
        doubts=built.doubts,
        reference=reference,
        names=names,
        describe=_describe(built.retrieval, vocabulary),
        similarity=lambda descriptor: similarity(descriptor[None], global_descriptors)[0],
        match=match,
    )


def _of_file(path: Path, onnx: Path | None) -> Contents:
    compact = CompactMap(path)
    if retrieval_confs.get(compact.retrieval)["model"]["name"] == "hloc":
        _check_torch(path, f"a map with the retrieval {compact.retrieval}")
    matcher = matchers_confs.confs[compact.matcher]["model"]
    engine = _numpy_engine(compact, matcher, onnx) or _torch_engine(compact, matcher)
    matching = engine.matching
    with naming(path):
        check_feature_keys(compact.matcher, matching.feature_keys)
    others = [key for key in matching.feature_keys if key != "descriptors"]

    def match(features: Features, names: list[str]) -> dict[str, np.ndarray]:
        visible = [compact.visible(name) for name in names]
        points = distinct(np.concatenate([np.zeros(0, np.int64), *visible]))
        described = compact.descriptors(points, unbiased=matching.takes_codes)
        images = [
            (np.searchsorted(points, part), compact.features(name, others))
            for name, part in zip(names, visible, strict=True)
        ]
        found = matching.match_points(matching.prepare(features), described, images)
        return dict(zip(names, found, strict=True))

    return Contents(
        engine=engine,
        preprocessing=compact.conf["preprocessing"],
        storage=compact.storage,
        dim=compact.dim,
        matcher=matcher,
        cameras=compact.cameras,
        doubts=compact.doubts,
        reference=compact,
        names=compact.names,
        describe=_describe(compact.retrieval, compact.vocabulary),
        similarity=compact.similarity,
        match=match,
    )


def _numpy_engine(compact: CompactMap, matcher: dict, onnx: Path | None) -> Engine | None:
    """Return an engine without torch, None if the map's feature or matcher needs torch."""
    base = features_confs.base_of(compact.conf["model"])
    extract: Extract
    if onnx is not None and not is_integer_matcher(matcher):
        raise InputError(f"{compact.path} has the matcher {compact.matcher}, which needs torch.")
    if not is_integer_matcher(matcher):
        return None
    if onnx is not None:
        extract = OnnxNetwork(onnx, compact.feature, base.get("denoise", True))
    elif is_colmap_sift(base) and not compact.is_pickled:
        with naming(compact.path):
            extract = ColmapSift(base, compact.layers())
    else:
        return None
    return NumpyEngine(extract, matcher)


def _torch_engine(compact: CompactMap, matcher: dict) -> Engine:
    _check_torch(compact.path, f"a map with the feature {compact.feature}")
    from .. import extract_features, extractors
    from .torch_engine import TorchEngine

    with TemporaryDirectory() as folder:
        conf = compact.write_projection(Path(folder))
        with naming(compact.path):
            extractor = extractors.load(conf["model"])
            made_from = extract_features.provenance(conf)
            return TorchEngine(extractor, matcher, compact.storage, made_from)


def _describe(
    retrieval: str, vocabulary: np.ndarray | None
) -> Callable[[dict, Path | np.ndarray], np.ndarray]:
    """Return `Contents.describe` of a key of `confs.retrieval` and its vocabulary, if any."""
    conf = retrieval_confs.get(retrieval)
    model, preprocessing = load_retrieval(conf["model"]), conf.get("preprocessing", {})
    if vocabulary is not None:
        model.vocabulary = vocabulary

    def describe(features: dict, image: Path | np.ndarray) -> np.ndarray:
        return model.describe_photo(features, image, preprocessing).astype(np.float32)

    return describe
