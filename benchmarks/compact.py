"""Measure what a megabyte of a map buys: compact maps of several sizes beside the whole map.

Localizes the queries of a data set in Aachen's layout through `Localizer`. Prints a Markdown table;
maps are kept in the output folder, so that further sizes take seconds.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from hloc_reduce import Localizer, compact, maps
from hloc_reduce.datasets import true_poses
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.hlm import points
from hloc_reduce.utils import cli

LIMITS = 0.25, 2.0  # metres and degrees of a right pose


def longest(everything: points.Points, number: int) -> np.ndarray:
    """Select the points that most images show."""
    seen = np.bincount(np.concatenate(everything.visible), minlength=len(everything))
    return np.sort(np.argsort(-seen, kind="stable")[:number])


def drawn(everything: points.Points, number: int) -> np.ndarray:
    """Select points at random."""
    generator = np.random.default_rng(0)
    return np.sort(generator.choice(len(everything), number, replace=False))


SELECTIONS = {"cover": points.select, "longest": longest, "random": drawn}


def measure(localizer: Localizer, place: Aachen, truth: dict) -> Iterator[str]:
    """Yield inliers, right poses, the median error and the seconds of each query list."""
    for queries in place.query_lists().values():
        inliers, errors, right, seconds = [], [], 0, []
        for name, camera in queries:
            pose, info = localizer.localize(place.images / name, camera)
            inliers.append(info["num_inliers"])
            seconds.append(info["seconds"]["matching"] + info["seconds"]["pose"])
            if pose is not None:
                metres, degrees = pose_error(pose, truth[name])
                errors.append(metres)
                right += metres <= LIMITS[0] and degrees <= LIMITS[1]
        median, largest = (f"{100 * f(errors):.2f}" if errors else "" for f in (np.median, np.max))
        yield f"{np.mean(inliers):,.0f}"
        yield f"{right} of {len(queries)}"
        yield f"{median} / {largest}"
        yield f"{np.mean(seconds):.2f}"


def _main() -> None:
    parser = cli.Parser(__doc__, "--dataset herz-jesus --feature colmap_sift_sv32")
    parser.add_argument("--dataset", type=Path, required=True, help="in Aachen's layout")
    parser.add_argument("--feature", nargs="+", default=["colmap_sift_sv32"], help="features")
    parser.add_argument("--storage", nargs="+", default=[None], help="of the points' descriptors")
    parser.add_argument("--matcher", nargs="+", default=[None], help="of queries and points")
    parser.add_argument(
        "--max_mb", type=float, nargs="*", default=[0.06, 0.03], help="sizes besides the whole"
    )
    parser.add_argument("--selection", nargs="+", default=["cover"], help=", ".join(SELECTIONS))
    parser.add_argument("--output", type=Path, default=Path("outputs/compact"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    place = Aachen(args.dataset)
    names = [name for part in place.query_lists().values() for name, _ in part]
    truth = true_poses(names, place.ground_truth, True)
    lists = [
        f"{name.split('_')[0]}: {what}"
        for name in place.query_lists()
        for what in ("inliers", "right", "median / largest cm", "s")
    ]
    print("| feature | map | KB | points |", " | ".join(lists), "|")
    print("| --- | --- | ---: | ---: |", " | ".join(["---:"] * len(lists)), "|")

    def row(feature: str, what: str, size: int, localizer: Localizer) -> None:
        number = len(localizer.reference.points)
        cells = [feature, what, f"{size / 1000:,.1f}", f"{number:,}"]
        print("|", " | ".join([*cells, *measure(localizer, place, truth)]), "|", flush=True)

    for feature in args.feature:
        folder = args.output / place.root.name / feature
        built = maps.main(folder / "map", place.images, place.reference_model, feature)
        whole = [built.features, built.descriptors, *built.sfm.glob("*.bin")]
        row(feature, "whole", sum(path.stat().st_size for path in whole), Localizer(folder / "map"))
        for storage in args.storage:
            for matcher in args.matcher:
                for selection in args.selection:
                    points.select = SELECTIONS[selection]
                    for limit in (None, *args.max_mb):
                        file = folder / "compact.hlm"
                        compact.main(
                            file, built.folder, matcher=matcher, storage=storage, max_mb=limit
                        )
                        given = filter(None, (storage, matcher, selection != "cover" and selection))
                        what = ", ".join(["compact", *map(str, given)])
                        row(feature, what, file.stat().st_size, Localizer(file))


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    cli.run(_main)
