"""Match the local features of image pairs into an h5 file."""

from collections import OrderedDict
from collections.abc import Iterable, Iterator
from contextlib import closing
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import h5py
import numpy as np

from . import logger
from .confs import features as features_confs
from .confs import matchers as matchers_confs
from .runtime import parallel
from .runtime.executors import SERIAL, Executor, Results
from .runtime.group_writer import Arrays, Group, GroupWriter, fill
from .utils import cli, options
from .utils.cli import InputError
from .utils.codes import to_integers
from .utils.feature_files import (
    Levels,
    StoredDescriptors,
    coded_by,
    get_features,
    read_descriptors,
)
from .utils.h5 import file_provenance, get_conf, iterate_h5_names, open_h5
from .utils.match_files import check_distinct, names_to_pair
from .utils.options import HIDDEN, Option
from .utils.parsers import parse_pairs
from .utils.paths import strings_as_paths
from .utils.progress import progress

if TYPE_CHECKING:
    from .matchers.base import Matcher

confs = matchers_confs.confs
CACHE_BYTES = 2**30  # features in memory: 500 images of 8,000 x 64
CHUNK = 64  # pairs
PAIRS_ON_GPU = 16  # given to a matcher at once, which batches as many as its memory allows

# hloc's dictionary of the features of an image, see `matchers.base.Matcher`; codes stay codes
Features = dict[str, np.ndarray | StoredDescriptors]
FeaturesOfPair = tuple[str, Features, Features]  # the first is the name of its group


@strings_as_paths
def main(
    conf: Annotated[dict, Option("matcher", confs)],
    pairs: Path,
    features: Path | str,
    export_dir: Path | None = None,
    matches: Path | None = None,
    features_ref: Annotated[Path, HIDDEN] | None = None,
    overwrite: bool = False,
    gpu_bytes: int | None = None,
    executor: Executor = SERIAL,
) -> Path:
    """Match all pairs of a list, each unordered pair once.

    With `features_ref`, whose images may have the same names, match each ordered pair once.

    Args:
        conf: matcher; in Python an entry of confs.matchers.
        pairs: text file of image pairs.
        features: name of the features in `export_dir`, without .h5, or the feature file.
        export_dir: folder of the features and of `<features>_<conf["output"]>_<pairs>.h5`.
        matches: the match file itself; needed if `features` is a path.
        features_ref: feature file of the second images; default: `features`.
        overwrite: match all pairs again.
        gpu_bytes: GPU memory in bytes that a matcher may use at once, ignored without a GPU;
            default: 1 GiB.
        executor: runs the matching.

    Returns:
        The match file. Pairs that it has already are skipped.

    Raises:
        InputError: for an image without features, no path for the matches, or images that have the
            same name in match files.
    """
    if gpu_bytes is not None and gpu_bytes < 1:
        raise InputError(f"--gpu_bytes {gpu_bytes}: at least 1.")
    number = _count(pairs)
    if not number:
        raise InputError(f"{pairs} has no pair.")
    feature_path, matches = _paths(conf, pairs, features, export_dir, matches)
    if matches.resolve() in {path.resolve() for path in (feature_path, features_ref or pairs)}:
        raise InputError(f"{matches} is an input of the matching: choose other --matches.")
    feature_paths = feature_path, features_ref or feature_path
    with open_h5(feature_paths[0]) as file0, open_h5(feature_paths[1]) as file1:
        made_from = provenance(conf, file0, file1)
        projections = coded_by(file0), coded_by(file1)
        if None not in projections and projections[0] != projections[1]:
            raise InputError(
                f"The codes in {features_ref} are of another projection than those in "
                f"{feature_path}."
            )
    with GroupWriter(matches, made_from, overwrite, compression="gzip") as writer:
        listed = progress(parse_pairs(pairs), "Matching", "pair", number)
        todo = unmatched_pairs(listed, writer, ordered=features_ref not in (None, feature_path))
        match = partial(_match, conf, feature_paths, gpu_bytes)
        with listed, closing(fill({None: writer}, match, todo, executor, CHUNK, gpu=True)) as done:
            for _ in done:
                pass
    logger.info("Matches of the pairs %s are in %s.", pairs.name, matches)
    return matches


def _count(pairs: Path) -> int:
    """Count the pairs of a text file, whose images a match file must tell apart."""
    number, columns = 0, (set[str](), set[str]())
    for pair in parse_pairs(pairs):
        number += 1
        for names, name in zip(columns, pair, strict=True):
            names.add(name)
    for names in columns if columns[0].isdisjoint(columns[1]) else [set.union(*columns)]:
        check_distinct(sorted(names))
    return number


