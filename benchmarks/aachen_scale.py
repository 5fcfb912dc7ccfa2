"""Measure pairs, matching and their files at fractions of the size of Aachen Day-Night v1.1.

The names of images and queries and hloc's 50 retrieved images of each query are the real ones; the
features are synthetic. Some keypoints of an image show landmarks: a window of a long row, which
overlaps with the windows of images with similar names. A query shows the landmarks of the first
image retrieved for it. All other keypoints are clutter.

For each fraction, a new process writes the features, counts covisible landmarks, makes the pairs
(40 for each map image, half of which are reversed duplicates; 50 for each query, where other map
images replace those that are left out), matches them and checks the matches. The cache of
descriptors shrinks with the data, so that it misses as often as at full size. Adds rows to
results/scale.csv, the last of which extrapolates linearly to the whole data set.
"""

import argparse
import itertools
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from benchmarks import rows
from hloc_reduce import match_features, pairs_from_retrieval
from hloc_reduce.pairs_from_covisibility import most_covisible
from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import CODED, STORAGES, store
from hloc_reduce.utils.h5 import get_dataset, open_h5
from hloc_reduce.utils.match_files import find_pair, get_matches
from hloc_reduce.utils.parsers import (
    image_names,
    parse_pairs,
    parse_query_list,
    parse_retrieval,
    write_pairs,
)

NAME = "scale"
NUM_COVIS, NUM_LOC = 40, 50
SEEN = 0.15  # share of the keypoints that show landmarks
STEP = 0.04  # share of these that the next image in the row does not show
NOISE = 0.2  # length of the noise vector that is added to the descriptor of a landmark
CHECKED = 200  # pairs whose matches are checked
MIN_KEYPOINTS = 10  # so that at least one shows a landmark
WHOLE_MAP = 6697  # images
WHOLE = {"photos": WHOLE_MAP + 1015, "pairs": 20 * WHOLE_MAP + 50 * 1015}
# columns that are proportional to the number of images, or of pairs
GROWING = {
    "photos": ("feature_mb",),
    "pairs": ("matching_s", "match_mb"),
}


def ids_of(place: int, number: int) -> np.ndarray:
    """Return the ids of the landmarks that the image at a place in the row shows."""
    seen = int(SEEN * number)
    return np.arange(seen) + int(place * STEP * seen)


