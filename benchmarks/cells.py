"""Cells of the tables and figures of the documentation."""

from benchmarks.rows import Row
from hloc_reduce.utils.codes import FLOATS

Table = list[list[str]]  # the header and the rows


def percent(rows: list[Row], measure: str) -> float:
    """Return the share of all queries that a measure counts, in percent."""
    return 100 * total(rows, measure) / total(rows, "queries")


def total(rows: list[Row], measure: str) -> float:
    """Return the sum of a measure."""
    return sum(float(row[measure]) for row in rows)


def name_of(row: Row) -> str:
    """Name a feature and, unless it is float16, the storage of its map."""
    storage = row["storage"]
    return f"`{row['feature']}`" + (f", `{storage}`" if storage not in ("", FLOATS[0]) else "")


def thousands(number: str) -> str:
    """Format a number with commas."""
    return f"{float(number):,.0f}"
