"""What ran when, in which thread: a file for https://ui.perfetto.dev or chrome://tracing."""

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import get_native_id

from .. import logger
from ..utils.files import replacing

_events: list[tuple] | None = None  # None while nothing is recorded


@contextmanager
def recording(path: Path | None) -> Iterator[None]:
    """Record the spans of a block, if any, into a file of Chrome's trace format.

    With None do nothing.
    """
    global _events
    if path is None:
        yield
        return
    _events = []
    try:
        yield
    finally:
        events, _events = _events, None
        if events:  # else nothing ran, and an earlier trace stays
            _write(events, path)


def _write(events: list[tuple], path: Path) -> None:
    spans = [
        {"name": name, "ph": "X", "pid": 0, "tid": thread, "ts": start / 1e3, "dur": took / 1e3}
        for name, thread, start, took in events
    ]
    with replacing(path) as temporary:
        temporary.write_text(json.dumps({"traceEvents": spans}))
    logger.info("The trace %s opens in https://ui.perfetto.dev.", path)


@contextmanager
def span(name: str) -> Iterator[None]:
    """Record how long a block takes, if anything is recorded."""
    start = time.perf_counter_ns()
    try:
        yield
    finally:
        if _events is not None:
            _events.append((name, get_native_id(), start, time.perf_counter_ns() - start))
