"""Rows of results/*.csv: what was measured, the measures, and how.

All files have the columns `WHAT`, `MAP`, measures of their own, and `HOW`; results/README.md
explains them. A row is identified by `WHAT`: adding one replaces the row that a file already has.
"""

import argparse
import csv
import os
import shlex
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from hloc_reduce.evaluation.poses import recall
from hloc_reduce.utils.files import replacing

RESULTS = Path("results")
WHAT = ("place", "list", "feature", "storage", "matcher", "variant")
MAP = ("bytes", "photos", "points", "mb")
HOW = ("seconds", "machine", "commit", "command")
CENTIMETRES = (1, 2, 5, 25)  # position errors that are counted, with at most 2 degrees
DEGREES = 2.0

Row = dict[str, str]


def read(name: str) -> list[Row]:
    """Return the rows of `results/<name>.csv`; none if there is no such file."""
    path = RESULTS / f"{name}.csv"
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def select(rows: Iterable[Row], **cells: object) -> list[Row]:
    """Return the rows that have all given cells."""
    return [row for row in rows if all(row[key] == str(cell) for key, cell in cells.items())]


def add(name: str, rows: Iterable[dict[str, object]]) -> None:
    """Add rows to `results/<name>.csv`, which is replaced at once and sorted by `WHAT`."""
    known = {tuple(row[key] for key in WHAT): row for row in read(name)}
    added = [{key: _text(value) for key, value in row.items()} for row in rows]
    columns_of_rows = dict.fromkeys(key for row in [*known.values(), *added] for key in row)
    measures = [key for key in columns_of_rows if key not in {*WHAT, *MAP, *HOW}]
    known |= {tuple(row.setdefault(key, "") for key in WHAT): row for row in added}
    columns = (*WHAT, *MAP, *measures, *HOW)
    path = RESULTS / f"{name}.csv"
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(known[key] for key in sorted(known))


def how(seconds: float | None = None, cores: int | None = None) -> dict[str, object]:
    """Return the cells `HOW` of a measurement by this process.

    Args:
        seconds: wall time of the measurement.
        cores: number of cores it used; default: all that this process may use.
    """
    cores = cores or len(os.sched_getaffinity(0))
    return {
        "seconds": seconds,
        "machine": f"{_processor()}, {cores} core{'s' * (cores > 1)}",
        "commit": _commit(),
        "command": _command(),
    }


def localization(
    errors: Sequence[tuple[float, float]], inliers: Sequence[int], localized: int
) -> dict[str, object]:
    """Return the measures of the queries of a list.

    Args:
        errors: metres and degrees of each query, infinite for one that was not localized.
        inliers: of each query.
        localized: number of queries.
    """
    known = [error for error in errors if np.isfinite(error[0])]
    medians = np.median(known, axis=0) if known else (None, None)
    within = [recall(errors, [(limit / 100, DEGREES)])[0] for limit in CENTIMETRES]
    return {
        "queries": len(inliers),
        "localized": localized,
        **{
            f"within_{limit}cm": round(percent * len(errors) / 100)
            for limit, percent in zip(CENTIMETRES, within, strict=True)
        },
        "median_cm": None if not known else 100 * medians[0],
        "median_deg": medians[1],
        "largest_cm": 100 * max(error[0] for error in known) if known else None,
        "inliers": float(np.mean(inliers)),
    }


def with_keypoints(settings: str) -> str:
    """Return what rows call settings of DoG keypoints, as a variant."""
    return f"{settings} keypoints"


def add_again_option(parser: argparse.ArgumentParser) -> None:
    """Add --again to a command line."""
    parser.add_argument("--again", action="store_true", help="also measure rows that exist")


def _text(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) and value < 1e4 else str(value)


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return "unknown processor"


def _commit() -> str:
    """Return the commit of the code, with a plus if product or benchmarks were changed since."""
    code = ("hloc_reduce", "pipelines", "confs", "benchmarks")
    commit, changes = (
        subprocess.run(["git", *command], capture_output=True, text=True).stdout.strip()
        for command in (("rev-parse", "--short", "HEAD"), ("diff", "HEAD", "--name-only", *code))
    )
    return f"{commit}+" if changes else commit


def _command() -> str:
    spec = sys.modules["__main__"].__spec__
    arguments = [argument for argument in sys.argv[1:] if argument != "--again"]
    return shlex.join(["python", "-m", spec.name if spec else sys.argv[0], *arguments])
