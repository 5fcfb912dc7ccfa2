"""Compare features on a data set: run missing ones, print a table of recall, write a report.

A data set is in the layout of Aachen Day-Night or of InLoc. On Aachen Day-Night v1.1 and InLoc
themselves the paper's recall is shown below each feature. Each feature has its own outputs folder,
like those of pipelines.aachen and pipelines.inloc, so an interrupted comparison resumes.
"""

from collections.abc import Iterable
from pathlib import Path

from hloc_reduce import logger, report
from hloc_reduce.confs import features as features_confs
from hloc_reduce.localization.confidence import DEFAULT_GATE, Gate, add_gate_options
from hloc_reduce.report import runs
from hloc_reduce.runtime import provenance
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.files import write_csv
from hloc_reduce.utils.paths import strings_as_paths
from hloc_reduce.utils.tables import aligned, joined

from .layouts import pipeline_of
from .options import add_retrieval_option


@strings_as_paths
def main(
    dataset: Path,
    features: Iterable[str],
    outputs: Path,
    page: Path | None = None,
    retrieval: str = "vlad",
    ground_truth: Path | None = None,
    gate: Gate = DEFAULT_GATE,
) -> dict[str, str]:
    """Localize the queries of a data set with several features, print a table, write a report.

    Args:
        dataset: data set folder.
        features: names of features, or their YAML files.
        outputs: folder for compare.csv and the outputs folder of each feature.
        page: the report; default: `<outputs>/report.html`.
        retrieval: "vlad", or a file of pairs or of global descriptors.
        ground_truth: true poses of the queries; default: those that a finished run had, else
            those of the data set.
        gate: what a pose must have for the query to be called localized.

    Returns:
        The error message of each feature that failed.

    Raises:
        InputError: for an unknown layout or feature, or if all features failed.
    """
    pipeline = pipeline_of(dataset).main
    report.check()
    page = page or outputs / "report.html"
    cli.check_folder(outputs)
    cli.check_file(page, "the HTML file")
    given = {features_confs.get(feature)[0]: feature for feature in features}
    finished, failed = [], {}
    for name, feature in given.items():
        logger.info("%s:", name)
        folder = outputs / name
        before = provenance.read(folder / "summary.json").get("files", {}).get("ground_truth")
        truth = ground_truth or (before and folder / before)
        try:
            pipeline(dataset, folder, feature, retrieval=retrieval, ground_truth=truth, gate=gate)
        except (InputError, OSError) as error:
            logger.error("%s failed: %s", name, error)
            failed[name] = str(error)
        else:
            finished.append(folder)
    if not finished:
        raise InputError(f"None of {len(failed)} features could be run.")
    tables = runs.recall_tables(runs.load(finished))
    write_csv(rows(tables), outputs / "compare.csv")
    print(table(tables))
    report.main(finished, page)
    return failed


def rows(tables: list[dict]) -> list[dict]:
    """Return a row for each run, query list and threshold, with the recall and the paper's.

    Args:
        tables: from `runs.recall_tables`.
    """
    return [
        {
            "feature": row["run"].label,
            "bytes": row["run"].bytes,
            "seconds": round(row["run"].seconds, 1),
            "list": found["list"],
            "threshold_m": metres,
            "threshold_deg": degrees,
            "recall_percent": recall,
            "paper_percent": paper,
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


def _main() -> None:
    parser = cli.Parser(__doc__, "--dataset datasets/demo_town --features sift sift_sv64 sift_sv16")
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
    page = "the report (default: <outputs>/report.html)"
    parser.add_argument("-o", "--output", type=Path, dest="page", metavar="OUTPUT", help=page)
    add_retrieval_option(parser)
    parser.add_argument(
        "--ground_truth",
        type=Path,
        help="true poses of the queries (default: as in finished runs, else those of the data set)",
    )
    add_gate_options(parser)
    args = vars(parser.parse_args())
    args["outputs"] = args["outputs"] or Path("outputs") / args["dataset"].resolve().name
    gate = Gate(args.pop("min_confidence"), args.pop("min_inliers"))
    if failed := main(**args, gate=gate):
        raise InputError(
            f"These failed, see above: {', '.join(failed)}. The others are in the report."
        )


if __name__ == "__main__":
    cli.run(_main)
