"""Plots of results with matplotlib, which the extra `report` installs."""

import io
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from itertools import cycle, product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .. import logger
from ..utils.files import replacing
from .poses import cumulative

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    Panel = Callable[[Axes], None]  # draws a plot into axes

INSTALL = "pip install 'hloc-reduce[report]'"
MIN_ERROR = 1e-4  # metres, degrees: smaller errors are drawn here on the logarithmic axis
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555", "#a6761d")
LEGEND_ENTRY = 1.6  # width in inches
AXES = np.array([220, 140])  # approximate size of a panel in points
SIDES = np.array([(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, 1), (1, -1), (-1, -1)])
NO_METADATA = dict.fromkeys(("Creator", "Date", "Format", "Type"))
LINE_STYLES = (("-", "o"), ("--", "s"), (":", "^"))  # style and marker of each query list
# the marker of each kind of map, if it is not that of the query list
MAP_MARKERS: dict[str, dict] = {
    "compact map": {},
    "whole map": {"linestyle": "", "markerfacecolor": "none"},
    "hloc's files": {"linestyle": "", "marker": "x"},
}
NOISE_COLOURS = {"easy": "#009e73", "hard": "#e69f00", "tough": "#d55e00"}
STYLE: dict = {
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "font.size": 9,
    "grid.alpha": 0.3,
    "svg.fonttype": "none",  # text stays text, in the font of the page
    "svg.hashsalt": "hloc_reduce",  # every run writes the same file
}


def available(what: str | Path) -> bool:
    """Return whether matplotlib is installed; warn that `what` will be missing if it is not."""
    if find_spec("matplotlib") is None:
        logger.warning("%s is not written without matplotlib: %s.", what, INSTALL)
        return False
    return True


