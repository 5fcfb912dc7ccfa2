"""Measure the average precision (AP) of nearest-neighbour matching on tracks of held-out maps.

Two observations of each point of a map are drawn, in different images. All first descriptors are
ranked by the distance to their nearest second descriptor; a match is correct if it is of the same
point. "matched" uses the tracks as triangulated from mutual nearest neighbours of `sift`, or of
bases that have their own keypoints. "completed" adds the observations that matching missed and
geometry found; "dark" also takes photometric variants (darkness, blur, noise) of the second photos.
"photo pairs" matches one photo with another, as hloc does: the observations of the points that both
see with all observations in the other photo. Second descriptors are stored as those of a map are.

Adds rows of AP in percent, means over several draws and all maps, to results/matching_ap.csv, for
each base descriptor and each of its shipped projections and files whose name begins with its name.
"""

import itertools
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from benchmarks import rows
from hloc_reduce import logger, projections
from hloc_reduce.confs import features as features_confs
from hloc_reduce.evaluation.ranking import nearest_neighbor_ap
from hloc_reduce.training import nested, tracks
from hloc_reduce.training.sampling import matchable
from hloc_reduce.training.tracks import parse_maps
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import CODED, STORAGES, descriptor_bytes, restore, store

NAME = "matching_ap"
KINDS = ("matched", "completed", "dark", "photo pairs")
MIN_SHARED = 30  # points that a pair of photos must share
Describe = Callable[[torch.Tensor], torch.Tensor]  # base descriptors (N, B) to (N, D)


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


def load_projections(descriptor: str, files: list[Path]) -> dict[str, torch.nn.Module]:
    """Load the projections of a descriptor by name, nested ones at each of their dimensions."""
    names = [name for name in projections.names() if name.rpartition("_")[0] == descriptor]
    nested_name = f"{descriptor}_nested"
    if nested_name in names:
        names += [f"{nested_name}@{dim}" for dim in nested.PREFIXES[1:]]
    files = [file for file in files if file.name.lower().startswith(descriptor)]
    base = torch.nn.Identity()
    base.dim = features_confs.dimension(descriptor)
    loaded = {name: projections.load(name) for name in names}
    return {descriptor: base} | loaded | {file.stem: projections.load(file) for file in files}


def stored(project: Describe, name: str, storage: str) -> Describe:
    """Return what projects descriptors and rounds them as in a file of this storage."""
    table = projections.levels(name, storage) if storage in CODED else None

    def describe(base: torch.Tensor) -> torch.Tensor:
        written = store({"descriptors": project(base).numpy().T}, storage, table)
        return torch.from_numpy(restore(*written))

    return describe


def measure(project: Describe, draws: list, reference: Describe) -> float:
    """Return the mean AP in percent of pairs, the second ones projected by `reference`."""
    return float(np.mean([100 * nearest_neighbor_ap(project(a), reference(b)) for a, b in draws]))


def _main() -> None:
    parser = cli.Parser(__doc__, "--map scenes/sceaux/images:scenes/sceaux/sparse")
    add = parser.add_argument
    add("--map", action="append", required=True, metavar="IMAGES:MODEL")
    add("--descriptor", nargs="+", default=["sift", "mkd", "tfeat"], help="base descriptors")
    add("--projection", type=Path, nargs="*", default=[], help="projection files, too")
    add("--storage", nargs="+", default=["float16"], help=f"of {', '.join(STORAGES)}")
    add("--cache", type=Path, default=Path("outputs/training/maps"), help="folder for the tracks")
    add("--draws", type=int, default=5, help="draws of pairs of observations")
    rows.add_again_option(parser)
    args = parser.parse_args()
    cli.check_positive(args, "draws")
    for descriptor in args.descriptor:
        cli.choose("descriptor", descriptor, features_confs.BASES)
    for storage in args.storage:
        cli.choose("storage", storage, STORAGES)
    known = [] if args.again else rows.read(NAME)
    maps = parse_maps(args.map)
    places = ", ".join(maps)
    for descriptor in args.descriptor:
        todo = [
            (name, project, storage)
            for name, project in load_projections(descriptor, args.projection).items()
            for storage in args.storage
            if not rows.select(known, place=places, feature=name, storage=storage)
        ]
        if not todo:
            continue
        files = [
            tracks.main(images, model, args.cache / place, descriptor)
            for place, (images, model) in maps.items()
        ]
        pairs = [draw_all(tracks.load(file), args.draws) for file in files]
        for name, project, storage in todo:
            start = time.perf_counter()
            try:
                reference = stored(project, name, storage)
            except InputError:
                logger.info("Left out: %s has no levels for %s.", name, storage)
                continue
            cells = {"place": places, "feature": name, "storage": storage}
            cells |= {"bytes": descriptor_bytes(project.dim, storage)}
            found = {}
            for kind in KINDS:
                of_maps = [measure(project, of_map[kind], reference) for of_map in pairs]
                found[kind] = float(np.mean(of_maps))
            cells |= rows.how(time.perf_counter() - start, torch.get_num_threads())
            rows.add(NAME, [cells | {"list": kind, "ap": ap} for kind, ap in found.items()])


if __name__ == "__main__":
    cli.run(_main)