def _paths(
    conf: dict, pairs: Path, features: Path | str, export_dir: Path | None, matches: Path | None
) -> tuple[Path, Path]:
    """Return the paths of the features and the matches."""
    if isinstance(features, Path) or Path(features).exists():
        if matches is None:
            raise InputError("Give the path of the matches, --matches, as the features have one.")
        return Path(features), matches
    if export_dir is None:
        raise InputError(f"There is no feature file {features}, and no export_dir to look in.")
    name = features.removesuffix(".h5")
    matches = matches or export_dir / f"{name}_{conf['output']}_{pairs.stem}.h5"
    return export_dir / f"{name}.h5", matches


def check_model(conf: dict, made_from: dict) -> None:
    """Fail on a matcher that cannot match some features before any work.

    Args:
        conf: the matcher, an entry of confs.matchers.
        made_from: of the features, see `extract_features.provenance`.

    Raises:
        InputError: when it cannot be made.
    """
    from . import matchers

    matchers.load(matchers_confs.for_features(conf["model"], made_from))


def check_features(features: Path, conf: dict) -> None:
    """Fail on features without what a matcher needs before any work.

    Args:
        features: feature file.
        conf: the matcher, an entry of confs.matchers.

    Raises:
        InputError: when something is missing.
    """
    with open_h5(features) as file:
        _check_keys(file, conf)


def provenance(conf: dict, *feature_files: h5py.File) -> dict:
    """Return what determines the matches: the configurations of matcher and features."""
    known = next(filter(None, map(get_conf, feature_files)), {})
    made_from = {"model": conf["model"], **matchers_confs.provenance(conf["model"], known)}
    for i, file in enumerate(feature_files):
        made_from[f"features{i}"] = file_provenance(file)
    return made_from


def unmatched_pairs(
    pairs: Iterable[tuple[str, str]], matched: GroupWriter, ordered: bool = False
) -> Iterator[tuple[str, str]]:
    """Yield the pairs that are not matched yet, each once.

    Unless `ordered`, a pair is the same as its reverse.
    """
    for name0, name1 in pairs:
        same = [(name0, name1)] if ordered else [(name0, name1), (name1, name0)]
        # the second separator is that of hloc's old format
        if any(names_to_pair(*names, mark) in matched for names in same for mark in "/_"):
            continue
        matched.begin(names_to_pair(name0, name1))
        yield name0, name1


def _match(
    conf: dict,
    feature_paths: tuple[Path, Path],
    gpu_bytes: int | None,
    pairs: Iterable[tuple[str, str]],
) -> Results[tuple[None, Group]]:
    """Yield the groups of pairs: this thread reads and yields while others match."""
    pairs = iter(pairs)
    first = next(pairs, None)
    if first is None:
        return  # without loading torch
    import torch

    from . import matchers
    from .matchers.base import GPU_BYTES

    device = "cuda" if torch.cuda.is_available() else "cpu"
    size, workers = (1, parallel.cores()) if device == "cpu" else (PAIRS_ON_GPU, 1)
    with open_h5(feature_paths[0]) as file0, open_h5(feature_paths[1]) as file1:
        made_from = get_conf(file0) or get_conf(file1)
        model = matchers_confs.for_features(conf["model"], made_from)
        matcher = matchers.load(model).eval().to(device)
        match = partial(_match_batch, matcher, device, gpu_bytes or GPU_BYTES)
        for file in (file0, file1):
            _check_keys(file, conf)
        cache = FeatureCache(CACHE_BYTES, matcher.feature_keys())
        read = map(partial(_read, cache, file0, file1), chain([first], pairs))
        batches = iter(lambda: list(islice(read, size)), [])
        with closing(parallel.ordered("match", match, batches, workers)) as matched:
            for groups in matched:
                yield from groups


def _check_keys(file: h5py.File, conf: dict) -> None:
    """Raise an InputError if the first image of a feature file lacks what a matcher needs."""
    from . import matchers

    matcher, name = conf["model"]["name"], next(iterate_h5_names(file.id), None)
    keys = matchers.find(conf["model"]).feature_keys()
    needed = [key for key in keys if key != "descriptors"]  # there are several kinds of these
    if missing := [key for key in needed if name is not None and key not in file[name]]:
        raise InputError(
            f"The matcher {matcher} needs {' and '.join(missing)}, which the features in "
            f"{file.filename} do not have: choose another matcher or feature."
        )


