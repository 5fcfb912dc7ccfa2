"""Published numbers: the paper's localization tables and HPatches means, and maps of others."""

import csv
from collections.abc import Collection, Mapping
from pathlib import Path

from ... import datasets
from ...datasets import INLOC_THRESHOLDS

TABLE_FOLDER = Path(__file__).parent
# data set -> beginning of a list's name -> number of its queries, beginning of their names
DATASETS = {
    "Aachen Day-Night v1.1": {"day": (824, "query/day/"), "night": (191, "query/night/")},
    "InLoc": {"DUC1": (198, "query/iphone7/"), "DUC2": (131, "query/iphone7/")},
}
# beginning of a list's name -> beginning of its columns in localization_recall.csv
COLUMNS = {"day": "aachen_day", "night": "aachen_night", "DUC1": "inloc_duc1", "DUC2": "inloc_duc2"}


def hpatches() -> dict[str, dict[str, float]]:
    """Return the mean average precision [%] of each feature in each task, on the split a."""
    return _read("hpatches_map.csv")


def localization() -> dict[str, dict[str, float]]:
    """Return the recall [%] of each feature, by columns: one for each query list and threshold."""
    return _read("localization_recall.csv")


def small_maps() -> list[dict[str, str]]:
    """Return maps of Aachen Day-Night v1.0 by others.

    Returns:
        For each, the `method`, where it was `published`, the `source` of the numbers, the number of
        `photos`, the megabytes `mb`, what is `counted` in these, and the recall [%] by night within
        0.25 m and 2 degrees, `night_0.25m_2deg`, empty if that is of maps of several sizes.
    """
    with (TABLE_FOLDER / "small_maps.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def dataset(lists: Mapping[str, Collection[str]]) -> str | None:
    """Return which data set of the paper query lists are from, whatever its folder is called.

    Args:
        lists: from the name of each list, such as day_time_queries_with_intrinsics or DUC1, to the
            names of its queries.

    Returns:
        A key of `DATASETS`, or None for another data set, even if its layout is Aachen's.
    """

    def is_list(name: str, number: int, folder: str) -> bool:
        queries = [q for key, names in lists.items() if key.startswith(name) for q in names]
        return len(queries) == number and all(query.startswith(folder) for query in queries)

    for known, expected in DATASETS.items():
        if all(is_list(name, *queries) for name, queries in expected.items()):
            return known
    return None


def recall(feature: str, query_list: str) -> list[float] | None:
    """Return the recall [%] of a feature at three thresholds, or None if the paper has none.

    Args:
        feature: name of the feature.
        query_list: name of a list of Aachen or InLoc, such as
            day_time_queries_with_intrinsics or DUC1.
    """
    prefix = next((COLUMNS[key] for key in COLUMNS if query_list.startswith(key)), None)
    row = localization().get(feature, {})
    values = [value for column, value in row.items() if prefix and column.startswith(prefix)]
    return values or None


def thresholds(query_list: str) -> tuple[tuple[float, float], ...]:
    """Return the thresholds, metres and degrees, of the paper's recall on a list."""
    return INLOC_THRESHOLDS if query_list.startswith("DUC") else datasets.thresholds(query_list)


def _read(name: str) -> dict[str, dict[str, float]]:
    """Read a table: from this project's name of each feature to its numbers, by column."""
    table = {}
    with (TABLE_FOLDER / name).open(newline="") as file:
        for row in csv.DictReader(file):
            descriptor, scheme, dim = (row.pop(key) for key in ("descriptor", "scheme", "dim"))
            feature = descriptor if scheme == "raw" else f"{descriptor}_{scheme}{dim}"
            table[feature] = {column: float(value) for column, value in row.items() if value}
    return table
