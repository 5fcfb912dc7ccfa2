"""Progress of loops: a bar on a terminal, otherwise (as in a log file) one line a minute."""

import sys
import time
from collections.abc import Iterable, Iterator, Sized

from tqdm import tqdm

from .. import logger

INTERVAL = 60.0  # seconds between two lines
PLURALS = {"query": "queries"}  # other units only add an s


def progress(
    items: Iterable | None = None,
    desc: str = "",
    unit: str = "item",
    total: int | None = None,
    initial: int = 0,
) -> "tqdm | Lines":
    """Show the progress of a loop.

    Args:
        items: what the loop iterates over; None to call `update` instead.
        desc: description of the work.
        unit: name of one item.
        total: number of items, including the `initial` ones; default: the length of `items`.
        initial: number of items that are done already.

    Returns:
        A context manager to iterate over, with tqdm's `update` and `set_postfix`.
    """
    if not sys.stderr.isatty():
        return Lines(items, desc, unit, total, initial)
    # results of a batch come at once, so the rate is averaged over many
    return tqdm(items, desc, total, unit=unit, initial=initial, smoothing=0.1)


class Lines:
    """Logs at most one line every `INTERVAL` seconds. Arguments as in `progress`."""

    def __init__(
        self, items: Iterable | None, desc: str, unit: str, total: int | None, initial: int
    ):
        self.items, self.desc, self.unit, self.initial = items, desc, unit, initial
        self.total = len(items) if total is None and isinstance(items, Sized) else total
        self.number, self.postfix = initial, ""
        self.begun = self.said = time.monotonic()

    def __iter__(self) -> Iterator:
        for item in self.items or ():
            yield item
            self.update()

    def __enter__(self) -> "Lines":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def update(self, number: int = 1) -> None:
        """Advance by a number of items."""
        self.number += number
        if time.monotonic() - self.said >= INTERVAL:
            self.said = time.monotonic()
            logger.info(self.line(self.said - self.begun))

    def set_postfix(self, refresh: bool = True, **values: object) -> None:
        """Add values to the lines."""
        self.postfix = "".join(f", {key} {value}" for key, value in values.items())

    def line(self, elapsed: float) -> str:
        """Report the progress after a number of seconds."""
        units = PLURALS.get(self.unit, f"{self.unit}s")
        if not self.total:
            return f"{self.desc}: {self.number:,} {units}{self.postfix}"
        left = (self.total - self.number) * elapsed / max(self.number - self.initial, 1)
        return (
            f"{self.desc}: {self.number:,} of {self.total:,} {units} "
            f"({100 * self.number // self.total} %), {duration(left)} left{self.postfix}"
        )


def duration(seconds: float) -> str:
    """Format a duration in seconds, minutes or hours."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 90 * 60 else f"{seconds / 3600:.1f} h"
