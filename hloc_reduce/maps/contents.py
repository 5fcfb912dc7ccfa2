"""A map in memory, read from a folder or a compact file."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Protocol

import numpy as np

from ..confs import features as features_confs
from ..confs import matchers as matchers_confs
from ..confs import retrieval as retrieval_confs
from ..hlm.joined import opened
from ..hlm.reader import CompactMap, check_feature_keys, is_compact
from ..localization import intrinsics, views
from ..localization.frame import Frame
from ..localization.references import Reference, SfmMap
from ..retrieval import load as load_retrieval
from ..retrieval.ranking import rank, read_global, similarity
from ..retrieval.vlad import read_vocabulary
from ..runtime import parallel
from ..utils import cli, colmap
from ..utils.arrays import distinct
from ..utils.cli import InputError, naming
from ..utils.feature_files import dimension, get_features, read_descriptors, upright
from ..utils.h5 import open_h5
from .map import Map
from .matching import Features, Matching, is_integer_matcher
from .numpy_engine import NumpyEngine, is_colmap_sift
from .numpy_features import ColmapSift, Extract, OnnxNetwork
from .onnx_files import OnnxLightGlue


class Engine(Protocol):
    """Computes for a map, see `numpy_engine.NumpyEngine` and `torch_engine.TorchEngine`."""

    rotation_invariant: bool  # of its extractor, see `extractors.Extractor`

    def extract(
        self, image: Path | np.ndarray, preprocessing: dict, mask: np.ndarray | None = None
    ) -> dict:
        """Extract the features of a photo, see `extractors.extract`."""

    def matching(self, matcher: dict) -> Matching:
        """Return what matches as a matcher with a configuration does."""


@dataclass(frozen=True)
class Step:
    """A matcher that photos are tried with.

    Args:
        matcher: configuration of its model.
        match: matches the features of a photo, at least those that the matcher needs, with images;
            returns for each of these names the rows (M, 2) int64 of the photo's and of the image's
            keypoints.
    """

    matcher: dict
    match: Callable[[Features, list[str]], dict[str, np.ndarray]]


@dataclass(frozen=True)
class Contents:
    """A map in memory.

    Args:
        engine: extracts features.
        steps: the matchers that photos are tried with, one after the other.
        preprocessing: of photos.
        storage: of its descriptors.
        dim: of its descriptors.
        cameras: what it tells about the intrinsics of other photos.
        doubts: why it may be wrong, see `Map.doubts`.
        frame: its unit, and where on Earth it is.
        reference: its points.
        names: its images, sorted.
        views: returns the positions (I, 3) and the optical axes (I, 3) of its images.
        describe: returns the global descriptor (G,) float32 of a photo, rounded as in files, given
            its features, its file or pixels, and by how many quarter turns it is shown.
        retrieve: returns the names of the images, at most a number, that are most similar to a
            global descriptor (G,), best first.
    """

    engine: Engine
    steps: list[Step]
    preprocessing: dict
    storage: str
    dim: int
    cameras: intrinsics.MapCameras
    doubts: list[str]
    frame: Frame
    reference: Reference
    names: Sequence[str]
    views: Callable[[], tuple[np.ndarray, np.ndarray]]
    describe: Callable[[dict, Path | np.ndarray, int], np.ndarray]
    retrieve: Callable[[np.ndarray, int], list[str]]


def read(
    path: Path | Sequence[Path],
    onnx: Path | None = None,
    matcher: str | None = None,
    matcher_onnx: Path | None = None,
) -> Contents:
    """Read a map.

    Args:
        path: folder of a map of `maps.main`, or file of `hloc_reduce.compact`, or several.
        onnx: file of its feature from `hloc_reduce.export`, in which features are extracted from
            photos; only for a file.
        matcher: one of `confs.matchers.names`; default: the map's.
        matcher_onnx: file of LightGlue from `hloc_reduce.export`; only with `onnx`.

    Raises:
        InputError: if it is neither, or broken, a matcher does not suit it, or an ONNX file is of
            another feature.
    """
    if matcher is not None:
        cli.choose("matcher", matcher, matchers_confs.names)
    if matcher_onnx is not None and onnx is None:
        raise InputError("An ONNX file of LightGlue needs one of the feature, too.")
    if is_compact(path):
        return _of_file(path, onnx, matcher, matcher_onnx)
    if not isinstance(path, Path):
        raise InputError(f"Several maps must be compact ones: {', '.join(map(str, path))}.")
    if onnx is not None:
        raise InputError(f"An ONNX file needs a compact map, a file; {path} is none.")
    _check_torch(path, "a map folder")
    return _of_folder(path, matcher)


def _check_torch(path: Path, kind: str) -> None:
    """Raise an InputError if torch is not installed."""
    try:
        import torch  # noqa: F401
    except ModuleNotFoundError:
        raise InputError(
            f"{path} is {kind}, which needs torch. Without torch, compact maps of colmap_sift "
            "features can be used, and those of networks with the network's ONNX file."
        ) from None


def _of_folder(path: Path, matcher: str | None) -> Contents:
    from .. import extract_features, extractors
    from .torch_engine import TorchEngine

    built = Map(path)
    reference = SfmMap(colmap.read_model(built.sfm))
    names = sorted(reference.images)
    made_from = extract_features.provenance(built.conf)
    engine = TorchEngine(extractors.load(built.conf["model"]), built.storage, made_from)
    shown = {name: np.flatnonzero(reference.point_rows(name) >= 0) for name in names}
    models = [
        matchers_confs.confs[step]["model"]
        for step in matchers_confs.steps_in(built.matcher, built.conf, matcher)
    ]
    steps = [Step(model, _match_images(built, engine.matching(model), shown)) for model in models]
    global_descriptors = read_global(built.descriptors, names)
    vocabulary = None if built.vocabulary is None else read_vocabulary(built.vocabulary)

    return Contents(
        engine=engine,
        steps=steps,
        preprocessing=built.conf["preprocessing"],
        storage=built.storage,
        dim=dimension(built.features),
        cameras=built.cameras,
        doubts=built.doubts,
        frame=built.frame,
        reference=reference,
        names=names,
        views=reference.views,
        describe=_describe(built.retrieval, vocabulary, built.conf["preprocessing"]),
        retrieve=lambda descriptor, number: [
            names[row] for row in rank(similarity(descriptor[None], global_descriptors), number)[0]
        ],
    )


def _match_images(
    built: Map, matching: Matching, shown: dict[str, np.ndarray]
) -> Callable[[Features, list[str]], dict[str, np.ndarray]]:
    """Return `Step.match` of a map in a folder, whose features it reads.

    Args:
        built: the map.
        matching: matches.
        shown: rows of the keypoints of each image that show a point.
    """
    levels, prepared = built.levels(), {}
    others = [key for key in matching.feature_keys if key != "descriptors"]
    with open_h5(built.features) as file:
        for name in shown:
            features = get_features(file, name, others)
            if "descriptors" in matching.feature_keys:
                stored = read_descriptors(file, name)
                levels.check(stored)
                features["descriptors"] = stored.restore(unbiased=matching.takes_codes).T
            prepared[name] = matching.prepare(features)

    def match(features: Features, names: list[str]) -> dict[str, np.ndarray]:
        query = matching.prepare(upright(features, int(features.get("turns", 0))))

        def match_image(name: str) -> np.ndarray:
            return matching.match(query, prepared[name], shown[name])

        return dict(zip(names, parallel.ordered("match", match_image, names), strict=True))

    return match


def _of_file(
    paths: Path | Sequence[Path], onnx: Path | None, matcher: str | None, matcher_onnx: Path | None
) -> Contents:
    compact = opened(paths)
    path = compact.path
    if retrieval_confs.get(compact.retrieval)["model"]["name"] == "hloc":
        _check_torch(path, f"a map with the retrieval {compact.retrieval}")
    names = matchers_confs.steps_in(compact.matcher, compact.conf, matcher)
    models = [matchers_confs.confs[name]["model"] for name in names]
    engine = _numpy_engine(compact, models, onnx, matcher_onnx) or _torch_engine(compact)
    steps = []
    for name, model in zip(names, models, strict=True):
        with naming(path):
            matching = engine.matching(model)
            check_feature_keys(name, matching.feature_keys)
        steps.append(Step(model, _match_points(compact, matching)))
    return Contents(
        engine=engine,
        steps=steps,
        preprocessing=compact.conf["preprocessing"],
        storage=compact.storage,
        dim=compact.dim,
        cameras=compact.cameras,
        doubts=compact.doubts,
        frame=compact.frame,
        reference=compact,
        names=compact.names,
        views=compact.views,
        describe=_describe(compact.retrieval, compact.vocabulary, compact.conf["preprocessing"]),
        retrieve=lambda descriptor, number: [
            compact.names[row] for row in compact.retrieve(descriptor, number)[0]
        ],
    )


def _match_points(
    compact: CompactMap, matching: Matching
) -> Callable[[Features, list[str]], dict[str, np.ndarray]]:
    """Return `Step.match` of a compact map."""
    others = [key for key in matching.feature_keys if key != "descriptors"]

    def match(features: Features, names: list[str]) -> dict[str, np.ndarray]:
        visible = [compact.visible(name) for name in names]
        points = distinct(np.concatenate([np.zeros(0, np.int64), *visible]))
        query = matching.prepare(upright(features, int(features.get("turns", 0))))
        described = compact.descriptors(points, unbiased=matching.takes_codes)
        images = [
            (np.searchsorted(points, part), compact.features(name, others))
            for name, part in zip(names, visible, strict=True)
        ]
        found = matching.match_points(query, described, images)
        return dict(zip(names, found, strict=True))

    return match


def _numpy_engine(
    compact: CompactMap, models: list[dict], onnx: Path | None, matcher_onnx: Path | None
) -> Engine | None:
    """Return an engine without torch, None if the map's feature or a matcher needs torch."""
    base = features_confs.base_of(compact.conf["model"])
    extract: Extract
    others = [model for model in models if not is_integer_matcher(model)]
    if others and onnx is None:
        return None
    lightglue = None
    if matcher_onnx is not None and not others:
        raise InputError(
            f"The matcher {compact.matcher} needs no {matcher_onnx}: give the matcher "
            f"{matchers_confs.NN_LIGHTGLUE} or lightglue, too."
        )
    for model in others:
        if model["name"] != "lightglue" or matcher_onnx is None:
            raise InputError(
                f"The matcher {model['name']} needs torch or, if it is lightglue, an ONNX file of "
                "its own, matcher_onnx, from hloc_reduce.export --matcher."
            )
        number = model.get("max_keypoints")
        lightglue = OnnxLightGlue(matcher_onnx, compact.feature, compact.projection, number)
    if onnx is not None:
        extract = OnnxNetwork(onnx, compact.feature, base.get("denoise", True))
    elif is_colmap_sift(base) and not compact.is_pickled:
        with naming(compact.path):
            extract = ColmapSift(base, compact.layers())
    else:
        return None
    return NumpyEngine(extract, lightglue)


def _torch_engine(compact: CompactMap) -> Engine:
    _check_torch(compact.path, f"a map with the feature {compact.feature}")
    from .. import extract_features, extractors
    from .torch_engine import TorchEngine

    with TemporaryDirectory() as folder:
        conf = compact.write_projection(Path(folder))
        with naming(compact.path):
            extractor = extractors.load(conf["model"])
            made_from = extract_features.provenance(conf)
            return TorchEngine(extractor, compact.storage, made_from)


def _describe(
    retrieval: str, vocabulary: np.ndarray | None, of_feature: dict
) -> Callable[[dict, Path | np.ndarray, int], np.ndarray]:
    """Return `Contents.describe`.

    Args:
        retrieval: a key of `confs.retrieval`.
        vocabulary: its vocabulary, if any.
        of_feature: preprocessing of the local feature.
    """
    conf = retrieval_confs.get(retrieval)
    model = load_retrieval(conf["model"])
    if vocabulary is not None:
        model.vocabulary = vocabulary

    def describe(features: dict, image: Path | np.ndarray, turns: int) -> np.ndarray:
        shown = views.for_retrieval(conf, turns, of_feature).get("preprocessing", {})
        return model.describe_photo(features, image, shown).astype(np.float32)

    return describe
