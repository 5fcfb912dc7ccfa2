"""Rows of results/trials/*.csv: labelled trials of `benchmarks.trials`, and what the gate says."""

import csv
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from benchmarks.rows import RESULTS
from hloc_reduce.localization import gate
from hloc_reduce.localization.gate import ALTERNATIVES, Gate
from hloc_reduce.localization.measures import Alternative, Measures, Uncertainty

TRIALS = RESULTS / "trials"
# kinds of altered photos whose intrinsics are not those of the place
RESHAPED = ("cropped", "squeezed", "zoomed", "warped")
STRANGERS = (
    "other",
    "turned",
    "mirrored",
    "black",
    "noise",
)  # kinds of photos whose poses are all wrong
OUTCOMES = "true", "near", "wrong"  # of poses
LABELS = (
    *("feature", "matcher", "dim", "blur", "map", "place", "photo", "kind", "intrinsics", "commit"),
    *("outcome", "position_error", "rotation_error_deg"),
)
NUMBERS = (
    *("num_matches", "num_inliers", "confidence", "agreement", "degrees_of_freedom"),
    *("may_be_cropped", "longer_side", "is_camera_given", "is_focal_length_free"),
    *("focal_length", "given_focal_length", "off_centre", "off_centre_swapped", "mirror_image"),
)
PRECISIONS = "uncertainty", "uncropped"
COLUMNS = (
    *LABELS,
    *NUMBERS,
    *("focal_range_min", "focal_range_max"),
    *(f"{name}_{part}" for name in PRECISIONS for part in Uncertainty._fields),
    *(f"{kind}_{part}" for kind in ALTERNATIVES for part in Alternative._fields),
)
DIGITS = 5


def to_row(measures: Measures) -> dict:
    """Return measures as columns; those that were not measured are absent."""
    row = {name: getattr(measures, name) for name in NUMBERS}
    row["focal_range_min"], row["focal_range_max"] = measures.focal_range
    named = {name: getattr(measures, name) for name in PRECISIONS} | dict(measures.alternatives)
    row |= {
        f"{name}_{part}": value for name in named for part, value in named[name]._asdict().items()
    }
    return {
        key: f"{value:.{DIGITS}g}" if isinstance(value, float) else value
        for key, value in row.items()
        if value is not None
    }


def of_row(row: dict[str, str]) -> Measures:
    """Return the measures in the columns of a row of a CSV file."""
    numbers = {name: float(row[name]) for name in NUMBERS if row[name] not in ("", "True", "False")}
    flags = {name: row[name] == "True" for name in NUMBERS if row[name] in ("True", "False")}
    precisions = {
        name: Uncertainty(*(float(row[f"{name}_{part}"]) for part in Uncertainty._fields))
        for name in PRECISIONS
    }
    alternatives = {
        kind: Alternative(*(float(row[f"{kind}_{part}"]) for part in Alternative._fields))
        for kind in ALTERNATIVES
        if row[f"{kind}_ratio"]
    }
    range_ = float(row["focal_range_min"]), float(row["focal_range_max"])
    return Measures(**numbers, **flags, **precisions, focal_range=range_, alternatives=alternatives)


def read(files: Iterable[Path]) -> list[dict]:
    """Read trials: whether the gate accepts them; of poses, the `measures` and probability."""
    rows: list[dict] = []
    for file in files:
        with file.open(newline="") as opened:
            rows += csv.DictReader(opened)
    for row in rows:
        row["accepted"] = False
        if row["outcome"] != "none":
            row["measures"] = of_row(row)
            its_gate = Gate(match_kind=row["matcher"])
            if not gate.may_be_mirrored(row["measures"], its_gate):
                row["measures"] = replace(row["measures"], mirror_image=None)
            found = gate.verdict(row["measures"], its_gate)
            row |= {"accepted": not found["reason"], "probability": found["probability"]}
    return rows


def label(row: dict) -> bool | None:
    """Return whether the matches of a trial's pose are right, None if that is not known."""
    if row["outcome"] == "true":
        return True
    return False if row["kind"] in STRANGERS else None