def unit(generator: np.random.Generator, number: int, dim: int) -> np.ndarray:
    """Draw descriptors (N, D) float32 of unit norm."""
    drawn = generator.standard_normal((number, dim), np.float32)
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def synthesize(places: dict[str, int], path: Path, dim: int, number: int, storage: str) -> None:
    """Write the features of images, given their places in the row, and the ids of landmarks."""
    made_from = {"synthesized": [dim, number, storage]}
    levels = None
    if storage in CODED:
        import torch  # not at the top, as runs measure memory

        from hloc_reduce.training.levels import fit

        drawn = torch.from_numpy(unit(np.random.default_rng(2), 100_000, dim))
        levels = fit(drawn, CODED[storage]).numpy()
    with GroupWriter(path, made_from) as writer, GroupWriter(shown(path), made_from) as known:
        for name, place in places.items():
            ids = ids_of(place, number)
            blocks = [  # of 1,000 landmarks, each drawn from a seed of its own
                unit(np.random.default_rng([0, block]), 1000, dim)
                for block in range(ids[0] // 1000, ids[-1] // 1000 + 1)
            ]
            landmarks = np.concatenate(blocks)[ids[0] % 1000 :][: len(ids)]
            generator = np.random.default_rng([1, *name.encode()])
            views = landmarks + NOISE * unit(generator, len(ids), dim)
            views /= np.linalg.norm(views, axis=1, keepdims=True)
            clutter = unit(generator, number - len(ids), dim)
            order = generator.permutation(number)
            features = {key: np.zeros(number, np.float32) for key in ("scales", "oris", "scores")}
            features["keypoints"] = np.zeros((number, 2), np.float32)
            features["descriptors"] = np.concatenate([views, clutter])[order].T
            writer.add(name, *store(features, storage, levels))
            ids = np.concatenate([ids, np.full(number - len(ids), -1)])[order]
            known.add(name, {"ids": ids})


def shown(features: Path) -> Path:
    """Return the file of the ids of the landmarks that keypoints show, -1 for clutter."""
    return features.with_name(f"{features.stem}_ids.h5")


def make_pairs(data: Path, folder: Path, share: float, number: int) -> tuple[dict[str, int], Path]:
    """Write the pairs of a share of the images; return their places in the row and the file."""
    database = image_names(data / "database_images.txt")
    database = database[: max(NUM_LOC, round(share * len(database)))]
    lists = sorted(data.glob("*_time_queries_with_intrinsics.txt"))
    queries = [name for path in lists for name, _ in parse_query_list(path)]
    spread = np.linspace(0, len(queries) - 1, max(1, round(share * len(queries))))
    queries = [queries[int(i)] for i in spread]
    places = {name: i for i, name in enumerate(database)}
    ranking = most_covisible((ids_of(i, number) for i in range(len(database))), NUM_COVIS)
    covisible = ((database[i], database[j]) for i, row in enumerate(ranking) for j in row)
    retrieved = parse_retrieval(data / "pairs-query-netvlad50.txt")
    listed = []
    for query in queries:
        present = [name for name in retrieved[query] if name in places]
        start = hash_of(query) % len(database)
        others = database[start:] + database[:start]
        listed += [(query, name) for name in dict.fromkeys(present + others[:NUM_LOC])]
        places[query] = places[(present or others)[0]]
    write_pairs(listed, folder / "listed.txt")
    pairs_from_retrieval.select(
        folder / "listed.txt", folder / "loc.txt", NUM_LOC, queries, database
    )
    write_pairs(itertools.chain(covisible, parse_pairs(folder / "loc.txt")), folder / "pairs.txt")
    return places, folder / "pairs.txt"


def hash_of(name: str) -> int:
    """Return a number for a name, the same in every run."""
    return int.from_bytes(name.encode()[-8:], "big")


def check(features: Path, matches: Path, pairs: Iterable[tuple[str, str]]) -> tuple[float, float]:
    """Return the recall and the precision of the matches of pairs, in [0, 1]."""
    common = found = right = 0
    with open_h5(shown(features)) as file, open_h5(matches) as match_file:
        for names in pairs:
            ids = [get_dataset(file, name, "ids")[()] for name in names]
            common += len(np.intersect1d(*(part[part >= 0] for part in ids)))
            if find_pair(match_file, *names)[0] is None:
                raise InputError(f"The pair {names} was not matched.")
            indices, _ = get_matches(match_file, *names)
            first, second = ids[0][indices[:, 0]], ids[1][indices[:, 1]]
            found += len(indices)
            right += int(((first == second) & (first >= 0)).sum())
    return right / max(common, 1), right / max(found, 1)


def run(data: Path, share: float, dim: int, number: int, storage: str) -> dict:
    """Measure one share of the data set."""
    match_features.CACHE_BYTES = int(share * match_features.CACHE_BYTES)
    with tempfile.TemporaryDirectory(dir=os.environ.get("TMPDIR")) as temporary:
        folder, start = Path(temporary), time.perf_counter()
        places, pairs_file = make_pairs(data, folder, share, number)
        paired = time.perf_counter()
        features = folder / "features.h5"
        synthesize(places, features, dim, number, storage)
        written = time.perf_counter()
        conf = match_features.confs["NN-ratio"]
        matches = match_features.main(conf, pairs_file, features, matches=folder / "matches.h5")
        matched = time.perf_counter()
        with open_h5(matches) as file:
            matched_pairs = sum(len(group) for group in file.values())
        number = sum(1 for _ in parse_pairs(pairs_file))
        checked = itertools.islice(parse_pairs(pairs_file), 0, None, -(-number // CHECKED))
        found, right = check(features, matches, checked)
        return {
            "photos": len(places),
            "pairs": matched_pairs,
            "pairs_s": paired - start,
            "features_s": written - paired,
            "matching_s": matched - written,
            "feature_mb": features.stat().st_size / 1e6,
            "match_mb": matches.stat().st_size / 1e6,
            "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            "found": 100 * found,
            "right": 100 * right,
        }


def whole(smaller: dict, larger: dict) -> dict:
    """Extrapolate linearly from two fractions to the whole data set."""
    continued: dict[str, object] = dict(WHOLE)
    for number, columns in GROWING.items():
        further = (WHOLE[number] - larger[number]) / (larger[number] - smaller[number])
        continued |= {key: larger[key] + further * (larger[key] - smaller[key]) for key in columns}
    return continued


def _main() -> None:
    parser = cli.Parser(__doc__, "--data aachen_v1.1 --share 0.01 0.02")
    parser.add_argument(
        "--data",
        type=Path,
        required=True,
        help="folder of database_images.txt, which lists the map images, of the query lists and of "
        "hloc's pairs-query-netvlad50.txt",
    )
    parser.add_argument(
        "--share", type=float, nargs="+", default=[0.01, 0.02], help="of the data set, in (0, 1]"
    )
    parser.add_argument("--dim", type=int, default=64, help="numbers of a descriptor")
    parser.add_argument("--keypoints", type=int, default=8000, help="of each image")
    parser.add_argument("--storage", default=STORAGES[0], help=f"one of {', '.join(STORAGES)}")
    parser.add_argument("--once", action="store_true", help=argparse.SUPPRESS)
    rows.add_again_option(parser)
    args = parser.parse_args()
    cli.choose("storage", args.storage, STORAGES)
    if not all(0 < share <= 1 for share in args.share) or len(set(args.share)) < len(args.share):
        raise InputError("--share: different numbers above 0 and at most 1.")
    cli.check_positive(args, "dim")
    if args.keypoints < MIN_KEYPOINTS:
        raise InputError(f"--keypoints: at least {MIN_KEYPOINTS}.")
    if args.once:
        measured = run(args.data, args.share[0], args.dim, args.keypoints, args.storage)
        print(json.dumps(measured))
        return
    cells = {"place": args.data.name, "feature": f"{args.dim} numbers", "storage": args.storage}
    cells |= {"variant": f"{args.keypoints} keypoints"}
    known = rows.select(rows.read(NAME), **cells)
    if not args.again and rows.select(known, list="whole"):
        return
    fractions = []
    for share in sorted(args.share):
        options = {"data": args.data, "dim": args.dim, "keypoints": args.keypoints}
        options |= {"share": share, "storage": args.storage}
        given = [word for key, value in options.items() for word in (f"--{key}", str(value))]
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.aachen_scale", "--once", *given],
            stdout=subprocess.PIPE,
            text=True,
        )
        if done.returncode:
            raise InputError(f"The share {share} failed.")
        fractions.append(json.loads(done.stdout))
        part = {"list": f"share {share:g}"}
        rows.add(NAME, [cells | part | fractions[-1] | rows.how(fractions[-1]["matching_s"])])
    if len(fractions) > 1:
        extrapolated = whole(fractions[0], fractions[-1])
        rows.add(NAME, [cells | {"list": "whole"} | extrapolated | rows.how()])


if __name__ == "__main__":
    cli.run(_main)
