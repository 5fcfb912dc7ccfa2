"""Compare features on a data set: run missing ones, print a table of recall, write a report.

A data set is in the layout of Aachen Day-Night or of InLoc. On Aachen Day-Night v1.1 and InLoc
themselves the paper's recall is shown below each feature. Each feature has its own outputs folder,
like those of pipelines.aachen and pipelines.inloc, so an interrupted comparison resumes. With
--max_mb, compact maps of these sizes are compared, too, and accuracy is drawn against megabytes.
"""

from collections.abc import Callable, Iterable
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Annotated, Any

from hloc_reduce import logger, report
from hloc_reduce.confs import features as features_confs
from hloc_reduce.evaluation import plots
from hloc_reduce.localization.gate import DEFAULT_GATE, Gate
from hloc_reduce.report import runs
from hloc_reduce.runtime import provenance
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import STORAGES
from hloc_reduce.utils.files import MEGABYTE, write_csv
from hloc_reduce.utils.options import ABOVE_0, Option, Parser, taken
from hloc_reduce.utils.paths import strings_as_paths
from hloc_reduce.utils.tables import aligned, joined

from . import aachen
from .common import compact_map
from .common.options import Retrieval
from .layouts import pipeline_of


@strings_as_paths
def main(
    dataset: Path,
    features: Iterable[str],
    outputs: Path,
    page: Annotated[Path, Option(flags=("-o", "--output"))] | None = None,
    retrieval: Retrieval = "vlad",
    ground_truth: Path | None = None,
    gate: Gate = DEFAULT_GATE,
    max_mb: Annotated[Iterable[float], ABOVE_0] = (),
    storages: Annotated[Iterable[str], Option("storage", STORAGES, flags=("--storage",))] = (),
) -> dict[str, str]:
    """Localize the queries of a data set with several features, print a table, write a report.

    With `max_mb`, also in compact maps of each feature, which share its features and map. Then
    compare.svg is drawn, too.

    Args:
        dataset: folder of the data set.
        features: names of features, see pipelines.aachen --list_features, or their YAML files.
        outputs: folder for compare.csv, with a folder for each feature; default: outputs/<dataset>.
        page: the report; default: <outputs>/report.html.
        retrieval: a name (those of networks need an installed hloc), or hloc's text file of pairs
            or h5 file of global descriptors.
        ground_truth: true poses of the queries; default: as in finished runs, else those of the
            data set.
        gate: what a pose must have for the query to be called localized.
        max_mb: sizes of compact maps in 1,000,000 bytes, to be compared with the whole maps. Those
            above the first one that all points fit into are left out.
        storages: run each feature with each of these storages of map descriptors; default: float16.

    Returns:
        The error message of each feature, storage and size of a map that failed.

    Raises:
        InputError: for an unknown layout or feature, or if all features failed.
    """
    pipeline, sizes = pipeline_of(dataset).main, sorted(set(max_mb))
    _check_sizes(dataset, sizes, retrieval)
    report.check()
    page = page or outputs / "report.html"
    cli.check_folder(outputs)
    cli.check_file(page, "the HTML file")
    storages = list(dict.fromkeys(storages)) or STORAGES[:1]
    for storage in storages:
        cli.choose("storage", storage, STORAGES)
    if sizes and len(storages) > 1:
        raise InputError("Give one --storage with --max_mb.")
    given = {features_confs.get(feature)[0]: feature for feature in features}
    finished: list[Path] = []
    failed: dict[str, str] = {}
    for (name, feature), storage in product(given.items(), storages):
        coded = storage != STORAGES[0]
        folder = outputs / (f"{name}+{storage}" if coded else name)
        before = provenance.read(folder / "summary.json").get("files", {}).get("ground_truth")
        truth = ground_truth or (before and folder / before)
        options = {"retrieval": retrieval, "ground_truth": truth, "gate": gate, "storage": storage}
        run = partial(pipeline, dataset, folder, feature, **options)
        label = f"{name}, {storage}" if coded else name
        finished += _run_sizes(run, label, folder, sizes, failed)
    if not finished:
        raise InputError(f"None of {len(given)} features could be run.")
    compared = runs.load(finished)
    tables = runs.recall_tables(compared)
    write_csv(rows(tables), outputs / "compare.csv")
    print((size_table if sizes else table)(tables))
    if panels := [*report.map_panels(compared).values()]:
        plots.save(plots.figure(panels, len(panels)), outputs / "compare.svg")
    report.main(finished, page)
    return failed


def _check_sizes(dataset: Path, sizes: list[float], retrieval: str) -> None:
    """Raise an InputError for sizes of compact maps that cannot be compared."""
    if sizes and pipeline_of(dataset) is not aachen:
        raise InputError(
            "--max_mb is for data sets in the layout of Aachen: others have no compact maps."
        )
    for size in sizes:
        aachen.Options(compact=True, max_mb=size, retrieval=retrieval)  # raises for wrong ones


