"""One page about one run or several side by side, without any other file or network."""

import base64
import json
import re
from importlib.util import find_spec
from pathlib import Path

from .. import __version__, logger
from ..evaluation import plots
from ..utils import cli
from ..utils.cli import InputError
from ..utils.files import replacing
from ..utils.paths import strings_as_paths
from ..utils.progress import progress
from . import pictures, runs, scene
from .runs import ERRORS, Run

FOLDER = Path(__file__).parent
NUM_QUERIES = 6
RECALL, INLIERS = "recall, finest threshold [%]", "mean inliers"


@strings_as_paths
def main(
    folders: list[Path],
    output: Path,
    queries: list[str] | None = None,
    num_queries: int = NUM_QUERIES,
    pictures_dir: Path | None = None,
) -> Path:
    """Write the report of runs.

    Args:
        folders: outputs folders of pipelines, or folders of such, as of a batch.
        output: the HTML file.
        queries: those whose matches are shown; default: `num_queries`, evenly from the worst to
            the best.
        num_queries: as above.
        pictures_dir: a folder for the plots, SVG, and the pictures of matches, JPEG, too.

    Returns:
        `output`.

    Raises:
        InputError: for a folder without a finished run, an unknown query, or when what draws
            is not installed.
    """
    check()
    cli.check_file(output, "the HTML file")
    compared = runs.load([Path(folder) for folder in folders])
    ranked = runs.ranked(compared)
    chosen = [cli.choose("query", name, ranked) for name in queries or ()]
    chosen = chosen or runs.spread(ranked, num_queries)
    plotted = _plotted(compared)
    tables = runs.recall_tables(compared)
    content = {
        "runs": compared,
        "recall": tables,
        "paper": any(row["paper"] for table in tables for row in table["rows"]),
        "charts": {
            key: [plots.svg(plots.figure([panel])) for panel in panels.values()]
            for key, panels in plotted.items()
        },
        "rows": [(run.label, row) for run in compared for row in run.rows.values()],
        "errors": any(row[ERRORS[0]] is not None for run in compared for row in run.rows.values()),
        "shown": _shown(compared, chosen),
        "scenes": _scenes(compared),
        "version": __version__,
    }
    with replacing(output) as temporary:
        temporary.write_text(_page(content), encoding="utf-8")
    logger.info("The report is %s.", output)
    if pictures_dir is not None:
        _write_pictures(pictures_dir, plotted, content["shown"])
    return output


def check() -> None:
    """Raise an InputError if what a report needs is not installed."""
    for package in ("jinja2", "matplotlib"):
        if find_spec(package) is None:
            raise InputError(f"A report needs {package}: {plots.INSTALL}.")


def _scenes(compared: list[Run]) -> dict[str, dict]:
    scenes = {}
    for run in progress(compared, "Reading maps", "run"):
        try:
            scenes |= scene.scenes(run)
        except InputError as error:
            logger.warning("There is no map of %s in the report: %s", run.label, error)
    return scenes


def _write_pictures(folder: Path, plotted: dict, shown: list[dict]) -> None:
    for panels in plotted.values():
        for name, panel in panels.items():
            plots.save(plots.figure([panel]), folder / f"{name}.svg")
    for item in shown:
        for one in item["drawn"]:
            if one["jpeg"]:
                name = re.sub(r"[^\w.-]+", "_", f"{item['query']}_{one['label']}.jpg")
                with replacing(folder / name) as temporary:
                    temporary.write_bytes(base64.b64decode(one["jpeg"]))
    logger.info("Its pictures are in %s.", folder)


def _plotted(compared: list[Run]) -> "dict[str, dict[str, plots.Panel]]":
    """Return the panels of accuracy, and of errors where they are known, by name."""
    curves, recall, inliers = {}, {}, {}
    for run in compared:
        for name, summary in run.summary["lists"].items():
            short = runs.short(name)
            if errors := run.errors(name):
                curves.setdefault(short, {})[run.label] = errors
            point = {"family": run.family, "bytes": run.bytes, "seconds": run.seconds}
            if "recall_percent" in summary:
                value = summary["recall_percent"][0]
                recall.setdefault(short, []).append({**point, "value": value})
            inliers.setdefault(short, []).append({**point, "value": summary["mean_inliers"]})
    measures = {RECALL: recall, INLIERS: inliers}
    known = {measure: lists for measure, lists in measures.items() if lists}
    return {"accuracy": plots.size_and_time(known), "errors": plots.error_curves(curves)}


def _shown(compared: list[Run], chosen: list[str]) -> list[dict]:
    """Return of each chosen query the pictures of the runs."""
    shown = []
    for name in progress(chosen, "Drawing matches", "query"):
        drawn = []
        for run in compared:
            if name not in run.rows:
                continue
            found = picture = None
            try:
                missing = "Nothing was retrieved."
                if found := pictures.matched(run, name):
                    picture = pictures.jpeg(pictures.draw(run, name, found))
            except InputError as error:  # a photo that was moved, for example
                missing = f"There is no picture: {error}"
                logger.warning("There is no picture of %s, %s: %s", name, run.label, error)
            drawn.append(
                {
                    "label": run.label,
                    "row": run.rows[name],
                    "name": found and found["name"],
                    "matches": len(found["inliers"]) if found else 0,
                    "inliers": int(found["inliers"].sum()) if found else 0,
                    "jpeg": picture and base64.b64encode(picture).decode(),
                    "missing": missing,
                }
            )
        shown.append({"query": name, "drawn": drawn})
    return shown


def _page(content: dict) -> str:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(FOLDER),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"figure": _figure, "short": runs.short}
    # within a script element nothing may end it
    packed = json.dumps(content["scenes"]).replace("<", "\\u003c")
    return environment.get_template("page.html").render(
        **content,
        packed=packed,
        style=(FOLDER / "page.css").read_text(encoding="utf-8"),
        script=(FOLDER / "page.js").read_text(encoding="utf-8"),
    )


def _figure(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}" if abs(value) != float("inf") else "none"
