"""Figures of the documentation, made from the rows of results/."""

import re
from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.accuracy_tables import FAMILIES, FEATURES, KINDS_OF_TRIALS, MAPS, SIZES, chosen
from benchmarks.cells import percent, total
from benchmarks.rows import CENTIMETRES, Row, read, select
from benchmarks.speed_tables import ONE_CORE, RUN_PLACES, STAGES, run_name
from benchmarks.trial_rows import OUTCOMES, TRIALS, label
from benchmarks.trial_rows import read as read_trials
from hloc_reduce.evaluation import plots

OUTCOME_COLOURS = plots.COLOURS[2], plots.COLOURS[4], plots.COLOURS[1]


def draw_features() -> list[Callable]:
    """Draw the queries by position error, and the time of extraction."""
    names = [f"{feature}, {storage}" for feature, storage in FEATURES][::-1]
    seconds = {
        row["feature"]: float(row["cpu_s"]) for row in select(read("extraction"), variant=ONE_CORE)
    }

    def errors(axis) -> None:
        before = [0.0] * len(names)
        for colour, limit in zip(plots.COLOURS, CENTIMETRES, strict=False):
            within = [percent(chosen(*choice), f"within_{limit}cm") for choice in FEATURES][::-1]
            widths = [value - left for value, left in zip(within, before, strict=True)]
            axis.barh(names, widths, left=before, color=colour, label=f"within {limit} cm")
            before = within
        axis.set(xlabel="queries [%]")

    def times(axis) -> None:
        # projections take little time
        bases = [re.sub(r"_sv\d+$", "", feature) for feature, _ in FEATURES][::-1]
        axis.barh(names, [seconds[base] for base in bases], color=plots.COLOURS[-2])
        axis.set(xlabel="extraction of a photo [CPU s]", yticklabels=[])

    return [errors, times]


def draw_bytes() -> list[Callable]:
    """Draw recall and inliers against the bytes of a descriptor."""
    found: dict[str, list[tuple[int, float, float]]] = {}
    for family, choices in FAMILIES.items():
        for choice in choices:
            rows = chosen(*choice)
            place = select(rows, place="herz-jesus", list="day")
            values = percent(rows, "within_5cm"), total(place, "inliers")
            found.setdefault(family, []).append((int(rows[0]["bytes"]), *values))

    def panel(axis, column: int, label: str) -> None:
        for colour, (family, points) in zip(plots.COLOURS, found.items(), strict=False):
            sizes, values = [point[0] for point in points], [point[column] for point in points]
            axis.plot(sizes, values, marker="o", color=colour, label=family)
        axis.set(xscale="log", xlabel="bytes of a descriptor", ylabel=label)
        axis.set_xticks(SIZES, [str(size) for size in SIZES])
        axis.minorticks_off()

    labels = ("queries within 5 cm [%]", "mean inliers, Herz-Jesus by day")
    return [partial(panel, column=i, label=label) for i, label in enumerate(labels, 1)]


def draw_maps() -> list[Callable]:
    """Draw inliers on Herz-Jesus, and recall in the town, against the size of the map."""

    def panel(axis, place: str, measure: Callable[[list[Row]], float], label: str) -> None:
        for colour, (feature, storage) in zip(plots.COLOURS, MAPS, strict=False):
            sizes: dict[float, list[Row]] = {}
            for row in select(read("maps"), place=place, feature=feature, matcher=""):
                if "," in row["variant"]:  # points that were selected in another way
                    continue
                if row["storage"] == storage or row["variant"] == "whole map":
                    sizes.setdefault(float(row["mb"]), []).append(row)
            values = [measure(sizes[size]) for size in sorted(sizes)]
            if not sizes:
                continue
            *compact, whole = sorted(sizes)
            name = f"{feature}, {storage}"
            axis.plot(compact, values[:-1], marker="o", color=colour, label=name)
            axis.plot(whole, values[-1], "o", color=colour, markerfacecolor="none")
        axis.set(xscale="log", xlabel="map [MB], open: whole map", ylabel=label)

    def mean_inliers(rows: list[Row]) -> float:
        return total(rows, "inliers") / len(rows)

    return [
        partial(panel, place="herz-jesus", measure=mean_inliers, label="mean inliers, Herz-Jesus"),
        partial(
            panel,
            place="demo_town-400",
            measure=lambda rows: percent(rows, "within_25cm"),
            label="queries within 25 cm, town [%]",
        ),
    ]


def draw_runs() -> list[Callable]:
    """Draw the seconds of whole runs, stage by stage."""
    runs = select(read("runs"), place=RUN_PLACES[0])
    runs.sort(key=lambda row: float(row["seconds"]))

    def panel(axis) -> None:
        left = [0.0] * len(runs)
        for colour, stage in zip(plots.COLOURS, STAGES, strict=False):
            seconds = [float(row[f"{stage}_s"]) for row in runs]
            names = [run_name(row).replace("`", "") for row in runs]
            axis.barh(names, seconds, left=left, color=colour, label=stage)
            left = [sum(pair) for pair in zip(left, seconds, strict=True)]
        axis.set(xlabel="seconds, 33 photos on two cores")

    return [panel]


def draw_errors() -> list[Callable]:
    """Draw what becomes of photos of each kind, and the probabilities of right and wrong poses."""
    trials = read_trials(sorted(TRIALS.glob("*.csv")))

    def kinds(axis) -> None:
        found = {
            name: [row for row in trials if is_of(row)] for name, is_of in KINDS_OF_TRIALS.items()
        }
        names, left = list(found)[::-1], np.zeros(len(found))
        for colour, outcome in zip(OUTCOME_COLOURS, OUTCOMES, strict=True):
            shares = np.array(
                [
                    sum(row["accepted"] and row["outcome"] == outcome for row in found[name])
                    / len(found[name])
                    for name in names
                ]
            )
            axis.barh(names, 100 * shares, left=left, color=colour, label=outcome)
            left = left + 100 * shares
        axis.set(xlabel="localized [%]", xlim=(0, 100))

    def probabilities(axis) -> None:
        poses = [row for row in trials if "measures" in row]
        for is_right, name in ((True, "right"), (False, "of photos that do not belong")):
            found = np.sort([row["probability"] for row in poses if label(row) == is_right])
            share = 100 * np.arange(1, len(found) + 1) / len(found)
            colour = OUTCOME_COLOURS[0 if is_right else -1]
            axis.plot(found, share, color=colour, label=name)
        axis.set(xlabel="probability", ylabel="poses with at most this [%]")

    return [kinds, probabilities]


FIGURES: dict[str, Callable[[], list[Callable]]] = {
    "docs/features.svg": draw_features,
    "docs/rate.svg": draw_bytes,
    "docs/maps.svg": draw_maps,
    "docs/errors.svg": draw_errors,
    "docs/runs.svg": draw_runs,
}
