"""Measure the average precision (AP) of nearest-neighbour matching on tracks of held-out maps.

Two observations of each point of a map are drawn, in different images. All first descriptors are
ranked by the distance to their nearest second descriptor; a match is correct if it is of the same
point. The columns of the maps and their mean use the tracks as triangulated from mutual nearest
neighbours of `sift`, or of bases that have their own keypoints. "completed" adds the
observations that matching missed and geometry found; "dark" also takes photometric variants
(darkness, blur, noise) of the second photos. "photo pairs" matches one photo with another, as hloc
does: the observations of the points that both see with all observations in the other photo.

Prints Markdown tables of percentages, means over several draws: one for each base descriptor, with
its own row and one for each shipped projection and each `--projection` whose name begins with the
name of the descriptor; then one of the means by number of dimensions.
"""

import itertools
import re
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from hloc_reduce import projections
from hloc_reduce.confs import features as features_confs
from hloc_reduce.evaluation.ranking import nearest_neighbor_ap
from hloc_reduce.training import nested, tracks
from hloc_reduce.training.sampling import matchable
from hloc_reduce.training.tracks import parse_maps
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError

KINDS = ("matched", "completed", "dark", "photo pairs")
Describe = Callable[[torch.Tensor], torch.Tensor]  # base descriptors (N, B) to (N, D)
MIN_SHARED = 30  # points that a pair of photos must share


def draw_pairs(data: tracks.Tracks, seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Draw two observations of each point: base descriptors (N, B) of both, and a dark second."""
    generator = np.random.default_rng(seed)
    kept, starts, lengths = matchable(data)
    first = generator.integers(lengths)
    second = (first + generator.integers(1, lengths)) % lengths
    first, second = kept[starts + first], kept[starts + second]
    variant = generator.integers(1, data.descriptors.shape[2], size=len(second))
    drawn = [(first, 0), (second, 0), (second, variant)]
    return tuple(torch.from_numpy(data.descriptors[i, 0, v]).float() for i, v in drawn)


def photo_pairs(data: tracks.Tracks) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """List base descriptors (N, B), (M, B) of photo pairs, the first N of common points."""
    photos = []
    for image in np.unique(data.image):
        seen = np.flatnonzero(data.image == image)
        photos.append(seen[np.unique(data.track[seen], return_index=True)[1]])
    pairs = []
    for seen, others in itertools.permutations(photos, 2):
        _, first, second = np.intersect1d(
            data.track[seen], data.track[others], assume_unique=True, return_indices=True
        )
        if len(first) < MIN_SHARED:
            continue
        views = seen[first], np.concatenate([others[second], np.delete(others, second)])
        pairs.append(tuple(torch.from_numpy(data.descriptors[i, 0, 0]).float() for i in views))
    return pairs


def load_projections(descriptor: str, files: list[Path]) -> dict[str, torch.nn.Module]:
    """Load the projections of a descriptor by name, nested ones at each of their dimensions."""
    names = [name for name in projections.names() if name.rpartition("_")[0] == descriptor]
    nested_name = f"{descriptor}_nested"
    if nested_name in names:
        names.remove(nested_name)
        names += [nested_name, *(f"{nested_name}@{dim}" for dim in nested.PREFIXES[1:])]
    files = [file for file in files if file.name.lower().startswith(descriptor)]
    loaded = {name: projections.load(name) for name in names}
    loaded |= {file.name: projections.load(file) for file in files}
    order = sorted(loaded, key=lambda name: (family(name), -loaded[name].dim))
    base = torch.nn.Identity()
    base.dim = features_confs.dimension(descriptor)
    return {descriptor: base} | {name: loaded[name] for name in order}


def family(name: str) -> str:
    """Return the name of a projection without its dimension."""
    return re.sub(r"(@|_dim)?\d*(?=(\.\w+)?$)", "", name)


def draw_all(data: tracks.Tracks, draws: int) -> dict[str, list]:
    """Draw pairs of descriptors of a map, of each of `KINDS`."""
    matched = data.only(data.matched)
    completed = [draw_pairs(data, seed) for seed in range(draws)]
    return {
        "matched": [draw_pairs(matched, seed)[:2] for seed in range(draws)],
        "completed": [(first, second) for first, second, _ in completed],
        "dark": [(first, dark) for first, _, dark in completed],
        "photo pairs": photo_pairs(data),
    }


def measure(project: Describe, draws: list, reference: Describe | None = None) -> float:
    """Return the mean AP in percent of pairs, the second ones projected by `reference` if given."""
    reference = reference or project
    return np.mean([100 * nearest_neighbor_ap(project(a), reference(b)) for a, b in draws])


def _main() -> None:
    parser = cli.Parser(__doc__, "--map sceaux/images:sceaux/sparse")
    parser.add_argument("--map", action="append", required=True, metavar="IMAGES:MODEL")
    parser.add_argument(
        "--descriptor", nargs="+", default=["sift", "mkd", "tfeat"], help="base descriptors"
    )
    parser.add_argument(
        "--projection", type=Path, nargs="*", default=[], help="projection files to compare with"
    )
    parser.add_argument(
        "--cache", type=Path, default=Path("outputs/training/maps"), help="folder for the tracks"
    )
    parser.add_argument("--draws", type=int, default=5, help="draws of pairs of observations")
    args = parser.parse_args()

    for descriptor in args.descriptor:
        cli.choose("descriptor", descriptor, features_confs.BASES)
    for file in args.projection:
        if not file.name.lower().startswith(tuple(args.descriptor)):
            raise InputError(f"{file}: its name must begin with one of --descriptor.")
    if args.draws < 1:
        raise InputError("--draws: at least 1.")
    maps = parse_maps(args.map)
    means = defaultdict(dict)
    for descriptor in args.descriptor:
        pairs = {
            name: draw_all(
                tracks.load(tracks.main(images, model, args.cache / name, descriptor)), args.draws
            )
            for name, (images, model) in maps.items()
        }
        points = [f"{name} ({len(kinds['matched'][0][0])})" for name, kinds in pairs.items()]
        print(f"| feature | {' | '.join(points)} | mean | {' | '.join(KINDS[1:])} |")
        print("| --- |" + " ---: |" * (len(points) + len(KINDS)))
        for row, project in load_projections(descriptor, args.projection).items():
            values = {
                kind: [measure(project, kinds[kind]) for kinds in pairs.values()] for kind in KINDS
            }
            mean = {kind: np.mean(places) for kind, places in values.items()}
            cells = " | ".join(f"{value:.2f}" for value in (*values["matched"], *mean.values()))
            print(f"| {row} | {cells} |", flush=True)
            means[family(row)][project.dim] = " / ".join(f"{mean[kind]:.1f}" for kind in KINDS)
        print()
    dims = sorted({dim for by_dim in means.values() for dim in by_dim}, reverse=True)
    print(f"| {' / '.join(KINDS)} | {' | '.join(map(str, dims))} |")
    print("| --- |" + " ---: |" * len(dims))
    for name, by_dim in means.items():
        print(f"| {name} | {' | '.join(by_dim.get(dim, '') for dim in dims)} |")


if __name__ == "__main__":
    cli.run(_main)
