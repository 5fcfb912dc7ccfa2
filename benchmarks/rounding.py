"""Count the matches that rounding to integers changes, on pairs of images of a feature file.

Matches floats as floats and as integers, by mutual nearest neighbours with each ratio test, and
prints a Markdown table: the share of the matches of either that are not those of both, and the CPU
milliseconds of each on one core.
"""

import itertools
import time
from pathlib import Path

import numpy as np
import torch

from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.matchers.nearest_neighbor import mutual_nearest
from hloc_reduce.runtime import parallel
from hloc_reduce.utils import cli
from hloc_reduce.utils.codes import to_integers
from hloc_reduce.utils.feature_files import get_descriptors
from hloc_reduce.utils.h5 import list_h5_names, open_h5


@parallel.one_thread()
def measure(described: list[np.ndarray], ratio: float | None) -> tuple[int, float, list[float]]:
    """Match all pairs of images both ways.

    Args:
        described: descriptors (N, D) float32 of each image.
        ratio: of the ratio test, None for none.

    Returns:
        The number of matches of floats, the share that differs, and seconds a pair of both ways.
    """
    both, seconds = [], []
    for convert in (torch.from_numpy, lambda part: torch.from_numpy(to_integers(part))):
        start = time.thread_time()
        found = [
            mutual_nearest(convert(a), convert(b), ratio)[0].numpy()
            for a, b in itertools.combinations(described, 2)
        ]
        seconds.append((time.thread_time() - start) / len(found))
        both.append(np.concatenate(found))
    floats, rounded = both
    is_match = (floats >= 0) | (rounded >= 0)
    return int((floats >= 0).sum()), float((floats != rounded)[is_match].mean()), seconds


def _main() -> None:
    parser = cli.Parser(__doc__, "--features outputs/place/feats-mini64.h5")
    parser.add_argument("--features", type=Path, required=True, help="feature file with floats")
    parser.add_argument("--images", type=int, default=10, help="images of it, evenly chosen")
    args = parser.parse_args()
    cli.check_positive(args, "images")
    names = list_h5_names(args.features)
    with open_h5(args.features) as file:
        chosen = names[:: -(-len(names) // args.images)]
        described = [get_descriptors(file, name) for name in chosen]
    print("| matcher | matches | differ | floats [ms] | integers [ms] |\n| --- |" + 4 * " ---: |")
    for name, conf in matchers_confs.confs.items():
        number, share, (floats, integers) = measure(described, conf["model"].get("ratio_threshold"))
        milliseconds = f"{1000 * floats:.1f} | {1000 * integers:.1f}"
        print(f"| {name} | {number:,} | {share:.3%} | {milliseconds} |", flush=True)


if __name__ == "__main__":
    cli.run(_main)
