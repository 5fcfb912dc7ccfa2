"""Match photos with a compact map image by image, as `Localizer` does, and with all points at once.

At once, a photo is matched with the points of all retrieved images together, so that each keypoint
has one match, and a ratio test compares with points that only other images show. Localizes the
queries of a data set in Aachen's layout; both ways have the same features. Prints a Markdown table.
"""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from hloc_reduce import Localizer
from hloc_reduce.datasets import true_poses
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.utils import cli

Match = Callable[[np.ndarray, list[str]], dict[str, np.ndarray]]
COLUMNS = ["map", "list", "matching", "localized", "inliers", "correspondences"]
COLUMNS += ["median / largest cm", "least agreement", "matching s", "pose s"]


def at_once(localizer: Localizer) -> Match:
    """Return what matches photos with the points of all retrieved images of a compact map at once.

    Each image has the matches of the points that it shows.
    """
    engine, compact = localizer.engine, localizer.reference

    def match(descriptors: np.ndarray, names: list[str]) -> dict[str, np.ndarray]:
        visible = [compact.visible(name) for name in names]
        points = np.unique(np.concatenate([np.zeros(0, np.int64), *visible]))
        described = compact.descriptors(points, unbiased=engine.takes_codes)
        prepared = engine.prepare(descriptors), engine.prepare(described)
        [pairs] = engine.match_points(*prepared, [np.arange(len(points))])
        matched = points[pairs[:, 1]]
        return {
            name: np.stack([pairs[shown, 0], np.searchsorted(part, matched[shown])], axis=1)
            for name, part in zip(names, visible, strict=True)
            for shown in [np.isin(matched, part)]
        }

    return match


def extract_once(localizer: Localizer) -> None:
    """Have a localizer extract the features of each photo once."""
    extract, known = localizer._extract, {}

    def extracted(image: Path, flip: bool = False) -> dict:
        if (image, flip) not in known:
            known[image, flip] = extract(image, flip)
        return dict(known[image, flip])

    localizer._extract = extracted


def measure(localizer: Localizer, place: Aachen, queries: list, truth: dict) -> list[str]:
    """Return the cells of one way of matching and one query list."""
    errors, rows = [], []
    for name, camera in queries:
        pose, info = localizer.localize(place.images / name, camera)
        seconds = info["seconds"]["matching"], info["seconds"]["pose"]
        counts = info["num_inliers"], info["num_correspondences"], info["agreement"]
        rows.append([*counts, *seconds])
        if pose is not None:
            errors.append(100 * pose_error(pose, truth[name])[0])
    inliers, correspondences, agreement, matching, pose_seconds = zip(*rows, strict=True)
    return [
        f"{len(errors)} of {len(queries)}",
        f"{np.mean(inliers):,.0f}",
        f"{np.mean(correspondences):,.0f}",
        f"{np.median(errors):.2f} / {np.max(errors):.2f}" if errors else "",
        f"{np.min(agreement):.2f}",
        f"{np.mean(matching):.3f}",
        f"{np.mean(pose_seconds):.3f}",
    ]


def _main() -> None:
    parser = cli.Parser(__doc__, "--dataset herz-jesus --map place.hlm")
    parser.add_argument("--dataset", type=Path, required=True, help="in Aachen's layout")
    parser.add_argument(
        "--map", type=Path, nargs="+", required=True, help="files of hloc_reduce.compact"
    )
    args = parser.parse_args()
    torch.set_num_threads(1)
    place = Aachen(args.dataset)
    lists = place.query_lists()
    truth = true_poses(
        [name for part in lists.values() for name, _ in part], place.ground_truth, True
    )
    print("|", " | ".join(COLUMNS), "|")
    print("| --- | --- | --- |", " | ".join(["---:"] * (len(COLUMNS) - 3)), "|")
    for path in args.map:
        localizer = Localizer(path)
        extract_once(localizer)
        ways = {"image by image": localizer._match, "at once": at_once(localizer)}
        for part, queries in lists.items():
            for way, match in ways.items():
                localizer._match = match
                cells = [path.name, part.split("_")[0], way]
                cells += measure(localizer, place, queries, truth)
                print("|", " | ".join(cells), "|", flush=True)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    cli.run(_main)
