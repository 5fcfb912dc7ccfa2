"""Compare features on a data set: run what is missing, print a table like the paper's, and report.

A data set is in the layout of Aachen Day-Night or of InLoc. Each feature has an outputs folder of
its own, as that of pipelines.aachen or pipelines.inloc, where a run goes on that was stopped.
"""

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path

from confs import features as features_confs
from pipelines import aachen, inloc

from . import cli, io, logger, report
from .cli import InputError
from .report import runs
from .report.runs import Run

# a folder that a layout has -> the pipeline for it
PIPELINES = {"3D-models": aachen.main, "database": inloc.main}


def main(
    dataset: Path,
    features: Iterable[str],
    outputs: Path,
    page: Path | None = None,
    retrieval: str = "vlad",
) -> tuple[list[Run], dict[str, str]]:
    """Localize the queries of a data set with several features.

    Args:
        dataset: its folder.
        features: names, or YAML files, as of the pipelines.
        outputs: folder of the outputs folders, and of compare.csv.
        page: the report; default: `<outputs>/report.html`.
        retrieval: as of the pipelines.

    Returns:
        The runs, and from each feature that failed to what was wrong.

    Raises:
        InputError: for another layout, an unknown feature, or when all failed.
    """
    pipeline = pipeline_of(dataset)
    given = {features_confs.get(feature)[0]: feature for feature in features}
    finished, failed = [], {}
    for name, feature in given.items():
        logger.info("%s:", name)
        try:
            pipeline(dataset, outputs / name, feature, retrieval=retrieval)
        except InputError as error:
            logger.error("%s failed: %s", name, error)
            failed[name] = str(error)
        else:
            finished.append(outputs / name)
    if not finished:
        raise InputError(f"None of {len(failed)} features could be run.")
    compared = runs.load(finished)
    io.write_csv(rows(compared), outputs / "compare.csv")
    report.main(finished, page or outputs / "report.html")
    return compared, failed


def pipeline_of(dataset: Path) -> Callable[..., dict]:
    """Return the pipeline for the layout of a data set.

    Raises:
        InputError: when it has none that is known.
    """
    for folder, pipeline in PIPELINES.items():
        if (dataset / folder).is_dir():
            return pipeline
    raise InputError(f"{dataset} has neither of the folders {' and '.join(PIPELINES)}.")


def rows(compared: list[Run]) -> list[dict]:
    """Return a row for each run and list: recall at its thresholds, next to the paper's."""
    found = []
    for run in compared:
        for row in runs.recall_rows(run):
            recall = row["recall"] or [None] * 3
            paper = row["paper"] or [None] * 3
            limits = row["summary"].get("thresholds_m_deg", [(None, None)] * 3)
            for (metres, degrees), ours, theirs in zip(limits, recall, paper, strict=True):
                found.append(
                    {
                        "feature": run.label,
                        "bytes": run.bytes,
                        "seconds": round(run.seconds, 1),
                        "list": row["list"],
                        "threshold_m": metres,
                        "threshold_deg": degrees,
                        "recall_percent": ours,
                        "paper_percent": theirs,
                        "mean_inliers": row["summary"]["mean_inliers"],
                    }
                )
    return found


def table(compared: list[Run]) -> str:
    """Format recall as in the paper's tables, a row for each feature and below it the paper's."""
    names = runs.lists(compared)
    lines = [["", "bytes", *map(runs.short, names)]]
    limits = {
        row["list"]: row["summary"].get("thresholds_m_deg", [])
        for run in compared
        for row in runs.recall_rows(run)
    }
    for unit, place in (("distance [m]", 0), ("orient. [deg]", 1)):
        lines.append([unit, "", *(_joined([p[place] for p in limits[n]], "g") for n in names)])
    for run in compared:
        found = {row["list"]: row for row in runs.recall_rows(run)}
        of_lists = [found.get(name, {}) for name in names]
        lines.append(
            [run.label, str(run.bytes), *(_joined(row.get("recall"), ".1f") for row in of_lists)]
        )
        if any(row.get("paper") for row in of_lists):
            paper = (_joined(row.get("paper"), ".1f") for row in of_lists)
            lines.append(["  in the paper", "", *paper])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        " | ".join(
            cell.ljust(width) if i == 0 else cell.center(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def _joined(values: list[float] | None, kind: str) -> str:
    return " / ".join(format(value, kind) for value in values) if values else "-"


def _main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python -m hloc_reduce.compare --dataset datasets/demo_town "
        "--features sift sift_sv64 sift_sv16",
        formatter_class=cli.HelpFormatter,
    )
    parser.add_argument("--dataset", type=Path, required=True, help="folder of the data set")
    parser.add_argument(
        "--features",
        nargs="+",
        required=True,
        help="see pipelines.aachen --list_features, or YAML files",
    )
    parser.add_argument(
        "--outputs",
        type=Path,
        help="folder with a folder for each feature (default: outputs/<dataset>)",
    )
    parser.add_argument(
        "-o", "--output", type=Path, help="the report (default: <outputs>/report.html)"
    )
    parser.add_argument(
        "--retrieval", default="vlad", metavar="vlad|FILE", help="as of the pipelines"
    )
    args = parser.parse_args()
    outputs = args.outputs or Path("outputs") / args.dataset.resolve().name
    compared, failed = main(args.dataset, args.features, outputs, args.output, args.retrieval)
    print(table(compared))
    if failed:
        raise InputError(f"These failed, see above: {', '.join(failed)}. The others are reported.")


if __name__ == "__main__":
    cli.run(_main)
