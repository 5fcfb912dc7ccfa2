"""One HTML page about one run or several side by side, which needs no other file or network."""

import base64
import json
import re
from collections.abc import Iterable
from importlib.util import find_spec
from math import isfinite
from pathlib import Path
from typing import Annotated

from .. import __version__, logger
from ..evaluation import plots
from ..evaluation.poses import ERRORS
from ..utils import cli
from ..utils.cli import InputError
from ..utils.files import MEGABYTE, replacing
from ..utils.options import POSITIVE, Option
from ..utils.paths import strings_as_paths
from ..utils.progress import progress
from . import pictures, runs, scene
from .runs import Run

PAGE_FOLDER = Path(__file__).parent
DEFAULT_NUM_QUERIES = 6
RECALL, INLIERS = "recall, finest threshold [%]", "mean inliers"
MEDIAN_ERROR = "median error [cm]"


@strings_as_paths
def main(
    folders: Annotated[list[Path], Option(flags=("folders",), metavar="OUTPUTS")],
    output: Annotated[Path, Option(flags=("-o", "--output"))],
    queries: list[str] | None = None,
    num_queries: Annotated[int, POSITIVE] = DEFAULT_NUM_QUERIES,
    pictures_dir: Path | None = None,
) -> Path:
    """Write the report of runs.

    Args:
        folders: outputs folders of runs, or folders with finished runs at most two levels below,
            such as the outputs folder of a batch.
        output: the HTML file.
        queries: queries whose matches are shown; default: `num_queries` of them.
        num_queries: number of queries shown without `queries`, spread evenly from worst to best.
        pictures_dir: also write plots (SVG) and pictures of matches (JPEG) to this folder.

    Returns:
        `output`.

    Raises:
        InputError: for a folder without a finished run, an unknown query, or if jinja2 or
            matplotlib is not installed.
    """
    check()
    cli.check_file(output, "the HTML file")
    compared = runs.load([Path(folder) for folder in folders])
    ranked = runs.ranked(compared)
    chosen = [cli.choose("query", name, ranked) for name in queries or ()]
    shown = _shown(compared, chosen or runs.spread(ranked, num_queries))
    panels = _panels(compared)
    rows = [(run.label, row) for run in compared for row in run.rows.values()]
    tables = runs.recall_tables(compared)
    content = {
        "runs": compared,
        "recall": tables,
        "paper": any(row["paper"] for table in tables for row in table["rows"]),
        "charts": {
            key: [plots.svg(plots.figure([panel])) for panel in named.values()]
            for key, named in panels.items()
        },
        "rows": rows,
        "errors": any(row[ERRORS[0]] is not None for _, row in rows),
        "shown": shown,
        "scenes": _scenes(compared),
        "version": __version__,
    }
    with replacing(output) as temporary:
        temporary.write_text(_page(content), encoding="utf-8")
    logger.info("The report is %s.", output)
    if pictures_dir is not None:
        _write_pictures(pictures_dir, panels, shown)
    return output


def check() -> None:
    """Raise an InputError if a package that a report needs is not installed."""
    for package in ("jinja2", "matplotlib"):
        if find_spec(package) is None:
            raise InputError(f"A report needs {package}: {plots.INSTALL}.")


def _shown(compared: list[Run], chosen: list[str]) -> list[dict]:
    """Return pictures of each chosen query, one for each run that has the query."""
    return [
        {"query": name, "drawn": [_drawn(run, name) for run in compared if name in run.rows]}
        for name in progress(chosen, "Drawing matches", "query")
    ]


def _drawn(run: Run, query: str) -> dict:
    """Draw a query and its matches; without a picture, `missing` says why."""
    found = picture = None
    missing = "Nothing was retrieved."
    try:
        if found := pictures.matched(run, query):
            picture = pictures.jpeg(pictures.draw(run, query, found))
    except InputError as error:  # a photo that was moved, for example
        missing = f"There is no picture: {error}"
        logger.warning("There is no picture of %s, %s: %s", query, run.label, error)
    return {
        "label": run.label,
        "row": run.rows[query],
        "name": found and found["name"],
        "matches": len(found["inliers"]) if found else 0,
        "inliers": int(found["inliers"].sum()) if found else 0,
        "jpeg": picture,
        "missing": missing,
    }


