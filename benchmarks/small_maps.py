"""Localize the queries of a place in compact maps of several sizes and in the whole map.

The place is in the layout of Aachen. Adds a row for each query list of each map to
results/maps.csv, leaving out those that have rows unless --again is given. Maps are kept in the
outputs folder. Seconds are those of matching and pose estimation of a query. With --selection, the
points of limited maps are those that other rankings put first.
"""

import os
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
import pycolmap
import torch

from benchmarks import rows, selections
from hloc_reduce import Localizer, compact, maps
from hloc_reduce.compact import Ranking
from hloc_reduce.datasets import true_poses
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.evaluation.poses import FAILED, pose_error
from hloc_reduce.hlm.points import Points
from hloc_reduce.maps.contents import Engine
from hloc_reduce.utils import cli
from hloc_reduce.utils.files import MEGABYTE

NAME = "maps"
WHOLE, ALL_POINTS = "whole map", "all points"
OURS = "ours"
RANKINGS = {OURS: None} | selections.RANKINGS


class Remembering:
    """An engine that extracts the features of each photo only once.

    Args:
        engine: see `Localizer.engine`.
        known: the features of photos, which this adds to.
    """

    def __init__(self, engine: Engine, known: dict[tuple, dict]):
        self._engine, self._known = engine, known
        self.rotation_invariant, self.matching = engine.rotation_invariant, engine.matching

    def extract(
        self, image: Path | np.ndarray, preprocessing: dict, mask: np.ndarray | None = None
    ) -> dict:
        """Return the features of a photo, see `Engine.extract`."""
        key = image, repr(sorted(preprocessing.items()))
        if key not in self._known:
            self._known[key] = self._engine.extract(image, preprocessing, mask)
        return dict(self._known[key])


def measured(
    localizer: Localizer, place: Aachen, size: int, parts: dict[str, int]
) -> Iterator[dict[str, object]]:
    """Yield the cells of each query list, localized in a map of `size` bytes.

    Args:
        localizer: in the map.
        place: whose queries these are.
        size: bytes of the map.
        parts: of a compact map, the bytes of each part.
    """
    lists = place.query_lists()
    names = [name for part in lists.values() for name, _ in part]
    truth = true_poses(names, place.ground_truth, True)
    for name, queries in lists.items():
        errors, inliers, seconds = [], [], []
        for query, camera in queries:
            pose, info = localizer.localize(place.images / query, camera)
            inliers.append(info["num_inliers"])
            seconds.append(info["seconds"]["matching"] + info["seconds"]["pose"])
            errors.append(FAILED if pose is None else pose_error(pose, truth[query]))
        yield {
            "list": name.split("_")[0],
            "photos": len(place.map_names()),
            "points": len(localizer.reference.points),
            "mb": size / MEGABYTE,
            "images": len(localizer.names),
            **{f"{part}_bytes": size for part, size in parts.items()},
            **rows.localization(errors, inliers, sum(error != FAILED for error in errors)),
            **rows.how(float(np.mean(seconds)), cores=1),
        }


def _once(rank: Ranking) -> Ranking:
    """Return a function that ranks points when it is called first, for one map."""
    known: list[np.ndarray] = []

    def ranked(points: Points, model: pycolmap.Reconstruction) -> np.ndarray:
        if not known:
            known.append(rank(points, model))
        return known[0]

    return ranked


def _main() -> None:
    parser = cli.Parser(__doc__, "--dataset datasets/herz-jesus --feature colmap_sift_sv32")
    add = parser.add_argument
    add("--dataset", type=Path, required=True, help="in Aachen's layout")
    add("--feature", nargs="+", default=["colmap_sift_sv32"], help="features")
    add("--storage", nargs="+", default=["uint4"], help="of the points' descriptors")
    add("--matcher", default="", help="of queries and points; default: the feature's")
    add("--max_mb", type=float, nargs="*", default=[0.03, 0.06], help="sizes besides all points")
    add("--selection", nargs="+", default=[OURS], choices=RANKINGS, help="of points for a size")
    add("--outputs", type=Path, default=Path("outputs/small_maps"))
    rows.add_again_option(parser)
    args = parser.parse_args()
    torch.set_num_threads(1)
    place = Aachen(args.dataset)
    known = [] if args.again else rows.read(NAME)

    for feature in args.feature:
        base = {"place": place.root.name, "feature": feature, "matcher": args.matcher}
        todo, limits = [], dict[str, tuple[float | None, str]]()
        if args.selection == [OURS]:
            todo += [base | {"storage": "float16", "variant": WHOLE}] if not args.matcher else []
            limits[ALL_POINTS] = None, OURS
        for limit, name in product(args.max_mb, args.selection):
            limits[f"at most {limit:g} MB" + f", {name}" * (name != OURS)] = limit, name
        todo += [
            base | {"storage": storage, "variant": variant}
            for storage, variant in product(args.storage, limits)
        ]
        todo = [cells for cells in todo if not rows.select(known, **cells)]
        if not todo:
            continue
        described: dict[tuple, dict] = {}
        rankings = {name: rank and _once(rank) for name, rank in RANKINGS.items()}
        folder = args.outputs / place.root.name / feature
        built = maps.main(folder / "map", place.images, place.reference_model, feature)
        source = compact.of_map(built)
        for cells in todo:
            parts: dict[str, int] = {}
            if cells["variant"] == WHOLE:
                path = built.folder
                files = [built.features, built.descriptors, *built.sfm.glob("*.bin")]
                size = sum(file.stat().st_size for file in files)
            else:
                path = folder / "compact.hlm"
                (limit, name), matcher = limits[cells["variant"]], args.matcher or None
                given = source, built.features, matcher, cells["storage"], limit
                parts = compact.write(path, *given, rank=rankings[name])
                size = path.stat().st_size
            localizer = Localizer(path)
            localizer.engine = Remembering(localizer.engine, described)
            found = measured(localizer, place, size, parts)
            rows.add(NAME, [cells | each for each in found])


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    cli.run(_main)
