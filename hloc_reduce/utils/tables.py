"""Text tables."""

from collections.abc import Sequence


def aligned(lines: Sequence[Sequence[str]], left: int = 1) -> str:
    """Format lines of cells; the first `left` columns are left-aligned, the others centred."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        " | ".join(
            cell.ljust(width) if i < left else cell.center(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def joined(values: Sequence[float | None] | None, kind: str) -> str:
    """Format the known numbers of one table cell."""
    known = [value for value in values or () if value is not None]
    return " / ".join(format(value, kind) for value in known) or "-"
