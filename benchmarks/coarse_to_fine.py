"""Measure whether matching nested descriptors coarse to fine pays: first in 16-D, then in 64-D.

Keypoints whose nearest neighbour in 16-D passes a looser ratio test are matched in 64-D, mutually
and with the ratio test. This is compared with exact matching in 64-D, 32-D and 16-D, in one thread.
Prints a Markdown table: milliseconds per pair (the least of several rounds), the number of matches,
and the share of the exact 64-D matches that is found.
"""

import itertools
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from hloc_reduce.matchers.nearest_neighbor import mutual_nearest, nearest
from hloc_reduce.utils import cli
from hloc_reduce.utils.feature_files import get_descriptors
from hloc_reduce.utils.h5 import list_h5_names, open_h5

RATIO = 0.8
LOOSER = (0.85, 0.9, 0.95)
COARSE = 16


def first(descriptors: torch.Tensor, number: int) -> torch.Tensor:
    """Return the first numbers of descriptors (N, D), normalized again."""
    return torch.nn.functional.normalize(descriptors[:, :number], dim=1)


def coarse_to_fine(
    descriptors0: torch.Tensor, descriptors1: torch.Tensor, ratio: float
) -> torch.Tensor:
    """Match the descriptors that the first numbers do not rule out; return matches0 (N,)."""
    coarse, _ = nearest(first(descriptors0, COARSE), first(descriptors1, COARSE), ratio)
    rows = torch.nonzero(coarse >= 0)[:, 0]
    matches = torch.full((len(descriptors0),), -1)
    matches[rows] = mutual_nearest(descriptors0, descriptors1, RATIO, rows)[0]
    return matches


def methods() -> dict[str, Callable[[torch.Tensor, torch.Tensor], torch.Tensor]]:
    """Return the compared methods, exact 64-D matching first."""
    compared = {
        f"first {number}": lambda a, b, number=number: mutual_nearest(
            first(a, number), first(b, number), RATIO
        )[0]
        for number in (64, 32, COARSE)
    }
    return compared | {
        f"{COARSE}, ratio {ratio}, then 64": lambda a, b, ratio=ratio: coarse_to_fine(a, b, ratio)
        for ratio in LOOSER
    }


@torch.no_grad()
def _main() -> None:
    parser = cli.Parser(__doc__, "--features feats-dog-sift_nested.h5")
    parser.add_argument("--features", type=Path, required=True, help="feature file of sift_nested")
    parser.add_argument("--images", type=int, default=8, help="images whose pairs are matched")
    parser.add_argument("--rounds", type=int, default=3, help="rounds in which all take turns")
    args = parser.parse_args()
    torch.set_num_threads(1)
    names = list_h5_names(args.features)[: args.images]
    with open_h5(args.features) as file:
        descriptors = [torch.from_numpy(get_descriptors(file, name)) for name in names]
    pairs = list(itertools.combinations(descriptors, 2))
    compared = methods()
    seconds = {name: np.full(len(pairs), np.inf) for name in compared}
    found, same = dict.fromkeys(compared, 0), dict.fromkeys(compared, 0)
    for round in range(args.rounds):
        for i, pair in enumerate(pairs):
            exact = None
            for name, match in compared.items():
                start = time.perf_counter()
                matches = match(*pair)
                seconds[name][i] = min(seconds[name][i], time.perf_counter() - start)
                exact = matches if exact is None else exact
                if round == 0:
                    found[name] += int((matches >= 0).sum())
                    same[name] += int(((matches == exact) & (exact >= 0)).sum())
    print(f"| {np.mean([len(part) for part in descriptors]):.0f} keypoints | ms | matches | same |")
    print("| --- | ---: | ---: | ---: |")
    total = next(iter(same.values()))
    for name in compared:
        share = f"{100 * same[name] / max(total, 1):.1f} %"
        print(f"| {name} | {1e3 * seconds[name].mean():.1f} | {found[name]:,} | {share} |")


if __name__ == "__main__":
    cli.run(_main)
