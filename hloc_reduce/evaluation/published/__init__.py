"""The paper's own numbers: its tables of localization and the means of its HPatches figures."""

import csv
from pathlib import Path

FOLDER = Path(__file__).parent


def feature_name(descriptor: str, scheme: str, dim: str) -> str:
    """Return this project's name of a feature of the paper."""
    return descriptor if scheme == "raw" else f"{descriptor}_{scheme}{dim}"


def _read(name: str) -> dict[str, dict[str, float]]:
    with (FOLDER / name).open(newline="") as file:
        rows = list(csv.DictReader(file))
    keys = ("descriptor", "scheme", "dim")
    return {
        feature_name(*(row.pop(key) for key in keys)): {
            column: float(value) for column, value in row.items() if value
        }
        for row in rows
    }


def hpatches() -> dict[str, dict[str, float]]:
    """Return the mean average precision [%] of each feature in each task, on the split a."""
    return _read("hpatches_map.csv")


def localization() -> dict[str, dict[str, float]]:
    """Return the recall [%] of each feature, a column for each list of queries and threshold."""
    return _read("localization_recall.csv")
