"""Print a Markdown table of finished runs of any pipeline, with a row for each query list.

With --centimetres, recall is at these position errors and 2 degrees instead of the limits of the
data set. With --places, a row is a run's folder name, and a column a query list of a data set: mean
inliers, and how many queries are localized where some are not. With --centimetres, too, further
columns sum up all places: keypoints of a photo, points, localized queries, and recall of those
whose pose is known. Runs of a batch share features, so only one of them has seconds of extraction.
What is no outputs folder of a finished run, such as a report beside the folders, is named and left
out.
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
        percent = " / ".join(f"{value:.1f}" for value in result.get("recall_percent", []))
        if centimetres:
            percent = _percent(_errors(folder / "queries.csv", name), centimetres)
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
            percent,
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


def by_place(folders: list[Path], centimetres: list[float]) -> list[str]:
    """Format a table with a row for each folder name and a column for each query list."""
    runs: dict[tuple[int, str], list[tuple[Path, dict]]] = {}
    for folder in folders:
        summary = json.loads((folder / "summary.json").read_text())
        key = -summary["bytes_per_keypoint"]["descriptor"], folder.name
        runs.setdefault(key, []).append((folder, summary))
    found = {
        (str(-size), name): _of_lists(its_runs) | _of_all(its_runs, centimetres)
        for (size, name), its_runs in sorted(runs.items())
    }
    columns = list(dict.fromkeys(column for row in found.values() for column in row))
    lines = [["bytes", "feature", *columns], ["---:", "---", *["---:"] * len(columns)]]
    lines += [[*key, *(row.get(column, "") for column in columns)] for key, row in found.items()]
    return [f"| {' | '.join(line)} |" for line in lines]


def _of_lists(runs: list[tuple[Path, dict]]) -> dict[str, str]:
    """Return the cells of the query lists of a feature's runs."""
    cells = {}
    for _, summary in runs:
        place = Path(summary.get("dataset") or summary["map"]).name
        for name, result in summary["lists"].items():
            missed = result["localized"] < result["queries"]
            count = f" ({result['localized']} of {result['queries']})" if missed else ""
            cells[f"{place}, {name.split('_')[0]}"] = f"{result['mean_inliers']:,.0f}{count}"
    return cells


def _of_all(runs: list[tuple[Path, dict]], centimetres: list[float]) -> dict[str, str]:
    """Return the cells of all queries of a feature's runs; none without `centimetres`."""
    if not centimetres:
        return {}
    lists = [result for _, summary in runs for result in summary["lists"].values()]
    localized, queries = (sum(each[key] for each in lists) for key in ("localized", "queries"))
    sizes = [summary["bytes_per_keypoint"] for _, summary in runs]
    known = all("images" in size for size in sizes)  # older summaries have none
    photos = sum(size.get("images", 0) for size in sizes)
    keypoints = sum(size["keypoints"] for size in sizes) / photos if known else None
    errors = [error for folder, _ in runs for error in _errors(folder / "queries.csv")]
    return {
        "keypoints": "" if keypoints is None else f"{keypoints:,.0f}",
        "points": f"{sum(summary.get('map_points3D', 0) for _, summary in runs):,}",
        "localized": f"{localized} of {queries}",
        "recall [%]": _percent(errors, centimetres),
    }


def _errors(queries: Path, name: str | None = None) -> list[tuple[float, float]]:
    """Return the errors of the queries of a list in queries.csv; default: of all lists."""
    with queries.open() as file:
        listed = [row for row in csv.DictReader(file) if name in (None, row["list"])]
    known = [row | {key: float(row[key]) for key in ERRORS} for row in listed if row[ERRORS[0]]]
    return counted_errors(known)


def _percent(errors: list[tuple[float, float]], centimetres: list[float]) -> str:
    """Format recall in percent at position errors."""
    found = recall(errors, [(value / 100, DEGREES) for value in centimetres])
    return " / ".join(f"{percent:.1f}" for percent in found)


def _main() -> None:
    parser = cli.Parser(__doc__, "outputs/demo_town/*")
    add = parser.add_argument
    add("outputs", type=Path, nargs="+", help="outputs folders of runs")
    add("--centimetres", type=float, nargs="+", default=[], help="position errors for recall")
    add("--places", action="store_true", help="a row for each feature, a column for each list")
    args = parser.parse_args()
    finished = [folder for folder in args.outputs if (folder / "summary.json").is_file()]
    others = ", ".join(str(path) for path in args.outputs if path not in finished)
    if not finished:
        raise InputError(f"There is no summary.json in {others}: has the run finished?")
    if others:
        logger.warning("Left out, no finished runs: %s.", others)
    table = by_place if args.places else by_list
    print("\n".join(table(finished, args.centimetres)))


if __name__ == "__main__":
    cli.run(_main)
