"""Average precision of nearest-neighbour matching on the tracks of maps kept out of training.

From each point of a map two observations in different images are drawn. All first descriptors are
ranked by the distance to their nearest second descriptor; correct is the same point. The columns of
the maps and their mean are for tracks as triangulated from the mutual nearest neighbours of
`sift`. "completed" adds the observations that it missed and geometry found, and "dark" takes
photometric variants (darkness, blur, noise) of the second photos, too. Prints a Markdown table of
percentages, means over several draws, with a row for each feature that ships and for each
`--projection`.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from hloc_reduce import cli, projections
from hloc_reduce.evaluation.matching import average_precision
from hloc_reduce.training import tracks
from hloc_reduce.training.__main__ import parse_maps
from hloc_reduce.training.sampling import matchable


def draw_pairs(data: tracks.Tracks, seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Draw two observations of each point: base descriptors (N, 128) as seen, seen and dark."""
    generator = np.random.default_rng(seed)
    kept, starts, lengths = matchable(data)
    first = generator.integers(lengths)
    second = (first + generator.integers(1, lengths)) % lengths
    first, second = kept[starts + first], kept[starts + second]
    variant = generator.integers(1, data.descriptors.shape[2], size=len(second))
    drawn = [(first, 0), (second, 0), (second, variant)]
    return tuple(torch.from_numpy(data.descriptors[i, 0, v]).float() for i, v in drawn)


def _main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python benchmarks/matching_ap.py --map sceaux/images:sceaux/sparse",
        formatter_class=cli.HelpFormatter,
    )
    parser.add_argument("--map", action="append", required=True, metavar="IMAGES:MODEL")
    parser.add_argument("--descriptor", default="sift", help="base descriptor")
    parser.add_argument(
        "--projection", type=Path, nargs="*", default=[], help="projection files to compare with"
    )
    parser.add_argument(
        "--cache", type=Path, default=Path("outputs/training/maps"), help="folder for the tracks"
    )
    parser.add_argument("--draws", type=int, default=5, help="draws of pairs of observations")
    args = parser.parse_args()

    pairs = {"matched": {}, "completed": {}, "dark": {}}
    for name, (images, model) in parse_maps(args.map).items():
        data = tracks.load(tracks.main(images, model, args.cache / name, args.descriptor))
        matched = data.only(data.matched)
        pairs["matched"][name] = [draw_pairs(matched, seed)[:2] for seed in range(args.draws)]
        completed = [draw_pairs(data, seed) for seed in range(args.draws)]
        pairs["completed"][name] = [(first, second) for first, second, _ in completed]
        pairs["dark"][name] = [(first, dark) for first, _, dark in completed]
    shipped = [name for name in projections.names() if name.startswith(f"{args.descriptor}_")]
    shipped.sort(key=lambda name: (name.rstrip("0123456789"), -projections.load(name).dim))
    rows = {args.descriptor: torch.nn.Identity()}
    rows |= {name: projections.load(name) for name in shipped}
    rows |= {path.stem: projections.load(path) for path in args.projection}

    points = [f"{name} ({len(draws[0][0])})" for name, draws in pairs["matched"].items()]
    print(f"| feature | {' | '.join(points)} | mean | completed | dark |")
    print("| --- |" + " ---: |" * (len(points) + 3))
    for row, project in rows.items():
        values = {
            kind: [
                np.mean([100 * average_precision(*map(project, views)) for views in draws])
                for draws in places.values()
            ]
            for kind, places in pairs.items()
        }
        cells = [*values["matched"], *map(np.mean, values.values())]
        print(f"| {row} | {' | '.join(f'{value:.2f}' for value in cells)} |")


if __name__ == "__main__":
    cli.run(_main)
