"""Measure what a byte of a descriptor buys: matching AP and PnP inliers against its size.

Each feature is measured in each storage. AP is that of matching_ap.py, on maps that no projection
was trained on: with queries as floats, as the pipelines match them, and with both sides stored.
Codes have the levels of their projection; without any, levels are fitted to the maps of `--fit`.
Inliers are those of finished runs of pipelines.aachen. Prints Markdown tables, the largest
descriptors first.
"""

import argparse
import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch
from matching_ap import KINDS, Describe, draw_all, family, load_projections, measure

from hloc_reduce import projections
from hloc_reduce.confs import features as features_confs
from hloc_reduce.evaluation import plots
from hloc_reduce.training import levels, tracks
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import CODED, STORAGES, descriptor_bytes, restore, store
from hloc_reduce.utils.progress import progress

MEASURED = [storage for storage in STORAGES if storage != "float32"]
Row = tuple[int, str, str, list[float], list[float]]  # bytes, feature, storage, AP twice


def load(maps: dict[str, tuple[Path, Path]], descriptor: str, cache: Path) -> list[tracks.Tracks]:
    """Return the tracks of maps from `parse_maps`, described by a base descriptor."""
    return [
        tracks.load(tracks.main(images, model, cache / name, descriptor))
        for name, (images, model) in maps.items()
    ]


def stored(descriptors: torch.Tensor, storage: str, table: np.ndarray | None) -> torch.Tensor:
    """Return descriptors (N, D) as they are read from a file."""
    return torch.from_numpy(restore(*store({"descriptors": descriptors.numpy().T}, storage, table)))


def level_table(
    name: str | Path, storage: str, project: Describe, fitted: torch.Tensor | None
) -> np.ndarray | None:
    """Return the levels of a projection, or fit them to base descriptors (N, B)."""
    if storage not in CODED:
        return None
    try:
        return projections.levels(name, storage)
    except InputError:
        if fitted is None:
            raise InputError(f"{name} has no levels for {storage}. Give --fit.") from None
        return levels.fit(project(fitted), CODED[storage]).numpy()


def ap(query: Describe, reference: Describe, pairs: list[dict[str, list]]) -> list[float]:
    """Return the AP in percent of each of `KINDS`, mean over maps."""
    return [
        float(np.mean([measure(query, kinds[kind], reference) for kinds in pairs]))
        for kind in KINDS
    ]


def rows(
    features: dict[str, torch.nn.Module],
    files: dict[str, Path],
    pairs: list[dict[str, list]],
    fitted: torch.Tensor | None,
) -> Iterator[Row]:
    """Measure features in all storages; the files are those of projections that do not ship."""
    for name, project in progress(features.items(), "Measuring", "feature", len(features)):
        for storage in MEASURED:
            table = level_table(files.get(name, name), storage, project, fitted)

            def coded(base: torch.Tensor, project=project, storage=storage, table=table):
                return stored(project(base), storage, table)

            size = descriptor_bytes(project.dim, storage)
            both = ap(coded, coded, pairs)
            floats = ap(project, coded, pairs) if storage != "float16" else both
            yield size, name, storage, floats, both


def inliers(folders: list[Path]) -> list[tuple[int, str, str, dict[str, float]]]:
    """Read size, feature, storage and the mean inliers of each query list of finished runs."""
    found = []
    for folder in folders:
        path = folder / "summary.json"
        if not path.is_file():
            raise InputError(f"{folder} has no summary.json: has the run finished?")
        summary = json.loads(path.read_text())
        lists = {n.split("_")[0]: r["mean_inliers"] for n, r in summary["lists"].items()}
        size = summary["bytes_per_keypoint"]["descriptor"]
        found.append((size, summary["feature"], summary["bytes_per_keypoint"]["storage"], lists))
    return sorted(found, key=lambda row: -row[0])


def panel(axis, points: dict[str, list[tuple[int, float]]], label: str) -> None:
    """Draw the best value of each size, for each family of features."""
    for colour, (name, values) in zip(plots.COLOURS, points.items(), strict=False):
        best = {size: max(v for s, v in values if s == size) for size, _ in values}
        sizes = sorted(best)
        axis.plot(sizes, [best[s] for s in sizes], marker="o", color=colour, label=name)
    axis.set(xscale="log", xlabel="bytes of a descriptor", ylabel=label)
    axis.set_ylim(0, 1.08 * axis.get_ylim()[1])
    ticks = [2, 4, 8, 16, 32, 64, 128, 256]
    axis.set_xticks(ticks, [str(tick) for tick in ticks])
    axis.minorticks_off()


