"""Localize the queries of a place by nearest neighbours and by LightGlue of several sizes.

The place is in the layout of Aachen. Its map is matched by each --map_matcher, its queries by each
--matcher, LightGlue with each number of --keypoints. Adds a row for each query list to
results/lightglue.csv, leaving out what has rows unless --again is given. Maps are kept in the
outputs folder. Seconds are those of matching and pose estimation of a query on one core.
"""

import os
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import torch

from benchmarks import rows, small_maps
from hloc_reduce import Localizer, maps
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.utils import cli

NAME = "lightglue"
FAST = "NN"  # the feature's own matcher


def variants(map_matchers: list[str], matchers: list[str], keypoints: list[int]) -> Iterator[tuple]:
    """Yield the matchers of the map and of queries, and the number of keypoints of LightGlue."""
    for of_map, matcher in product(map_matchers, matchers):
        if matcher == FAST:
            yield of_map, matcher, None
        else:
            yield from product([of_map], [matcher], keypoints)


def _main() -> None:
    parser = cli.Parser(__doc__, "--dataset datasets/dark-fountain-P11 --feature mini32")
    add = parser.add_argument
    add("--dataset", type=Path, required=True, help="in Aachen's layout")
    add("--feature", nargs="+", default=["mini32"], help="features")
    add("--storage", default="uint2", help="of the map's descriptors")
    add("--map_matcher", nargs="+", default=[FAST, "lightglue"], help=f"{FAST}, lightglue")
    add(
        "--matcher",
        nargs="+",
        default=[FAST, "lightglue", matchers_confs.NN_LIGHTGLUE],
        help=f"{FAST}, lightglue, {matchers_confs.NN_LIGHTGLUE}",
    )
    add("--keypoints", nargs="+", type=int, default=[512, 1024, 2048, 4096], help="of LightGlue")
    add("--outputs", type=Path, default=Path("outputs/lightglue"))
    rows.add_again_option(parser)
    args = parser.parse_args()
    torch.set_num_threads(1)
    place, model = Aachen(args.dataset), matchers_confs.confs["lightglue"]["model"]
    known = [] if args.again else rows.measured(NAME)
    default = model["max_keypoints"]
    for feature in args.feature:
        own = features_confs.matcher_of(features_confs.get(feature)[1])
        for of_map, matcher, number in variants(args.map_matcher, args.matcher, args.keypoints):
            names = {FAST: own}
            variant = f"map by {names.get(of_map, of_map)}"
            variant += f", {number} keypoints" if number else ""
            cells = {"place": place.root.name, "feature": feature, "storage": args.storage}
            cells |= {"matcher": names.get(matcher, matcher), "variant": variant}
            if rows.select(known, **cells):
                continue
            model["max_keypoints"] = default  # of the map
            folder = args.outputs / place.root.name / f"{feature}-{args.storage}-{of_map}"
            built = maps.main(
                folder,
                place.images,
                place.reference_model,
                feature,
                matcher=names.get(of_map, of_map),
                storage=args.storage,
            )
            model["max_keypoints"] = number or default
            localizer = Localizer(built.folder, matcher=cells["matcher"])
            size = sum(file.stat().st_size for file in (built.features, *built.sfm.glob("*.bin")))
            found = small_maps.measured(localizer, place, size)
            rows.add(NAME, [cells | each for each in found])


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    cli.run(_main)
