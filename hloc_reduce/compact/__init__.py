"""Pack everything that localization needs from a map into one small file.

Keeps one descriptor for each 3D point, which images see it, and what retrieval needs: no photos, no
keypoints. Localize in it with pipelines.localize --map FILE, or with Localizer(FILE).
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import pycolmap

from .. import aggregate_features, extract_features, logger, matchers
from ..aggregate_features import output_of, vocabulary_if_any, vocabulary_of
from ..confs import features as features_confs
from ..confs import matchers as matchers_confs
from ..confs import retrieval as retrieval_confs
from ..hlm import points, selection, signs, writer
from ..hlm.images import Images
from ..hlm.reader import SUFFIX, CompactMap, check_feature_keys
from ..hlm.thinning import thinned
from ..hlm.writer import Source
from ..localization import intrinsics
from ..maps.map import Map
from ..maps.matching import is_integer_matcher
from ..retrieval.ranking import read_global
from ..retrieval.vlad import read_vocabulary
from ..utils import cli, colmap
from ..utils.cli import InputError
from ..utils.codes import STORAGES, Storage
from ..utils.files import MEGABYTE, replacing
from ..utils.options import ABOVE_0, Option
from ..utils.parsers import image_names
from ..utils.paths import strings_as_paths

IMAGES_AT_ONCE = 1024  # whose global descriptors are in memory
MAX_TRIES = 12  # of sizes, to come close to a limit
AIMED_SHARE = 0.998  # of the limit
CLOSE_SHARE = 0.995  # of the limit, which is close enough
VOCABULARY_SHARE = 1 / 256  # of the limit, at most, but for two words
# descriptors of points are means, so that a less strict ratio test is enough
MATCHERS = {"NN-ratio": "NN-ratio90"}
Ranking = Callable[[points.Points, pycolmap.Reconstruction], np.ndarray]
PACKED = 2  # version of the choice of points and images of a limited map
MAX_UINT4_DIM = 32  # of DoG's features that are stored as uint4; others as uint2


@strings_as_paths
def main(
    output: Path,
    map: Path | None = None,
    sfm: Path | None = None,
    features: Path | None = None,
    global_descriptors: Path | None = None,
    feature: str | None = None,
    matcher: str | None = None,
    storage: Storage | None = None,
    max_mb: Annotated[float, ABOVE_0] | None = None,
    retrieval: Annotated[str, Option("retrieval", retrieval_confs.confs)] | None = None,
    image_list: Path | None = None,
) -> dict[str, int]:
    """Write a compact map.

    Args:
        output: the file, .hlm.
        map: folder of a map of pipelines.localize; or else give the following four.
        sfm: COLMAP model, instead of `map`.
        features: feature file of its images.
        global_descriptors: h5 file of their global descriptors, with the vocabulary beside it, if
            any, from aggregate_features; default: the one beside `features`.
        feature: name of the feature of `features`, or its YAML file.
        matcher: matcher of queries; default: the map's, or the feature's, but NN-ratio90 instead of
            NN-ratio.
        storage: storage of the points' descriptors; default: the map's if it stores codes, else
            uint4 for DoG features of up to 32 dimensions, uint2 for others, and float16 without
            levels.
        max_mb: size of the file in 1,000,000 bytes: points that images need least are left out, and
            of many images those that show the same as others.
        retrieval: what computed `global_descriptors`; default: the map's, or vlad.
        image_list: text file with the names of the images that the file has, a part of the map that
            can be joined with others; default: all.

    Returns:
        The bytes of each part of the file.

    Raises:
        InputError: when something is missing or wrong, or the limit is below what the file needs
            without points.
    """
    check_output(output)
    if max_mb is not None and not max_mb > 0:
        raise InputError(f"--max_mb {max_mb}: it must be above 0.")
    stages = sfm, features, global_descriptors, feature
    if map is not None and any(part is not None for part in stages):
        raise InputError("Give --map, or --sfm, --features and --feature, not both.")
    if map is not None:
        built = Map(map)
        if retrieval not in (None, built.retrieval):
            raise InputError(f"The map {map} was built with --retrieval {built.retrieval}.")
        features, source = built.features, of_map(built)
    elif sfm is None or features is None or feature is None:
        raise InputError("Give --map, or --sfm, --features and --feature.")
    else:
        name = retrieval or retrieval_confs.VLAD
        source = _of_stages(sfm, features, global_descriptors, feature, name)
    names = None if image_list is None else image_names(image_list)
    return write(output, source, features, matcher, storage, max_mb, names)


def write(
    output: Path,
    source: Source,
    features: Path,
    matcher: str | None = None,
    storage: str | None = None,
    max_mb: float | None = None,
    names: Collection[str] | None = None,
    rank: Ranking | None = None,
) -> dict[str, int]:
    """Write a compact map of what a pipeline has in memory and in files.

    Args:
        output: the file.
        source: what it is made from.
        features: feature file of the images.
        matcher: matcher of queries; default: the map's, but NN-ratio90 for NN-ratio.
        storage: storage of the points' descriptors; default: as in `main`.
        max_mb: size of the file in 1,000,000 bytes; default: with all points.
        names: images that the file has; default: all.
        rank: ranks points instead of `selection.Sights`: if not all fit, the first ones are kept.

    Returns:
        The bytes of each part of the file.

    Raises:
        InputError: for an image that is not in the map, a matcher that is unknown or needs what
            compact maps do not have, or a size that is too small.
    """
    matcher = matcher or matcher_of(source.matcher)
    check_matcher(matcher)
    if not is_integer_matcher(model := matchers_confs.confs[matcher]["model"]):
        made_from = extract_features.provenance(source.conf)
        matchers.load(matchers_confs.for_features(model, made_from))
    conf = {**source.conf, "storage": _storage(source.conf, storage)}
    source = replace(source, matcher=matcher, conf=conf)
    everything = points.collect(source.model, features, Images.of(source.model, names).names)
    _check_dim(source, features, everything.descriptors.shape[1])
    limit = None if max_mb is None else max_mb * MEGABYTE
    with TemporaryDirectory() as folder, replacing(output) as temporary:
        kept, encode = everything, partial(_encode, temporary, source, everything)
        number, parts = len(everything), encode(np.arange(len(everything)))
        # parts of a map have the same vocabulary, whether all of their points fit or not
        if limit is not None and (names is not None or sum(parts.values()) > limit):
            source = _with_few_words(source, features, everything, limit, Path(folder))
            encode = partial(_encode, temporary, source, everything)
            parts = encode(np.arange(len(everything)))
        if limit is not None and sum(parts.values()) > limit:
            reliability = selection.reliabilities(everything, features)
            sights = selection.Sights(everything, source.model, reliability)
            fitting = 1 + int(limit * len(everything) / parts["descriptors"])  # at most
            ranking = rank(everything, source.model) if rank else sights.ranked(fitting)
            kept = thinned(sights, ranking, parts, limit)
            ranking = ranking[np.isin(ranking, np.concatenate(kept.visible))]
            encode = partial(_encode, temporary, source, kept)
            number, parts = _fit(lambda number: encode(ranking[:number]), len(ranking), limit)
    logger.info(
        "%s has %s of %s points, %s of %s images and %s bytes: %s.",
        output,
        f"{number:,}",
        f"{len(everything):,}",
        f"{len(kept.names):,}",
        f"{len(everything.names):,}",
        f"{sum(parts.values()):,}",
        ", ".join(f"{part} {size:,}" for part, size in parts.items()),
    )
    return parts


def check_output(output: Path) -> None:
    """Raise an InputError unless a compact map can have the name `output`."""
    if output.suffix != SUFFIX:
        raise InputError(f"{output}, a compact map, must end in {SUFFIX}.")
    cli.check_file(output)


def check_matcher(matcher: str) -> None:
    """Raise an InputError for a matcher that compact maps cannot have."""
    cli.choose("matcher", matcher, matchers_confs.confs)
    model = matchers_confs.confs[matcher]["model"]
    if not is_integer_matcher(model):  # the others need torch
        check_feature_keys(matcher, matchers.find(model).feature_keys())


def matcher_of(matcher: str) -> str:
    """Return the matcher of a compact map of a map with a matcher, a key of `confs.matchers`."""
    return MATCHERS.get(matcher, matcher)


def of_map(built: Map) -> Source:
    """Return what a compact map of a map of `pipelines.localize` is made from."""
    return Source(
        colmap.read_model(built.sfm),
        built.feature,
        built.conf,
        built.matcher,
        built.descriptors,
        built.vocabulary,
        built.cameras,
        built.doubts,
        built.retrieval,
        built.frame,
        built.id,
    )


def check(file: Path, map: Path | None = None, sfm: Path | None = None) -> str | None:
    """Tell whether a compact map is current.

    Args:
        file: the compact map.
        map: folder of the map that it was made from; or else give `sfm`.
        sfm: COLMAP model that it was made from.

    Returns:
        Why it is stale, None if it is current.

    Raises:
        InputError: when something is missing or broken.
    """
    if (map is None) == (sfm is None):
        raise InputError("--check needs --map or --sfm, what the file was made from.")
    made_from = CompactMap(file).made_from
    if made_from is None:
        return f"{file} is of an earlier version, which does not tell what it was made from."
    if made_from != (Map(map).id if map else colmap.fingerprint(sfm or Path())):
        return f"{file} is stale: it was made from something else than {map or sfm} as it is now."
    return None


def _of_stages(
    sfm: Path, features: Path, global_descriptors: Path | None, feature: str, retrieval: str
) -> Source:
    """Return what the outputs of stages give, with the matcher of the feature."""
    name, conf = features_confs.get(feature)
    described_by = retrieval_confs.get(retrieval)
    descriptors = global_descriptors or output_of(described_by, features)
    vocabulary = vocabulary_if_any(described_by, descriptors)
    model = colmap.read_model(sfm)
    cameras = intrinsics.of_cameras(image.camera for image in model.images.values())
    matcher = features_confs.matcher_of(conf)
    return Source(
        model,
        name,
        conf,
        matcher,
        descriptors,
        vocabulary,
        cameras,
        retrieval=retrieval,
        made_from=colmap.fingerprint(sfm),
    )


def _check_dim(source: Source, features: Path, dim: int) -> None:
    """Raise an InputError if the descriptors of a file are not those of the feature."""
    name, levels = source.feature, features_confs.levels(source.conf)
    known = features_confs.dimension(name) if name in features_confs.confs else None
    expected = known if levels is None else len(levels)
    if expected not in (None, dim):
        raise InputError(f"{features} has {dim} numbers a descriptor, but {name} has {expected}.")


def _storage(conf: dict, storage: str | None) -> str:
    """Return the storage of a map's points."""
    if storage is not None:
        cli.choose("storage", storage, STORAGES)
        features_confs.levels({**conf, "storage": storage})
        return storage
    if "storage" in conf:
        return conf["storage"]
    if features_confs.level_file(conf) is None:
        return STORAGES[0]
    try:
        levels = features_confs.levels({**conf, "storage": "uint4"})
        few = levels is not None and len(levels) <= MAX_UINT4_DIM
        return "uint4" if few and not features_confs.network_of(conf["model"]) else "uint2"
    except InputError:  # a projection without levels
        return STORAGES[0]


