"""Localize the queries of a place by nearest neighbours and by LightGlue, of few or many keypoints.

The place is in the layout of Aachen. With each number of --keypoints of a photo, its map is matched
by each --map_matcher, and its queries by each --matcher, with the most similar --num_loc of the map
images. Adds a row for each query list to results/lightglue.csv, leaving out what has rows unless
--again is given. Features and maps are kept in the outputs folder. Seconds are those of matching
and pose estimation of a query on one core.
"""

import os
from itertools import product
from pathlib import Path

import torch
import yaml

from benchmarks import rows, small_maps
from hloc_reduce import Localizer, maps
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import descriptor_bytes
from hloc_reduce.utils.feature_files import dimension

NAME = "lightglue"
FAST = "NN"  # the feature's own matcher


def limited(model: dict, number: int) -> dict:
    """Return the configuration of a model that extracts a number of keypoints."""
    if "base" in model:
        return {**model, "base": limited(model["base"], number)}
    return {**model, "max_keypoints": number}


def _main() -> None:
    parser = cli.Parser(__doc__, "--dataset datasets/dark-fountain-P11 --feature mini32:uint2")
    add = parser.add_argument
    add("--dataset", nargs="+", type=Path, required=True, help="places in Aachen's layout")
    help_ = "features or YAML files, with the map's storage"
    add("--feature", nargs="+", default=["mini32:uint2"], help=help_)
    add("--map_matcher", nargs="+", default=[FAST, "lightglue"], help=f"{FAST}, lightglue")
    add(
        "--matcher",
        nargs="+",
        default=[FAST, "lightglue"],
        help=f"of queries: {FAST}, lightglue, {matchers_confs.NN_LIGHTGLUE}",
    )
    add("--keypoints", nargs="+", type=int, default=[512, 1024, 2048, 4096], help="of a photo")
    add("--num_loc", nargs="+", type=int, default=[10], help="map images for a query")
    add("--outputs", type=Path, default=Path("outputs/lightglue"))
    rows.add_again_option(parser)
    args = parser.parse_args()
    if min(*args.keypoints, *args.num_loc) < 1:
        raise InputError("--keypoints and --num_loc: at least 1.")
    torch.set_num_threads(1)
    known = [] if args.again else rows.read(NAME)
    for root, given, number in product(args.dataset, args.feature, args.keypoints):
        feature, _, storage = given.partition(":")
        storage = storage or "float16"
        place, (feature, conf) = Aachen(root), features_confs.get(feature)
        names = {FAST: features_confs.matcher_of(conf)}
        folder = args.outputs / place.root.name / str(number)
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / f"{feature}.yaml"
        file.write_text(yaml.safe_dump({**conf, "model": limited(conf["model"], number)}))
        matchers_confs.confs["lightglue"]["model"]["max_keypoints"] = number
        for of_map, matcher, num_loc in product(args.map_matcher, args.matcher, args.num_loc):
            of_map, matcher = names.get(of_map, of_map), names.get(matcher, matcher)
            cells = {"place": place.root.name, "feature": feature, "storage": storage}
            variant = f"map by {of_map}, {number} keypoints, {num_loc} images"
            cells |= {"matcher": matcher, "variant": variant}
            if rows.select(known, **cells):
                continue
            built = maps.main(
                folder / f"{feature}-{storage}-{of_map}",
                place.images,
                place.reference_model,
                str(file),
                matcher=of_map,
                storage=storage,
            )
            size = sum(path.stat().st_size for path in (built.features, *built.sfm.glob("*.bin")))
            localizer = Localizer(built.folder, num_loc=num_loc, matcher=matcher)
            cells["bytes"] = descriptor_bytes(dimension(built.features), storage)
            found = small_maps.measured(localizer, place, size)
            rows.add(NAME, [cells | each for each in found])


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    cli.run(_main)
