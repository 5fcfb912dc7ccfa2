"""The paper's own numbers: its tables of localization and the means of its HPatches figures."""

import csv
from collections.abc import Collection, Mapping
from pathlib import Path

from ... import datasets
from ...datasets import INLOC_THRESHOLDS

FOLDER = Path(__file__).parent
# of the lists of queries of each data set: how their names begin, how many queries they have and
# how the names of these begin
DATASETS = {
    "Aachen Day-Night v1.1": {"day": (824, "query/day/"), "night": (191, "query/night/")},
    "InLoc": {"DUC1": (198, "query/iphone7/"), "DUC2": (131, "query/iphone7/")},
}
# how the columns of the table begin
COLUMNS = {
    "day": "aachen_day_",
    "night": "aachen_night_",
    "DUC1": "inloc_duc1_",
    "DUC2": "inloc_duc2_",
}


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


def dataset(lists: Mapping[str, Collection[str]]) -> str | None:
    """Return which data set of the paper lists of queries are, however its folder is called.

    Args:
        lists: from the name of each list, such as day_time_queries_with_intrinsics or DUC1, to the
            names of its queries.

    Returns:
        A key of `DATASETS`, or None for another place, such as one in the layout of Aachen.
    """

    def is_list(name: str, number: int, folder: str) -> bool:
        queries = [q for key, names in lists.items() if key.startswith(name) for q in names]
        return len(queries) == number and all(query.startswith(folder) for query in queries)

    for known, expected in DATASETS.items():
        if all(is_list(name, *queries) for name, queries in expected.items()):
            return known
    return None


def recall(feature: str, query_list: str) -> list[float] | None:
    """Return the recall [%] at three thresholds of a feature on a list of Aachen or InLoc.

    Args:
        feature: a name.
        query_list: a list's name, such as day_time_queries_with_intrinsics or DUC1.
    """
    prefix = next((COLUMNS[key] for key in COLUMNS if query_list.startswith(key)), None)
    row = localization().get(feature, {})
    values = [value for column, value in row.items() if prefix and column.startswith(prefix)]
    return values or None


def thresholds(query_list: str) -> tuple[tuple[float, float], ...]:
    """Return the thresholds, metres and degrees, of the paper's recall on a list."""
    return INLOC_THRESHOLDS if query_list.startswith("DUC") else datasets.thresholds(query_list)
