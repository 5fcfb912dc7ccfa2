"""Match the local features of image pairs into an h5 file."""

import argparse
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing
from functools import partial
from itertools import islice
from pathlib import Path

import h5py
import numpy as np

from . import logger
from .confs import features as features_confs
from .confs import matchers as matchers_confs
from .runtime import parallel
from .runtime.executors import SERIAL, Executor
from .runtime.group_writer import Group, GroupWriter, fill
from .utils import cli
from .utils.cli import InputError
from .utils.feature_files import get_descriptors
from .utils.h5 import file_provenance, open_h5
from .utils.match_files import names_to_pair
from .utils.parsers import parse_pairs
from .utils.paths import strings_as_paths
from .utils.progress import progress

confs = matchers_confs.confs
CACHE_BYTES = 2**30  # descriptors that stay in memory: of 500 images at 8,000 x 64
CHUNK = 64  # pairs
PAIRS_ON_GPU = 16  # handed to a GPU at once, which matches as many together as its memory allows


@strings_as_paths
def main(
    conf: dict,
    pairs: Path,
    features: Path | str,
    export_dir: Path | None = None,
    matches: Path | None = None,
    features_ref: Path | None = None,
    overwrite: bool = False,
    gpu_bytes: int | None = None,
    executor: Executor = SERIAL,
) -> Path:
    """Match all pairs of a list, each unordered pair once.

    With another file of the second images, whose names may be those of the first, each pair once.

    Args:
        conf: an entry of `confs`.
        pairs: text file of pairs.
        features: feature file, or its name in `export_dir` without suffix.
        export_dir: folder of the features and of `<features>_<conf["output"]>_<pairs>.h5`.
        matches: the match file itself; needed where `features` is a path.
        features_ref: feature file of the second images; default: `features`.
        overwrite: match anew what is there.
        gpu_bytes: what a matcher may take of the memory of a GPU at once; default: 1 GiB.
        executor: does the work.

    Returns:
        The match file; pairs it holds already are skipped.

    Raises:
        InputError: for an image without features, or no path for the matches.
    """
    if gpu_bytes is not None and gpu_bytes < 1:
        raise InputError(f"--gpu_bytes {gpu_bytes}: at least 1.")
    number = sum(1 for _ in parse_pairs(pairs))
    if not number:
        raise InputError(f"{pairs} has no pair.")
    if isinstance(features, Path) or Path(features).exists():
        feature_path = Path(features)
        if matches is None:
            raise InputError("Give the path of the matches, --matches, as the features have one.")
    elif export_dir is None:
        raise InputError(f"There is no feature file {features}, and no export_dir to look in.")
    else:
        name = str(features).removesuffix(".h5")
        feature_path = Path(export_dir, f"{name}.h5")
        matches = matches or Path(export_dir, f"{name}_{conf['output']}_{pairs.stem}.h5")
    if matches.resolve() in {path.resolve() for path in (feature_path, features_ref or pairs)}:
        raise InputError(f"{matches} is what the matches are made of: choose other --matches.")
    feature_paths = feature_path, features_ref or feature_path
    with ExitStack() as stack:
        files = [stack.enter_context(open_h5(path)) for path in feature_paths]
        made_by = provenance(conf, *files)
    with GroupWriter(matches, made_by, overwrite, compression="gzip") as writer:
        listed = progress(parse_pairs(pairs), "Matching", "pair", number)
        todo = unmatched_pairs(listed, writer, ordered=features_ref not in (None, feature_path))
        work = partial(_match, conf, feature_paths, gpu_bytes)
        done = fill({None: writer}, work, todo, executor, CHUNK, gpu=True)
        with listed, closing(done):
            for _ in done:
                pass
    logger.info("Matches of the pairs %s are in %s.", pairs.name, matches)
    return matches


def provenance(conf: dict, *feature_files: h5py.File) -> dict:
    """Return what determines the matches: the configurations of matcher and features."""
    made_by = {"model": conf["model"]}
    for i, file in enumerate(feature_files):
        made_by[f"features{i}"] = file_provenance(file)
    return made_by


def unmatched_pairs(
    pairs: Iterable[tuple[str, str]], matched: GroupWriter, ordered: bool = False
) -> Iterator[tuple[str, str]]:
    """Yield the pairs that are not matched yet, each once.

    Unless `ordered`, a pair is the same as its reverse.
    """
    for name0, name1 in pairs:
        same = [(name0, name1)] if ordered else [(name0, name1), (name1, name0)]
        # the second separator is of hloc's old format
        if any(names_to_pair(*names, mark) in matched for names in same for mark in "/_"):
            continue
        matched.begin(names_to_pair(name0, name1))
        yield name0, name1