def families(values: list[tuple[int, str, float]]) -> dict[str, list[tuple[int, float]]]:
    """Group sizes and values of features by base descriptor and scheme."""
    found: dict[str, list[tuple[int, float]]] = {}
    for size, feature, value in values:
        found.setdefault(family(feature), []).append((size, value))
    return found


def _main() -> None:
    parser = cli.Parser(
        __doc__, "--map sceaux/images:sceaux/sparse --fit fox/images:fox/sparse --descriptor sift"
    )
    add = parser.add_argument
    add("--map", action="append", default=[], metavar="IMAGES:MODEL", help="map to measure AP on")
    add("--fit", action="append", default=[], metavar="IMAGES:MODEL", help="map to fit levels to")
    add("--descriptor", nargs="+", default=["sift"], help="base descriptors")
    add("--projection", type=Path, nargs="*", default=[], help="projection files, too")
    add("--schemes", nargs="+", help="only these schemes, such as sv; default: all")
    add("--cache", type=Path, default=Path("outputs/training/maps"), help="folder for the tracks")
    add("--draws", type=int, default=2, help="draws of pairs of observations")
    add("--outputs", type=Path, nargs="*", default=[], help="outputs folders of finished runs")
    add("--plot", type=Path, help="picture of the tables")
    args = parser.parse_args()
    cli.check_positive(args, "draws")
    if not args.map and not args.outputs:
        raise InputError("There is nothing to measure. Give --map or --outputs.")
    for descriptor in args.descriptor:
        cli.choose("descriptor", descriptor, features_confs.BASES)
    panels = [*(_by_ap(args) if args.map else ()), *(_by_inliers(args) if args.outputs else ())]
    if args.plot:
        plots.save(plots.figure(panels, columns=len(panels)), args.plot)


def _by_ap(args: argparse.Namespace) -> list[Callable]:
    """Measure and print AP; return its panel of the picture."""
    maps, fit = tracks.parse_maps(args.map), tracks.parse_maps(args.fit, "--fit")
    measured: list[Row] = []
    for descriptor in args.descriptor:
        pairs = [draw_all(data, args.draws) for data in load(maps, descriptor, args.cache)]
        fitted = levels.sample(load(fit, descriptor, args.cache)) if fit else None
        features = load_projections(descriptor, args.projection)
        chosen = {
            name: project
            for name, project in features.items()
            if not args.schemes
            or name == descriptor
            or any(f"_{scheme}" in name for scheme in args.schemes)
        }
        files = {file.name: file for file in args.projection}
        measured += rows(chosen, files, pairs, fitted)
    print(f"| bytes | feature | storage | {' / '.join(KINDS)} | both sides stored |")
    print("| ---: | --- | --- | ---: | ---: |")
    for size, name, storage, *both in sorted(measured, key=lambda row: -row[0]):
        cells = (" / ".join(f"{value:.1f}" for value in values) for values in both)
        print(f"| {size} | {name} | {storage} | {' | '.join(cells)} |")
    mean = families([(size, name, np.mean(ap)) for size, name, _, ap, _ in measured])
    return [partial(panel, points=mean, label="matching AP [%]")]


def _by_inliers(args: argparse.Namespace) -> list[Callable]:
    """Print the inliers of finished runs; return their panels of the picture."""
    found = inliers(args.outputs)
    print("| bytes | feature | storage | mean inliers, day | night |")
    print("| ---: | --- | --- | ---: | ---: |")
    for size, name, storage, lists in found:
        cells = " | ".join(f"{value:,.0f}" for value in lists.values())
        print(f"| {size} | {name} | {storage} | {cells} |")
    return [
        partial(
            panel,
            points=families([(size, name, lists[which]) for size, name, _, lists in found]),
            label=f"inliers, {which}",
        )
        for which in found[0][-1]
    ]


if __name__ == "__main__":
    cli.run(_main)
