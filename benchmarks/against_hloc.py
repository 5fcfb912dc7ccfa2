"""Time this project and hloc stage by stage on a data set in Aachen's layout, all images paired.

hloc extracts `sift` and matches with NN-ratio; this project does the same with each --feature and
its matcher, and SIFT's with each of --keypoints. Each run is a new process that starts with an
empty folder and ends with poses. Runs take turns, and the fastest of several rounds counts. Needs
hloc and a pycolmap that it works with. Adds rows to results/runs.csv: seconds and CPU seconds of
each stage, file sizes, and queries within the finest threshold; and the CPU seconds in one thread
without which two stages cannot do.
"""

import argparse
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import h5py

from benchmarks import rows
from hloc_reduce.confs import features as features_confs
from hloc_reduce.datasets import thresholds, true_poses
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.detectors.dog import KEYPOINT_SETTINGS
from hloc_reduce.evaluation.poses import pose_error, recall
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import STORAGES
from hloc_reduce.utils.feature_files import get_descriptors
from hloc_reduce.utils.files import MEGABYTE
from hloc_reduce.utils.h5 import list_h5_names
from hloc_reduce.utils.hloc import extractors_package
from hloc_reduce.utils.parsers import parse_pairs, parse_poses, write_pairs

NAME = "runs"
HLOC = "hloc"
KEYS = "feature", "storage", "variant"


@dataclass(frozen=True)
class Run:
    """What runs: hloc, or this project with a feature.

    Args:
        name: `HLOC`, FEATURE or FEATURE:STORAGE.
        keypoints: settings of DoG; empty where they change nothing.
    """

    name: str
    keypoints: str = ""

    def cells(self) -> dict[str, str]:
        """Return the cells of its row that name it."""
        feature, _, storage = self.name.partition(":")
        variant = rows.with_keypoints(self.keypoints) if self.keypoints else ""
        return dict(zip(KEYS, (feature, storage or STORAGES[0], variant), strict=True))

    def conf(self) -> dict:
        """Return the configuration of the feature."""
        feature, storage, _ = self.cells().values()
        keypoints = self.keypoints or KEYPOINT_SETTINGS[0]
        return features_confs.get(feature, storage=storage, keypoints=keypoints)[1]


def runs(names: list[str], settings: list[str]) -> list[Run]:
    """List the runs of hloc and of features, each at its DoG keypoints with all settings."""
    listed = [Run(HLOC)]
    for name in names:
        at_dog = features_confs.descriptor_of(Run(name).conf()["model"])
        listed += [Run(name, one) for one in settings] if at_dog else [Run(name)]
    return listed


def stages_of(which: Run, queries: list[str]) -> dict[str, Callable]:
    """Return the stages of hloc or of this project, and the configurations they run with."""
    if which.name == HLOC:
        extractors_package()  # says what to install where hloc is missing or too old
        from hloc import extract_features, localize_sfm, match_features, triangulation

        conf, matcher, extract = extract_features.confs["sift"], "NN-ratio", extract_features.main
    else:
        import torch  # noqa: F401  not timed, as hloc's stages have imported it, too

        from hloc_reduce import extract_features, localize_sfm, match_features, triangulation

        conf = which.conf()
        matcher = features_confs.matcher_of(conf)
        extract = partial(extract_features.main, queries=queries)
    return {
        "conf": conf,
        "matcher": match_features.confs[matcher],
        "extract": extract,
        "match": match_features.main,
        "triangulate": triangulation.main,
        "localize": localize_sfm.main,
    }


def cpu_seconds() -> float:
    """Return the CPU seconds of this process, and of those that it waited for."""
    return sum(os.times()[:4])


def limits(conf: dict, images: Path, features: Path, pair_lists: list[Path]) -> dict[str, float]:
    """Return the CPU seconds of what two stages of a run cannot do without, in one thread.

    These are reading the photos and one pass of the detector or the network; and the products of
    the descriptors of pairs as float32 matrices.
    """
    import torch

    from hloc_reduce import extractors

    torch.set_num_threads(1)
    model = extractors.load(conf["model"]).eval()
    seconds, described = dict.fromkeys(("extraction_limit_s", "matching_limit_s"), 0.0), {}
    with h5py.File(features) as file, torch.no_grad():
        names = list_h5_names(features)
        for name in names:
            start = time.process_time()
            pixels, _ = extractors.load_image(images / name, conf["preprocessing"])
            if model.detect is None:
                model.base({"image": pixels})
            else:
                model.detect(pixels[0, 0].numpy())
            seconds["extraction_limit_s"] += time.process_time() - start
            described[name] = torch.from_numpy(get_descriptors(file, name))
        for first, second in itertools.chain(*map(parse_pairs, pair_lists)):
            start = time.process_time()
            described[first] @ described[second].T
            seconds["matching_limit_s"] += time.process_time() - start
    return seconds


