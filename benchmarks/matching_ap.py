"""Average precision of nearest-neighbour matching on the tracks of maps kept out of training.

From each point of a map two observations in different images are drawn. All first descriptors are
ranked by the distance to their nearest second descriptor; correct is the same point. "dark" is the
same with photometric variants (darkness, blur, noise) of the second photos. Prints a Markdown
table of percentages, means over several draws, with a row for each feature that ships and for each
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


def draw_pairs(data: tracks.Tracks, seed: int) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """Draw two observations of each point: base descriptors (N, 128), as seen and dark."""
    generator = np.random.default_rng(seed)
    kept, starts, lengths = matchable(data)
    first = generator.integers(lengths)
    second = (first + generator.integers(1, lengths)) % lengths
    first, second = kept[starts + first], kept[starts + second]
    photos = data.descriptors[:, 0]
    variant = generator.integers(1, photos.shape[1], size=len(second))
    anchors = torch.from_numpy(photos[first, 0]).float()
    return {
        "photo": (anchors, torch.from_numpy(photos[second, 0]).float()),
        "dark": (anchors, torch.from_numpy(photos[second, variant]).float()),
    }


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

    pairs = {}
    for name, (images, model) in parse_maps(args.map).items():
        data = tracks.load(tracks.main(images, model, args.cache / name, args.descriptor))
        pairs[name] = [draw_pairs(data, seed) for seed in range(args.draws)]
    shipped = [name for name in projections.names() if name.startswith(f"{args.descriptor}_")]
    shipped.sort(key=lambda name: (name.rstrip("0123456789"), -projections.load(name).dim))
    rows = {args.descriptor: torch.nn.Identity()}
    rows |= {name: projections.load(name) for name in shipped}
    rows |= {path.stem: projections.load(path) for path in args.projection}

    points = [f"{name} ({len(sets[0]['photo'][0])})" for name, sets in pairs.items()]
    print(f"| feature | {' | '.join(points)} | mean | mean dark |")
    print("| --- |" + " ---: |" * (len(pairs) + 2))
    for row, project in rows.items():
        values = {
            kind: [
                np.mean([100 * average_precision(*map(project, sets[kind])) for sets in draws])
                for draws in pairs.values()
            ]
            for kind in ("photo", "dark")
        }
        cells = [*values["photo"], np.mean(values["photo"]), np.mean(values["dark"])]
        print(f"| {row} | {' | '.join(f'{value:.2f}' for value in cells)} |")


if __name__ == "__main__":
    cli.run(_main)
