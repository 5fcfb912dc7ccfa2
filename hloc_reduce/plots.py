"""Plots of results, by matplotlib, which the extra `report` installs."""

import io
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from . import logger
from .evaluation.poses import cumulative
from .io import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INSTALL = "pip install 'hloc-reduce[report]'"
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555", "#a6761d")
NOISE_COLOURS = {"easy": "#009e73", "hard": "#e69f00", "tough": "#d55e00"}
STYLE = {
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "font.size": 9,
    "grid.alpha": 0.3,
    "svg.fonttype": "none",  # text in the font of the page
    "svg.hashsalt": "hloc_reduce",  # the same file in every run
}


def available(what: str | Path) -> bool:
    """Return whether plots can be made; say how, if not, and that `what` will be missing."""
    if find_spec("matplotlib") is None:
        logger.warning("Without matplotlib there is no %s: %s.", what, INSTALL)
        return False
    return True


def _subplots(rows: int, columns: int, width: float, height: float) -> "tuple[Figure, np.ndarray]":
    """Make a figure of panels (rows, columns), of so many inches each."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure((columns * width, rows * height), layout="constrained")
        return figure, figure.subplots(rows, columns, squeeze=False)


def svg(figure: "Figure") -> str:
    """Return a figure as an SVG element."""
    from matplotlib import rc_context

    buffer = io.StringIO()
    with rc_context(STYLE):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def save(figure: "Figure", path: Path) -> None:
    """Write a figure in the format that the suffix of its path names."""
    from matplotlib import rc_context

    with replacing(path) as temporary, rc_context(STYLE):
        metadata = {"Date": None} if path.suffix == ".svg" else None
        figure.savefig(temporary, format=path.suffix[1:], metadata=metadata, dpi=120)


def error_curves(curves: Mapping[str, Mapping[str, list[tuple[float, float]]]]) -> "Figure":
    """Plot cumulative errors of poses.

    Args:
        curves: from list of queries and run to the errors, metres and degrees, of its queries.
    """
    figure, axes = _subplots(2, len(curves), 3.6, 2.5)
    for column, (name, runs) in enumerate(curves.items()):
        for row, unit in enumerate(("position error [m]", "rotation error [°]")):
            axis = axes[row, column]
            for colour, (run, errors) in zip(_colours(), runs.items(), strict=False):
                values, percent = cumulative(error[row] for error in errors)
                axis.step(values, percent, where="post", color=colour, label=run, linewidth=1.4)
            axis.set(xscale="log", xlabel=unit, ylim=(0, 102))
            if column == 0:
                axis.set_ylabel("queries within [%]")
        axes[0, column].set_title(name)
    axes[0, 0].legend(fontsize=8, loc="best", frameon=False)
    return figure


def size_and_time(points: Mapping[str, Mapping[str, list[dict]]]) -> "Figure":
    """Plot accuracy against the size of descriptors and against time.

    Args:
        points: from measure of accuracy and list of queries to a dict for each run: `label`,
            `bytes` of a descriptor, `seconds`, `value`.
    """
    figure, axes = _subplots(len(points), 2, 3.6, 2.5)
    for row, (measure, lists) in zip(axes, points.items(), strict=True):
        for axis, key, label in zip(
            row, ("bytes", "seconds"), ("bytes a descriptor", "seconds, whole run"), strict=True
        ):
            for colour, (name, runs) in zip(_colours(), lists.items(), strict=False):
                runs = sorted(runs, key=lambda run: run[key])
                x, y = [run[key] for run in runs], [run["value"] for run in runs]
                line = "-" if key == "bytes" else ""
                axis.plot(x, y, marker="o", markersize=4, linestyle=line, color=colour, label=name)
                for run in runs:
                    axis.annotate(
                        run["label"],
                        (run[key], run["value"]),
                        xytext=(0, 5),
                        textcoords="offset points",
                        ha="center",
                        fontsize=6.5,
                        color=colour,
                    )
            if key == "bytes":
                _powers_of_two(axis, [run[key] for runs in lists.values() for run in runs])
            axis.margins(0.12, 0.18)
            axis.set(xlabel=label, ylabel=measure if key == "bytes" else None)
    axes[0, 0].legend(fontsize=8, frameon=False)
    return figure


def _powers_of_two(axis: "Axes", values: Iterable[float]) -> None:
    """Scale an axis by powers of two, with a tick at each value."""
    ticks = sorted(set(values))
    axis.set_xscale("log", base=2)
    axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks], minor=False)
    axis.minorticks_off()


def hpatches_bars(rows: list[dict]) -> "Figure":
    """Plot the means of features in the tasks of HPatches, with markers for each noise.

    Args:
        rows: as of `evaluation.hpatches.main`.
    """
    tasks = [key.removesuffix("_easy") for key in rows[0] if key.endswith("_easy")]
    figure, axes = _subplots(1, len(tasks), 3.2, 0.7 + 0.28 * len(rows))
    names = [row["feature"] for row in rows]
    places = np.arange(len(rows))[::-1]
    for axis, task in zip(axes[0], tasks, strict=True):
        values = [row[task] for row in rows]
        axis.barh(places, values, color="#d7dde4", height=0.7)
        for place, value in zip(places, values, strict=True):
            axis.annotate(
                f"{value:.2f}", (0, place), (3, 0), textcoords="offset points", va="center"
            )
        for noise, colour in NOISE_COLOURS.items():
            axis.plot(
                [row[f"{task}_{noise}"] for row in rows],
                places,
                linestyle="",
                marker="o",
                markersize=4,
                color=colour,
                label=noise,
            )
        paper = [row[f"{task}_paper"] for row in rows]
        known = [(p, place) for p, place in zip(paper, places, strict=True) if p is not None]
        if known:
            axis.plot(
                *zip(*known, strict=True),
                linestyle="",
                marker="|",
                markersize=11,
                color="black",
                label="mean in the paper",
            )
        axis.set(title=f"{task} mAP [%]", xlim=(0, 100))
        axis.set_yticks(places, names if axis is axes[0, 0] else [])
        axis.grid(axis="y", visible=False)
    axes[0, -1].legend(fontsize=8, loc="upper left", bbox_to_anchor=(1, 1), frameon=False)
    return figure


def _colours() -> Iterable[str]:
    while True:
        yield from COLOURS
