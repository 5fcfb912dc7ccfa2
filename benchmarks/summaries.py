"""Print a Markdown table of finished runs of any pipeline, with a row for each query list.

With --centimetres, recall is at these position errors and 2 degrees instead of the limits of the
data set. With --places, a row is a run's folder name, and a column a query list of a data set: mean
inliers, and how many queries are localized where some are not. Runs of a batch share features, so
only one of them has seconds of extraction. What is no outputs folder of a finished run, such as a
report beside the folders, is named and left out.
"""

import csv
import json
from pathlib import Path

from hloc_reduce import logger
from hloc_reduce.evaluation.poses import ERRORS, counted_errors, recall
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError

COLUMNS = {
    "feature": "---",
    "bytes": "---:",
    "list": "---",
    "localized": "---:",
    "recall [%]": "---:",
    "median error": "---:",
    "mean inliers": "---:",
    "keypoints": "---:",
    "points": "---:",
    "extraction [s]": "---:",
    "all [s]": "---:",
}
DEGREES = 2.0


def rows(folder: Path, centimetres: list[float]) -> list[dict[str, str]]:
    """Return a row, cells by `COLUMNS`, for each query list of a finished run."""
    summary, listed = json.loads((folder / "summary.json").read_text()), []
    size, seconds = summary["bytes_per_keypoint"], summary["seconds"]
    # pipelines.localize extracts the queries only: its map has features
    photos = summary["queries"] + ("map" not in summary) * summary["map_images"]
    extraction = seconds.get("extract_features")
    images = size.get("images")  # older summaries have none
    for name, result in summary["lists"].items():
        percent = result.get("recall_percent", [])
        if centimetres:
            percent = _recall(folder / "queries.csv", name, centimetres)
        error = (
            f"{100 * result['median_position_error_m']:.2f} cm, "
            f"{result['median_rotation_error_deg']:.3f}°"
            if result.get("median_position_error_m") is not None
            else ""
        )
        cells = (
            summary["feature"],
            size["descriptor"],
            name.split("_")[0],
            f"{result['localized']} of {result['queries']}",
            " / ".join(f"{value:.1f}" for value in percent),
            error,
            f"{result['mean_inliers']:,.0f}",
            f"{size['keypoints'] / images:,.0f}" if images else "",
            f"{summary['map_points3D']:,}" if "map_points3D" in summary else "",
            "" if extraction is None else f"{extraction / photos:.2f}",
            f"{sum(seconds.values()):.0f}",
        )
        listed.append(dict(zip(COLUMNS, map(str, cells), strict=True)))
    return listed


def by_list(folders: list[Path], centimetres: list[float]) -> list[str]:
    """Format a table with a row for each query list of each run."""
    found = [row.values() for folder in folders for row in rows(folder, centimetres)]
    return [f"| {' | '.join(cells)} |" for cells in (COLUMNS, COLUMNS.values(), *found)]


def by_place(folders: list[Path]) -> list[str]:
    """Format a table with a row for each folder name and a column for each query list."""
    cells: dict[tuple[int, str], dict[str, str]] = {}
    for folder in folders:
        summary = json.loads((folder / "summary.json").read_text())
        row = cells.setdefault((-summary["bytes_per_keypoint"]["descriptor"], folder.name), {})
        for name, result in summary["lists"].items():
            missed = result["localized"] < result["queries"]
            count = f" ({result['localized']} of {result['queries']})" if missed else ""
            place = Path(summary.get("dataset") or summary["map"]).name
            place = f"{place}, {name.split('_')[0]}"
            row[place] = f"{result['mean_inliers']:,.0f}{count}"
    places = list(dict.fromkeys(place for row in cells.values() for place in row))
    lines = [
        f"| bytes | feature | {' | '.join(places)} |",
        "| ---: | --- |" + " ---: |" * len(places),
    ]
    for (size, feature), row in sorted(cells.items()):
        lines.append(f"| {-size} | {feature} | {' | '.join(row.get(p, '') for p in places)} |")
    return lines


def _recall(queries: Path, name: str, centimetres: list[float]) -> list[float]:
    """Return recall in percent at position errors, of a list in queries.csv."""
    with queries.open() as file:
        listed = [row for row in csv.DictReader(file) if row["list"] == name]
    known = [row | {key: float(row[key]) for key in ERRORS} for row in listed if row[ERRORS[0]]]
    return recall(counted_errors(known), [(value / 100, DEGREES) for value in centimetres])


def _main() -> None:
    parser = cli.Parser(__doc__, "outputs/demo_town/*")
    add = parser.add_argument
    add("outputs", type=Path, nargs="+", help="outputs folders of runs")
    how = parser.add_mutually_exclusive_group()
    how.add_argument(
        "--centimetres", type=float, nargs="+", default=[], help="position errors for recall"
    )
    how.add_argument(
        "--places", action="store_true", help="a row for each feature, a column for each list"
    )
    args = parser.parse_args()
    finished = [folder for folder in args.outputs if (folder / "summary.json").is_file()]
    others = ", ".join(str(path) for path in args.outputs if path not in finished)
    if not finished:
        raise InputError(f"There is no summary.json in {others}: has the run finished?")
    if others:
        logger.warning("Left out, no finished runs: %s.", others)
    lines = by_place(finished) if args.places else by_list(finished, args.centimetres)
    print("\n".join(lines))


if __name__ == "__main__":
    cli.run(_main)
