"""Measure the matching AP of descriptors that are stored as float16 and as uint8.

Pairs are drawn from the tracks of maps as by matching_ap.py. The descriptors of a draw, or of a
photo, are quantized together, like those of an image in a feature file. Prints a Markdown table of
bytes per keypoint and percentages, means over the maps.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from matching_ap import KINDS, draw_all, measure

from hloc_reduce import projections
from hloc_reduce.training import tracks
from hloc_reduce.training.tracks import parse_maps
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import restore, store

COMPARED = ("float16", "uint8")


def through_file(project: Callable[[torch.Tensor], torch.Tensor], storage: str) -> Callable:
    """Return a projection that also quantizes descriptors as a feature file does."""

    def stored(descriptors: torch.Tensor) -> torch.Tensor:
        arrays, attrs = store({"descriptors": project(descriptors).numpy().T}, storage)
        return torch.from_numpy(restore(arrays, attrs))

    return stored


def _main() -> None:
    parser = cli.Parser(__doc__, "--feature sift_sv16 --map sceaux/images:sceaux/sparse")
    parser.add_argument("--map", action="append", required=True, metavar="IMAGES:MODEL")
    parser.add_argument(
        "--feature", nargs="+", default=["sift_sv64", "sift_sv32", "sift_sv24", "sift_sv16"]
    )
    parser.add_argument(
        "--cache", type=Path, default=Path("outputs/training/maps"), help="folder for the tracks"
    )
    parser.add_argument("--draws", type=int, default=5, help="draws of pairs of observations")
    args = parser.parse_args()
    loaded = {name: projections.load(name) for name in args.feature}
    if len({project.metadata["descriptor"] for project in loaded.values()}) > 1:
        raise InputError("--feature: projections of one base descriptor.")
    descriptor = next(iter(loaded.values())).metadata["descriptor"]
    data = [
        draw_all(
            tracks.load(tracks.main(images, model, args.cache / name, descriptor)),
            args.draws,
        )
        for name, (images, model) in parse_maps(args.map).items()
    ]
    print(f"| feature | bytes | {' | '.join(KINDS)} |\n| --- | ---: |" + " ---: |" * len(KINDS))
    for name, project in loaded.items():
        for storage in COMPARED:
            size = np.dtype(storage).itemsize * project.dim
            values = [
                np.mean([measure(through_file(project, storage), kinds[kind]) for kinds in data])
                for kind in KINDS
            ]
            cells = " | ".join(f"{value:.2f}" for value in values)
            print(f"| {name}, {storage} | {size} | {cells} |", flush=True)


if __name__ == "__main__":
    cli.run(_main)