def run(which: Run, dataset: Path, outputs: Path) -> dict:
    """Localize the queries of a data set and time each stage."""
    place = Aachen(dataset)
    database = place.map_names()
    lists = {key: [query for query, _ in part] for key, part in place.query_lists().items()}
    queries = [query for part in lists.values() for query in part]
    sfm_pairs, loc_pairs = outputs / "pairs-sfm.txt", outputs / "pairs-loc.txt"
    write_pairs(list(itertools.combinations(database, 2)), sfm_pairs)
    write_pairs(list(itertools.product(queries, database)), loc_pairs)
    used = stages_of(which, queries)
    seconds: dict[str, float] = {}
    of_cpu: dict[str, float] = {}
    start, cpu_start = time.perf_counter(), cpu_seconds()

    def lap(stage: str) -> None:
        seconds[stage] = time.perf_counter() - start - sum(seconds.values())
        of_cpu[stage] = cpu_seconds() - cpu_start - sum(of_cpu.values())

    conf = used["conf"]
    features = used["extract"](conf, place.images, outputs, image_list=[*database, *queries])
    lap("extraction")
    matches, loc_matches = (
        used["match"](used["matcher"], pairs, conf["output"], outputs)
        for pairs in (sfm_pairs, loc_pairs)
    )
    lap("matching")
    sfm = outputs / "sfm"
    used["triangulate"](sfm, place.reference_model, place.images, sfm_pairs, features, matches)
    lap("triangulation")
    # separately for each list: both may have the same base name
    for key in lists:
        given = place.queries.with_name(f"{key}.txt")
        used["localize"](sfm, given, loc_pairs, features, loc_matches, outputs / f"{key}.txt")
    lap("localization")
    truth = true_poses(queries, place.ground_truth, True)
    within = 0
    for key, part in lists.items():
        estimates = parse_poses(outputs / f"{key}.txt")
        errors = [pose_error(estimates.get(Path(query).name), truth[query]) for query in part]
        within += round(recall(errors, thresholds(key)[:1])[0] * len(part) / 100)
    pair_lists = [sfm_pairs, loc_pairs]
    least = {} if which.name == HLOC else limits(conf, place.images, features, pair_lists)
    return {
        "photos": len(database),
        "points": colmap.read_model(sfm).num_points3D(),
        **{f"{stage}_s": value for stage, value in seconds.items()},
        **{f"{stage}_cpu_s": value for stage, value in of_cpu.items()},
        "feature_mb": features.stat().st_size / MEGABYTE,
        "match_mb": sum(path.stat().st_size for path in (matches, loc_matches)) / MEGABYTE,
        **least,
        "queries": len(queries),
        "within_finest": within,
        "seconds": sum(seconds.values()),
    }


def _main() -> None:
    parser = cli.Parser(__doc__, "--dataset datasets/herz-jesus")
    parser.add_argument("--dataset", type=Path, required=True, help="with true poses of queries")
    parser.add_argument(
        "--feature",
        nargs="*",
        default=["sift_sv64", "colmap_sift_sv64"],
        help="of this project, with the storage of its map, such as mini32:uint2",
    )
    parser.add_argument(
        "--keypoints", nargs="+", choices=KEYPOINT_SETTINGS, default=[KEYPOINT_SETTINGS[0]]
    )
    parser.add_argument("--rounds", type=int, default=3, help="rounds in which all take turns")
    parser.add_argument("--once", action="store_true", help=argparse.SUPPRESS)
    rows.add_again_option(parser)
    args = parser.parse_args()
    taking_turns = runs(args.feature, args.keypoints)
    if args.once:
        with tempfile.TemporaryDirectory() as temporary:
            print("\n" + json.dumps(run(taking_turns[-1], args.dataset, Path(temporary))))
        return
    cli.check_positive(args, "rounds")
    place = {"place": args.dataset.name}
    known = rows.read(NAME)
    if not args.again and all(rows.select(known, **place, **one.cells()) for one in taking_turns):
        return  # a run is only compared with those that it took turns with
    best: dict[Run, dict] = {}
    for _, one in itertools.product(range(args.rounds), taking_turns):
        command = [sys.executable, "-m", "benchmarks.against_hloc", "--once"]
        command += ["--dataset", str(args.dataset), "--feature"]
        command += [] if one.name == HLOC else [one.name]
        command += ["--keypoints", one.keypoints] if one.keypoints else []
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
        if done.returncode:
            raise InputError(f"{one.name} failed ({one.keypoints or 'no'} keypoints).")
        result = json.loads(done.stdout.splitlines()[-1])
        best[one] = min(result, best.get(one, result), key=lambda each: each["seconds"])
    rows.add(NAME, [place | one.cells() | rows.how() | best[one] for one in taking_turns])


if __name__ == "__main__":
    cli.run(_main)