def _read(
    read: "FeatureCache", file0: h5py.File, file1: h5py.File, pair: tuple[str, str]
) -> FeaturesOfPair:
    """Read the features of a pair."""
    features0, features1 = read(file0, pair[0]), read(file1, pair[1])
    dim0, dim1 = map(_dim, (features0, features1))
    if dim0 != dim1:
        raise InputError(
            f"{file1.filename}: the descriptors of {pair[1]} are {dim1}-D, those of {pair[0]} are "
            f"{dim0}-D."
        )
    return names_to_pair(*pair), features0, features1


def _dim(features: Features) -> int | None:
    """Return the dimension of descriptors, None without any."""
    stored = features.get("descriptors")
    if isinstance(stored, StoredDescriptors):
        return stored.dim
    return None if stored is None else len(stored)


def _match_batch(
    matcher: "Matcher", device: str, gpu_bytes: int, batch: list[FeaturesOfPair]
) -> list[tuple[None, Group]]:
    """Match pairs and return their groups."""
    import torch

    from .matchers import integers

    moved: dict[tuple[int, bool], dict[str, torch.Tensor]] = {}  # pairs share images

    def move(features: Features, as_integers: bool) -> dict[str, torch.Tensor]:
        key = id(features), as_integers
        if key not in moved:
            arrays = {
                name: value
                if isinstance(value, np.ndarray)
                else value.restore(unbiased=matcher.takes_codes).T
                for name, value in features.items()
            }
            if as_integers:
                arrays["descriptors"] = to_integers(arrays["descriptors"].T).T
            moved[key] = {
                name: torch.from_numpy(array).to(device) for name, array in arrays.items()
            }
        return moved[key]

    pairs = []
    for _, *pair in batch:
        coded = any(isinstance(one.get("descriptors"), StoredDescriptors) for one in pair)
        as_integers = matcher.takes_codes and device == "cpu" and integers.is_worthwhile(coded)
        pairs.append((move(pair[0], as_integers), move(pair[1], as_integers)))
    found = matcher.match(pairs, gpu_bytes)
    groups: list[tuple[None, Group]] = []
    for (name, _, _), (matches, scores) in zip(batch, found, strict=True):
        matched: Arrays = {
            "matches0": matches.cpu().numpy().astype(np.int32),
            "matching_scores0": scores.cpu().numpy().astype(np.float16),
        }
        groups.append((None, (name, matched, {})))
    return groups


class FeatureCache:
    """Reads features and keeps the last used ones in memory, codes as codes.

    Args:
        max_bytes: maximum size of the features in memory.
        keys: what is read, see `matchers.base.Matcher`.
    """

    def __init__(self, max_bytes: int, keys: Iterable[str]):
        self.max_bytes, self.bytes, self.keys = max_bytes, 0, tuple(keys)
        self.kept: OrderedDict[tuple[str, str], Features] = OrderedDict()
        self.levels = Levels()

    def __call__(self, file: h5py.File, name: str) -> Features:
        """Return the features of an image in an open feature file.

        Raises:
            InputError: when they are broken, or are codes with other levels than those before.
        """
        key = file.filename, name
        if key in self.kept:
            self.kept.move_to_end(key)
            return self.kept[key]
        others = [key for key in self.keys if key != "descriptors"]
        features: Features = {**get_features(file, name, others)}
        if "descriptors" in self.keys:
            stored = read_descriptors(file, name)
            restored = stored.restore()  # which checks them
            self.levels.check(stored)
            features["descriptors"] = restored.T if stored.is_float else stored
        self.kept[key] = features
        self.bytes += _nbytes(features)
        while self.bytes > self.max_bytes and len(self.kept) > 1:
            self.bytes -= _nbytes(self.kept.popitem(last=False)[1])
        return features


def _nbytes(features: Features) -> int:
    return sum(
        (value if isinstance(value, np.ndarray) else value.array).nbytes
        for value in features.values()
    )


def _main() -> None:
    example = "--pairs pairs.txt --features feats-dog-colmap_sift_sv64 --export_dir outputs"
    features = features_confs.confs[features_confs.RECOMMENDED]["output"]
    options.call(main, __doc__, example, conf="NN-ratio", features=features)


if __name__ == "__main__":
    cli.run(_main)