def _match(
    conf: dict,
    feature_paths: tuple[Path, Path],
    gpu_bytes: int | None,
    pairs: Iterable[tuple[str, str]],
) -> Iterator[tuple[None, Group]]:
    """Match pairs while others are read and written, which this thread does."""
    import torch

    from . import matchers

    device = "cuda" if torch.cuda.is_available() else "cpu"
    matcher = matchers.load(conf["model"]).eval().to(device)
    read = DescriptorCache(CACHE_BYTES)
    drawn = iter(pairs)
    size, workers = (1, parallel.cores()) if device == "cpu" else (PAIRS_ON_GPU, 1)

    def match(
        batch: tuple[list[str], list[tuple[np.ndarray, np.ndarray]]],
    ) -> list[tuple[str, dict[str, np.ndarray]]]:
        groups, descriptors = batch
        moved = {
            id(part): torch.from_numpy(part).to(device) for pair in descriptors for part in pair
        }
        on_device = [(moved[id(part0)], moved[id(part1)]) for part0, part1 in descriptors]
        matched = [
            {
                "matches0": matches.cpu().numpy().astype(np.int32),
                "matching_scores0": scores.cpu().numpy().astype(np.float16),
            }
            for matches, scores in matcher.match(on_device, gpu_bytes or matchers.GPU_BYTES)
        ]
        return list(zip(groups, matched, strict=True))

    with open_h5(feature_paths[0]) as file0, open_h5(feature_paths[1]) as file1:

        def read_pair(name0: str, name1: str) -> tuple[np.ndarray, np.ndarray]:
            pair = read(file0, name0), read(file1, name1)
            if pair[0].shape[1] != pair[1].shape[1]:
                raise InputError(
                    f"{file1.filename}: the descriptors of {name1} are {pair[1].shape[1]}-D, those "
                    f"of {name0} {pair[0].shape[1]}-D."
                )
            return pair

        def draw() -> Iterator[tuple[list[str], list[tuple[np.ndarray, np.ndarray]]]]:
            while batch := list(islice(drawn, size)):
                groups = [names_to_pair(*names) for names in batch]
                yield groups, [read_pair(*names) for names in batch]

        with closing(parallel.ordered("match", match, draw(), workers)) as results:
            for batch in results:
                for group, arrays in batch:
                    yield None, (group, arrays, {})


class DescriptorCache:
    """Reads descriptors and keeps those used last in memory.

    Args:
        max_bytes: how much memory they may take.
    """

    def __init__(self, max_bytes: int):
        self.max_bytes, self.bytes = max_bytes, 0
        self.kept: OrderedDict[tuple[str, str], np.ndarray] = OrderedDict()

    def __call__(self, file: h5py.File, name: str) -> np.ndarray:
        """Return the descriptors (N, D) float32 of an image in an open feature file."""
        key = file.filename, name
        if key in self.kept:
            self.kept.move_to_end(key)
            return self.kept[key]
        descriptors = get_descriptors(file, name)
        self.kept[key] = descriptors
        self.bytes += descriptors.nbytes
        while self.bytes > self.max_bytes and len(self.kept) > 1:
            self.bytes -= self.kept.popitem(last=False)[1].nbytes
        return descriptors


def _main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python -m hloc_reduce.match_features --pairs pairs.txt "
        "--features feats-dog-colmap_sift_sv64 --export_dir outputs",
        formatter_class=cli.HelpFormatter,
    )
    parser.add_argument("--pairs", type=Path, required=True, help="text file of image pairs")
    parser.add_argument(
        "--features",
        default=features_confs.confs[features_confs.RECOMMENDED]["output"],
        help="name of the features, without .h5",
    )
    parser.add_argument("--export_dir", type=Path, required=True, help="folder of the features")
    parser.add_argument("--matches", type=Path, help="the match file itself")
    parser.add_argument("--conf", default="NN-ratio", help=f"one of {', '.join(confs)}")
    parser.add_argument("--overwrite", action="store_true", help="match anew what is there")
    parser.add_argument(
        "--gpu_bytes",
        type=int,
        help="bytes of a GPU's memory that a matcher may take at once (default: 1 GiB); without a "
        "GPU it means nothing",
    )
    args = parser.parse_args()
    args.conf = confs[cli.choose("matcher", args.conf, confs)]
    main(**vars(args))


if __name__ == "__main__":
    cli.run(_main)