def _with_few_words(
    source: Source, features: Path, everything: points.Points, limit: float, folder: Path
) -> Source:
    """Describe images by a vocabulary that takes a small share of a limit, if the map's does not.

    Args:
        source: what the map is made from.
        features: feature file of its images.
        everything: all points.
        limit: bytes of the map.
        folder: for global descriptors.
    """
    fitting = VOCABULARY_SHARE * limit / (2 * everything.descriptors.shape[1])  # float16
    number = 2 ** max(1, int(np.log2(max(1, fitting))))
    if source.vocabulary is None or number >= len(read_vocabulary(source.vocabulary)):
        return source
    conf = retrieval_confs.get(source.retrieval)
    conf = {**conf, "model": {**conf["model"], "num_words": number}}
    # parts of a map have the same vocabulary
    learned_from = sorted(image.name for image in source.model.images.values())
    given = conf, features, learned_from, folder
    described = aggregate_features.main(*given, image_list=[*everything.names])
    return replace(source, global_descriptors=described, vocabulary=vocabulary_of(described))


def _encode(
    path: Path, source: Source, everything: points.Points, chosen: np.ndarray
) -> dict[str, int]:
    """Write some points; return the bytes of each part.

    Args:
        path: the file.
        source: what the map is made from.
        everything: all points, and the images of the file.
        chosen: the points.
    """
    kept = everything.only(np.sort(chosen))
    step = points.precision(kept, source.model)
    images = Images.of(source.model, kept.names)
    described = _global_signs(source.global_descriptors, kept.names)
    with path.open("wb") as file:
        return writer.write(file, points.Sorted(kept), images, source, *described, step)


