"""Time LightGlue on pairs of neighbouring photos of a place, by keypoints and threads.

Compares all layers and all keypoints with kornia's defaults: LightGlue stops when enough keypoints
are certain, and drops those that have no match. Several threads share each pair, or each takes a
pair of its own, as a stage does. Adds rows to results/lightglue_seconds.csv: milliseconds a pair on
a CPU, the least of several rounds in which all take turns, and the matches of a pair.
"""

import time
from collections.abc import Iterator, Sequence
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import torch

from benchmarks import rows
from benchmarks.lightglue import limited
from hloc_reduce import extract_features, matchers
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.matchers.base import Features, Matcher
from hloc_reduce.runtime import parallel
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.feature_files import get_features
from hloc_reduce.utils.h5 import open_h5

NAME = "lightglue_seconds"
LAYERS = {
    "all layers": {"depth_confidence": -1.0, "width_confidence": -1.0},
    "early exit": {},
}

Pair = tuple[Features, Features]


def read_pairs(place: Aachen, feature: str, number: int, pairs: int, outputs: Path) -> list[Pair]:
    """Extract the best keypoints of a number, and return the first pairs of neighbours by name."""
    conf = features_confs.get(feature)[1]
    conf |= {"model": limited(conf["model"], number)}
    names = sorted(place.map_names())[: pairs + 1]
    path = outputs / f"{place.root.name}-{feature}-{number}.h5"
    extract_features.main(conf, place.images, image_list=names, feature_path=path)
    keys = matchers.find(matchers_confs.confs["lightglue"]["model"]).feature_keys()
    with open_h5(path) as file:
        read = [get_features(file, name, keys) for name in names]
    tensors = [{key: torch.from_numpy(value) for key, value in one.items()} for one in read]
    return list(pairwise(tensors))


def ways(threads: Sequence[int]) -> Iterator[tuple[str, int, int]]:
    """Yield a name, the threads of a pair, and the pairs at a time."""
    for number in threads:
        yield f"{number} thread{'s' * (number > 1)}", number, 1
        if number > 1:
            yield f"{number} pairs at a time", 1, number


def seconds_of(matcher: Matcher, pairs: list[Pair], threads: int, workers: int) -> float:
    """Return the wall seconds of a pair."""
    torch.set_num_threads(threads)
    start = time.perf_counter()
    if workers > 1:
        list(parallel.ordered("match", lambda pair: matcher.match([pair]), pairs, workers))
    else:
        matcher.match(pairs)
    return (time.perf_counter() - start) / len(pairs)


def measure(
    model: dict, pairs: list[Pair], threads: Sequence[int], rounds: int
) -> dict[tuple[str, str], dict[str, float]]:
    """Return the measures of each choice of layers and way of using threads."""
    loaded = {layers: matchers.load(model | options) for layers, options in LAYERS.items()}
    matches = {
        layers: float(np.mean([int((matcher.match([pair])[0][0] >= 0).sum()) for pair in pairs]))
        for layers, matcher in loaded.items()
    }
    tried = list(product(loaded, ways(threads)))
    seconds = {(layers, way): np.inf for layers, (way, *_) in tried}
    for _ in range(rounds):
        for layers, (way, number, workers) in tried:
            found = seconds_of(loaded[layers], pairs, number, workers)
            seconds[layers, way] = min(seconds[layers, way], found)
    return {key: {"ms": 1000 * value, "matches": matches[key[0]]} for key, value in seconds.items()}


def _main() -> None:
    parser = cli.Parser(__doc__, "--dataset datasets/herz-jesus --feature mini32 --keypoints 1024")
    add = parser.add_argument
    add("--dataset", type=Path, required=True, help="a place in Aachen's layout")
    add("--feature", nargs="+", default=["mini32"], help="features")
    add("--keypoints", nargs="+", type=int, default=[512, 1024, 2048, 4096], help="of a photo")
    add("--pairs", type=int, default=4, help="number of pairs")
    add("--rounds", type=int, default=3, help="rounds in which all take turns")
    add("--outputs", type=Path, default=Path("outputs/lightglue_seconds"))
    rows.add_again_option(parser)
    args = parser.parse_args()
    cli.check_positive(args, "pairs", "rounds")
    if min(args.keypoints) < 1:
        raise InputError("--keypoints: at least 1.")
    place, cores = Aachen(args.dataset), parallel.cores()
    threads = sorted({1, cores})
    known = [] if args.again else rows.read(NAME)
    for feature, number in product(args.feature, args.keypoints):
        cells = {"place": place.root.name, "feature": feature, "list": f"{number} keypoints"}
        if rows.select(known, **cells):
            continue
        pairs = read_pairs(place, feature, number, args.pairs, args.outputs)
        model = matchers_confs.confs["lightglue"]["model"] | {"max_keypoints": number}
        model = matchers_confs.for_features(
            model, extract_features.provenance(features_confs.get(feature)[1])
        )
        start = time.perf_counter()
        found = measure(model, pairs, threads, args.rounds)
        how = rows.how(time.perf_counter() - start, cores)
        rows.add(
            NAME,
            [
                cells | {"variant": f"{layers}, {way}"} | measures | how
                for (layers, way), measures in found.items()
            ],
        )


if __name__ == "__main__":
    cli.run(_main)