def figure(
    panels: "Sequence[Panel]", columns: int = 1, width: float = 3.8, height: float = 2.7
) -> "Figure":
    """Draw panels into a figure, row by row; `width` and `height` of each are in inches."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        rows = -(-len(panels) // columns)
        drawn = Figure((columns * width, rows * height), layout="constrained")
        axes = drawn.subplots(rows, columns, squeeze=False).flat
        for axis, panel in zip(axes, panels, strict=True):
            panel(axis)
        handles, labels = drawn.axes[0].get_legend_handles_labels()
        ncols = min(len(labels), max(1, round(columns * width / LEGEND_ENTRY)))
        drawn.set_figheight(drawn.get_figheight() + 0.17 * -(-len(labels) // ncols))
        drawn.legend(
            handles, labels, loc="outside lower center", ncols=ncols, fontsize=7.5, frameon=False
        )
        return drawn


def svg(figure: "Figure") -> str:
    """Return a figure as an SVG element."""
    from matplotlib import rc_context

    buffer = io.StringIO()
    with rc_context(STYLE):
        figure.savefig(buffer, format="svg", metadata=NO_METADATA)
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def save(figure: "Figure", path: Path) -> None:
    """Write a figure; the suffix of the path sets the format."""
    from matplotlib import rc_context

    with replacing(path) as temporary, rc_context(STYLE):
        metadata = NO_METADATA if path.suffix == ".svg" else None
        figure.savefig(temporary, format=path.suffix[1:], metadata=metadata, dpi=120)


def error_curves(
    curves: Mapping[str, Mapping[str, list[tuple[float, float]]]],
) -> "dict[str, Panel]":
    """Plot cumulative position and rotation errors for each list.

    Args:
        curves: from list and run to the errors of the queries, metres and degrees.

    Returns:
        Panels by name, such as `position_day`.
    """
    units = ("position error [m]", "rotation error [°]")
    return {
        f"{unit.split()[0]}_{name}": partial(_curves, name=name, runs=runs, place=place, unit=unit)
        for name, runs in curves.items()
        for place, unit in enumerate(units)
    }


def _label(name: str) -> str:
    """Return a label that matplotlib neither hides (a leading _) nor reads as TeX ($)."""
    return f" {name}".replace("$", r"\$")


def _curves(axis: "Axes", name: str, runs: Mapping, place: int, unit: str) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    styles = product([line for line, _ in LINE_STYLES], COLOURS)
    # thinner and thinner, so that equal curves do not hide each other
    widths = np.linspace(1.3 + 0.5 * min(len(runs) - 1, 5), 1.3, len(runs))
    curves = {run: cumulative(error[place] for error in errors) for run, errors in runs.items()}
    end = max((values[-1] for values, _ in curves.values() if len(values)), default=1.0)
    for (line, colour), width, (run, (values, percent)) in zip(
        cycle(styles), widths, curves.items(), strict=False
    ):
        axis.step(
            np.array([*values[:1], *values, end]).clip(MIN_ERROR),
            [0, *percent, percent[-1]] if len(percent) else [0],
            where="post",
            color=colour,
            linestyle=line,
            label=_label(run),
            linewidth=width,
        )
    axis.set(
        xscale="log", xlabel=unit, ylabel="queries within [%]", ylim=(0, 102), title=_label(name)
    )
    low, high = axis.get_xlim()
    steps = (1, 2, 5) if high < 50 * low else (1, 3) if high < 1000 * low else (1,)
    axis.xaxis.set_major_locator(LogLocator(subs=steps))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())


def size_and_time(points: Mapping[str, Mapping[str, list[dict]]]) -> "dict[str, Panel]":
    """Plot accuracy against the size of descriptors and against time, for each measure.

    Args:
        points: from measure and query list to a dict for each run: `bytes` of a descriptor,
            `seconds`, `value` of the measure, and `family`, whose runs a line joins.

    Returns:
        Panels by name, such as `mean_inliers_bytes`.
    """
    labels = {"bytes": "bytes a descriptor", "seconds": "seconds, whole run"}
    return {
        f"{measure.split(',')[0].replace(' ', '_')}_{key}": partial(
            _against, measure=measure, lists=lists, key=key, label=label
        )
        for measure, lists in points.items()
        for key, label in labels.items()
    }


def _against(axis: "Axes", measure: str, lists: Mapping, key: str, label: str) -> None:
    marked = []
    families = dict.fromkeys(run["family"] for runs in lists.values() for run in runs)
    for colour, family in zip(cycle(COLOURS), families, strict=False):
        for (line, marker), (name, runs) in zip(cycle(LINE_STYLES), lists.items(), strict=False):
            own = sorted((r for r in runs if r["family"] == family), key=lambda run: run["bytes"])
            axis.plot(
                [run[key] for run in own],
                [run["value"] for run in own],
                marker=marker,
                markersize=5,
                linestyle=line if key == "bytes" else "",
                linewidth=1.2,
                color=colour,
                label=_label(f"{family}, {name}"),
            )
            marked += [(run[key], run["value"], f"{run['bytes']} B", colour) for run in own]
    values = [run["value"] for runs in lists.values() for run in runs]
    axis.set(xlabel=label, ylabel=measure)
    _limit(axis, measure, values)
    if key == "seconds":
        _mark(axis, list(dict.fromkeys(marked)))
    else:
        ticks = sorted({run["bytes"] for runs in lists.values() for run in runs})
        axis.set_xscale("log", base=2)
        axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axis.minorticks_off()


def _limit(axis: "Axes", measure: str, values: Sequence[float]) -> None:
    """Set the limits of the axis of a measure."""
    axis.margins(0.12, 0.2)
    if measure.endswith("[%]"):
        axis.set_ylim(min(values) - 5 - 0.1 * (100 - min(values)), 102)
        axis.set_yticks([tick for tick in axis.get_yticks() if min(values) - 5 <= tick <= 100])
    else:
        axis.set_ylim(max(0, axis.get_ylim()[0]))


def map_sizes(points: Mapping[str, Mapping[str, list[dict]]]) -> "dict[str, Panel]":
    """Plot accuracy against the size of the map, for each measure.

    Args:
        points: from measure and query list to a dict for each map: `feature`, whose compact maps a
            line joins; `kind`, a key of `MAP_MARKERS`; `megabytes`; and `value` of the measure.

    Returns:
        Panels by name, such as `mean_inliers_megabytes`.
    """
    return {
        f"{re.split('[,[]', measure)[0].strip().replace(' ', '_')}_megabytes": partial(
            _map_sizes, measure=measure, lists=lists
        )
        for measure, lists in points.items()
    }


def _map_sizes(axis: "Axes", measure: str, lists: Mapping) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    features = dict.fromkeys(run["feature"] for runs in lists.values() for run in runs)
    for colour, feature in zip(cycle(COLOURS), features, strict=False):
        for (line, marker), (name, runs) in zip(cycle(LINE_STYLES), lists.items(), strict=False):
            own = sorted((r for r in runs if r["feature"] == feature), key=lambda r: r["megabytes"])
            style = {"linestyle": line, "marker": marker, "markersize": 5, "linewidth": 1.2}
            for i, (kind, special) in enumerate(MAP_MARKERS.items()):
                axis.plot(
                    [run["megabytes"] for run in own if run["kind"] == kind],
                    [run["value"] for run in own if run["kind"] == kind],
                    color=colour,
                    label=None if i else _label(f"{feature}, {name}"),
                    **style | special,
                )
    for kind in list(MAP_MARKERS)[1:]:
        axis.plot([], [], color="#555555", label=kind, **{"marker": "o", **MAP_MARKERS[kind]})
    axis.set(xlabel="megabytes of the map", ylabel=measure, xscale="log")
    _limit(axis, measure, [run["value"] for runs in lists.values() for run in runs])
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 3)))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())


def _mark(axis: "Axes", marked: list[tuple[float, float, str, str]]) -> None:
    """Write the text of each point (x, y, text, colour) beside it, where there is room."""
    to_points = axis.transScale + axis.transLimits
    places = to_points.transform([mark[:2] for mark in marked]) * AXES
    taken = [(place, np.array([4, 4])) for place in places]  # centres and half sizes
    for place, (x, y, text, colour) in zip(places, marked, strict=True):
        half = np.array([2.2 * len(text), 4])
        for side in SIDES:
            offset = side * (half + 5)
            centre = place + offset
            apart = all((abs(centre - other) >= half + size).any() for other, size in taken)
            if apart and (centre > half).all() and (centre < AXES - half).all():
                taken.append((centre, half))
                axis.annotate(
                    text,
                    (x, y),
                    xytext=(offset[0], offset[1]),
                    textcoords="offset points",
                    ha="center",
                    va="center",
                    fontsize=7,
                    color=colour,
                )
                break


def hpatches_bars(rows: list[dict]) -> "Figure":
    """Plot the means of features in the tasks of HPatches, with a marker for each noise.

    Args:
        rows: from `evaluation.hpatches.main`.
    """
    tasks = [key.removesuffix("_easy") for key in rows[0] if key.endswith("_easy")]
    panels = [partial(_bars, rows=rows, task=task) for task in tasks]
    return figure(panels, len(panels), 4.2, 1 + 0.28 * len(rows))


def _bars(axis: "Axes", rows: list[dict], task: str) -> None:
    places = np.arange(len(rows))[::-1]
    axis.barh(places, [row[task] for row in rows], color="#d7dde4", height=0.7)
    for place, row in zip(places, rows, strict=True):
        axis.annotate(
            f"{row[task]:.2f}", (0, place), (3, 0), textcoords="offset points", va="center"
        )
    for noise, colour in NOISE_COLOURS.items():
        values = [row[f"{task}_{noise}"] for row in rows]
        axis.plot(values, places, "o", markersize=4, color=colour, label=noise)
    paper = [np.nan if row[f"{task}_paper"] is None else row[f"{task}_paper"] for row in rows]
    if not np.isnan(paper).all():
        axis.plot(paper, places, "|", markersize=11, color="black", label="mean in the paper")
    axis.set(title=f"{task} mAP [%]", xlim=(0, 100))
    axis.set_yticks(places, [_label(row["feature"]) for row in rows])
    axis.grid(axis="y", visible=False)