def _global_signs(path: Path, names: Sequence[str]) -> tuple[np.ndarray, int]:
    """Return the packed signs (I, B) of the global descriptors of images, and their dimension."""
    packed, dims = [], set()
    for start in range(0, len(names), IMAGES_AT_ONCE):
        rows = read_global(path, [*names[start : start + IMAGES_AT_ONCE]])
        packed.append(signs.pack(rows)[0])
        dims.add(rows.shape[1])
    if len(dims) > 1:
        raise InputError(f"The global descriptors in {path} differ in size.")
    return np.concatenate(packed), dims.pop()


def _fit(
    encode: Callable[[int], dict[str, int]], number: int, limit: float
) -> tuple[int, dict[str, int]]:
    """Write about as many points as fit into a limit.

    Args:
        encode: writes a number of points, and returns the bytes of each part.
        number: of all points.
        limit: of the bytes of all parts.

    Returns:
        The number of points that were written last, and the bytes of each part.
    """
    best, parts = 0, dict[str, int]()
    low, high, tried = 0, number + 1, number  # the first number fits, the second one does not
    for _ in range(MAX_TRIES):
        parts = encode(tried)
        size = sum(parts.values())
        fixed = size - sum(parts[part] for part in ("coordinates", "descriptors", "visible"))
        if size <= limit:
            low = best = tried
            if tried == number or size >= CLOSE_SHARE * limit:
                break
        else:
            high = tried
        if high - low < 2 or limit <= fixed:
            break
        # points that many images show come first, so that fewer take more than their share
        guess = int(AIMED_SHARE * tried * (limit - fixed) / (size - fixed))
        tried = guess if low < guess < high else (low + high) // 2
    if not best:
        raise InputError(
            f"--max_mb {limit / MEGABYTE:g} is too small: a point and {fixed:,} bytes are needed."
        )
    return best, parts if tried == best else encode(best)
