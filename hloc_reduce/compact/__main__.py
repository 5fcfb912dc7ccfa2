"""Command line of `hloc_reduce.compact`."""

from pathlib import Path

from ..hlm.reader import SUFFIX
from ..utils import cli
from ..utils.codes import STORAGES
from . import FEW, __doc__, main


def _main() -> None:
    parser = cli.Parser(__doc__, "--map outputs/place/map --output place.hlm --max_mb 0.5")
    add = parser.add_argument
    add("--output", type=Path, required=True, help=f"the file, {SUFFIX}")
    add("--map", type=Path, help="folder of a map of pipelines.localize")
    add("--sfm", type=Path, help="COLMAP model, instead of --map")
    add("--features", type=Path, help="feature file of its images")
    add(
        "--global_descriptors",
        type=Path,
        help="h5 file of their global descriptors, from aggregate_features (default: beside "
        "--features)",
    )
    add("--feature", help="name of the feature of --features, or its YAML file")
    add("--matcher", help="matcher of queries (default: the map's, but NN-ratio90 for NN-ratio)")
    add(
        "--storage",
        help=f"storage of the points' descriptors, one of {', '.join(STORAGES)} (default: the "
        f"map's if it stores codes, else uint4 for DoG features of up to {FEW} dimensions "
        "and uint2 for others)",
    )
    add(
        "--max_mb",
        type=float,
        help="size of the file in 1,000,000 bytes: leave out the points that images need least",
    )
    main(**vars(parser.parse_args()))


if __name__ == "__main__":
    cli.run(_main)