def _panels(compared: list[Run]) -> "dict[str, dict[str, plots.Panel]]":
    """Return the panels of accuracy, and of errors where they are known, by name."""
    curves: dict[str, dict] = {}
    for run in compared:
        for name in run.summary["lists"]:
            if errors := run.errors(name):
                curves.setdefault(runs.short(name), {})[run.label] = errors
    described = [run for run in compared if not run.is_compact] or compared
    points = [
        (run, {"family": run.family, "bytes": run.bytes, "seconds": run.seconds})
        for run in described
    ]
    return {
        "accuracy": plots.size_and_time(_measured(points, (RECALL, INLIERS))),
        "maps": map_panels(compared),
        "errors": plots.error_curves(curves),
    }


def map_panels(compared: list[Run]) -> "dict[str, plots.Panel]":
    """Return the panels of accuracy against the size of maps by name; none without compact maps."""
    if not any(run.is_compact for run in compared):
        return {}
    compact, whole, hloc = plots.MAP_MARKERS
    points = []
    for run in compared:
        sizes = {compact if run.is_compact else whole: run.map_bytes, hloc: run.hloc_bytes}
        points += [
            (run, {"feature": run.feature, "kind": kind, "megabytes": size / MEGABYTE})
            for kind, size in sizes.items()
            if size
        ]
    return plots.map_sizes(_measured(points, (RECALL, MEDIAN_ERROR, INLIERS)))


def _measured(
    points: Iterable[tuple[Run, dict]], measures: tuple[str, ...]
) -> dict[str, dict[str, list[dict]]]:
    """Return points by measure and query list, with its known values; several may be of a run."""
    found: dict[str, dict] = {measure: {} for measure in measures}
    for run, point in points:
        for name, summary in run.summary["lists"].items():
            error = summary.get("median_position_error_m")
            values = {
                RECALL: summary.get("recall_percent", [None])[0],
                MEDIAN_ERROR: None if error is None else 100 * error,
                INLIERS: summary["mean_inliers"],
            }
            for measure in measures:
                value = values[measure]
                if value is not None and isfinite(value):
                    of_list = found[measure].setdefault(runs.short(name), [])
                    of_list.append({**point, "value": value})
    return {measure: lists for measure, lists in found.items() if lists}


def _scenes(compared: list[Run]) -> dict[str, dict]:
    """Return the 3D views of all runs whose maps can be read."""
    scenes: dict[str, dict] = {}
    for run in progress(compared, "Reading maps", "run"):
        try:
            scenes |= scene.scenes(run)
        except InputError as error:
            logger.warning("There is no map of %s in the report: %s", run.label, error)
    return scenes


def _page(content: dict) -> str:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(PAGE_FOLDER),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "base64": lambda data: base64.b64encode(data).decode(),
        "number": _number,
        "short": runs.short,
    }
    # no name in the data may end the script element
    packed = json.dumps(content["scenes"]).replace("<", "\\u003c")
    return environment.get_template("page.html").render(
        **content,
        packed=packed,
        style=(PAGE_FOLDER / "page.css").read_text(encoding="utf-8"),
        script=(PAGE_FOLDER / "page.js").read_text(encoding="utf-8"),
    )


def _number(value: float | None, digits: int) -> str:
    """Format a number, infinity as "none"; None is empty."""
    return "" if value is None else f"{value:.{digits}f}" if abs(value) != float("inf") else "none"


def _write_pictures(
    folder: Path, panels: "dict[str, dict[str, plots.Panel]]", shown: list[dict]
) -> None:
    for named in panels.values():
        for name, panel in named.items():
            plots.save(plots.figure([panel]), folder / f"{name}.svg")
    for item in shown:
        for one in item["drawn"]:
            if one["jpeg"]:
                name = re.sub(r"[^\w.-]+", "_", f"{item['query']}_{one['label']}.jpg")
                with replacing(folder / name) as temporary:
                    temporary.write_bytes(one["jpeg"])
    logger.info("Its pictures are in %s.", folder)
