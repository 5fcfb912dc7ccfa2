"""Write the tables and figures of the documentation from the rows of results/ and from weights.

A page has a table between the lines `<!-- table: NAME -->` and `<!-- end -->`, by a function
in `TABLES`. A figure is a file that `benchmarks.figures` draws.
"""

import re
from pathlib import Path

from benchmarks import accuracy_tables, code_tables, speed_tables
from benchmarks.cells import Table
from benchmarks.figures import FIGURES
from hloc_reduce.evaluation import plots
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.files import replacing

TABLES = accuracy_tables.TABLES | speed_tables.TABLES | code_tables.TABLES
PAGES = (
    "README.md",
    "docs/results.md",
    "docs/features.md",
    "docs/localize.md",
    "docs/maps.md",
    "docs/models.md",
    "docs/performance.md",
    "docs/robot.md",
)
LONGEST_NUMBER = 30  # characters of a cell, with units
MARKED = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def markdown(table: Table) -> str:
    """Format a table; columns of numbers are aligned to the right."""
    if len(table) == 1:
        raise InputError(f"There are no rows for the table of {', '.join(table[0])}.")
    columns = list(zip(*table[1:], strict=True))
    numeric = [
        any(cell[:1].isdigit() for cell in column) and max(map(len, column)) < LONGEST_NUMBER
        for column in columns
    ]
    header = [table[0], ["---:" if right else "---" for right in numeric], *table[1:]]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in header)


def rendered(text: str) -> str:
    """Return a page with its tables replaced by those of the rows."""
    return MARKED.sub(lambda found: found[1] + markdown(TABLES[found[2]]()) + found[3], text)


def figure(name: str) -> str:
    """Return a figure as SVG."""
    panels = FIGURES[name]()
    return plots.svg(plots.figure(panels, len(panels)))


def _main() -> None:
    cli.Parser(__doc__).parse_args()
    written = {page: rendered(Path(page).read_text()) for page in PAGES}
    written |= {name: figure(name) for name in FIGURES}
    for name, text in written.items():
        with replacing(Path(name)) as temporary:
            temporary.write_text(text)


if __name__ == "__main__":
    cli.run(_main)