def _run_sizes(
    run: Callable[..., dict], name: str, outputs: Path, sizes: list[float], failed: dict[str, str]
) -> list[Path]:
    """Localize in the whole map of a feature, then in compact ones, until all points fit into one.

    Args:
        run: the pipeline, which takes the options of compact maps.
        name: the feature, with its storage.
        outputs: its outputs folder.
        sizes: of compact maps, ascending.
        failed: messages of failed runs, to which those of this feature are added.

    Returns:
        The folders of finished runs.
    """
    finished: list[Path] = []
    whole: dict[str, Any] = {}
    maps: dict[str, dict[str, Any]] = {name: {}}
    maps |= {f"{name}, at most {size:g} MB": {"compact": True, "max_mb": size} for size in sizes}
    for label, options in maps.items():
        logger.info("%s:", label)
        try:
            summary = run(**options)
        except (InputError, OSError) as error:
            logger.error("%s failed: %s", label, error)
            failed[label] = str(error)
            if not options:
                break
            continue
        finished.append(compact_map.folder(outputs, bool(options), options.get("max_mb")))
        whole = whole or summary
        if options and summary["map_points3D"] == whole["map_points3D"]:
            logger.info("%s: all points fit.", label)
            break
    return finished


def rows(tables: list[dict]) -> list[dict]:
    """Return a row for each run, query list and threshold, with the recall and the paper's.

    Args:
        tables: from `runs.recall_tables`.
    """
    return [
        {
            "feature": row["run"].label,
            "bytes": row["run"].bytes,
            "map_bytes": row["run"].map_bytes,
            "hloc_bytes": row["run"].hloc_bytes,
            "seconds": round(row["run"].seconds, 1),
            "list": found["list"],
            "threshold_m": metres,
            "threshold_deg": degrees,
            "recall_percent": recall,
            "paper_percent": paper,
            "median_position_error_m": row["summary"].get("median_position_error_m"),
            "mean_inliers": row["summary"]["mean_inliers"],
        }
        for found in tables
        for row in found["rows"]
        for (metres, degrees), recall, paper in zip(
            found["thresholds"] or [(None, None)],
            row["recall"] or [None],
            row["paper"] or [None] * max(1, len(found["thresholds"])),
            strict=True,
        )
    ]


def table(tables: list[dict]) -> str:
    """Format recall, one row per feature, followed by the paper's if it has any."""
    lines = [["", "bytes", *(found["list"] for found in tables)]]
    for unit, place in (("distance [m]", 0), ("orient. [deg]", 1)):
        limits = [[limit[place] for limit in found["thresholds"]] for found in tables]
        lines.append([unit, "", *(joined(values, "g") for values in limits)])
    compared = dict.fromkeys(row["run"].label for found in tables for row in found["rows"])
    for label in compared:
        of_lists = [
            next((row for row in found["rows"] if row["run"].label == label), None)
            for found in tables
        ]
        (size,) = {row["run"].bytes for row in of_lists if row}
        recall = (joined(row and row["recall"], ".1f") for row in of_lists)
        lines.append([label, str(size), *recall])
        paper = [joined(row and row["paper"], ".1f") for row in of_lists]
        if set(paper) != {"-"}:
            lines.append(["  in the paper", "", *paper])
    return aligned(lines)


def size_table(tables: list[dict]) -> str:
    """Format recall, median errors and inliers, one row per map, and the size of hloc's files."""
    heads = [[found["list"], "error [cm]", "inliers"] for found in tables]
    lines = [["", "MB", *chain(*heads)]]
    for unit, place in (("distance [m]", 0), ("orient. [deg]", 1)):
        limits = [[limit[place] for limit in found["thresholds"]] for found in tables]
        lines.append([unit, "", *chain(*([joined(values, "g"), "", ""] for values in limits))])
    for of_lists in zip(*(found["rows"] for found in tables), strict=True):
        run = of_lists[0]["run"]
        cells = chain(*(_accuracy(row["recall"], row["summary"]) for row in of_lists))
        lines.append([run.label, _megabytes(run.map_bytes), *cells])
        if run.hloc_bytes:
            lines.append(["  as hloc's files", _megabytes(run.hloc_bytes), *[""] * 3 * len(tables)])
    return aligned(lines)


def _accuracy(recall: list[float | None], summary: dict) -> list[str]:
    """Return the cells of a list: recall, median error, inliers."""
    error = summary.get("median_position_error_m")
    cm = None if error is None else 100 * error
    return [joined(recall, ".1f"), joined([cm], ".2f"), f"{summary['mean_inliers']:,.0f}"]


def _megabytes(size: int | None) -> str:
    return joined([size and size / MEGABYTE], ".3g")


def _main() -> None:
    example = "--dataset datasets/demo_town --features sift sift_sv64 sift_sv16"
    parser = Parser(__doc__, example)
    parser.add(main, outputs=None)
    given = taken(main, parser.read())
    given["outputs"] = given["outputs"] or Path("outputs") / given["dataset"].resolve().name
    if failed := main(**given):
        raise InputError(
            f"These failed, see above: {', '.join(failed)}. The others are in the report."
        )


if __name__ == "__main__":
    cli.run(_main)
