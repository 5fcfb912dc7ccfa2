"""The cores of a machine: each works on an item of its own, in one thread."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor

import torch

from .trace import span

BACKLOG = 4  # results for each worker that may wait to be taken


def cores() -> int:
    """Return how many cores to use: OMP_NUM_THREADS if it is set, else all."""
    return torch.get_num_threads()


def ordered(name: str, function: Callable, items: Iterable, workers: int | None = None) -> Iterator:
    """Apply a function to items in threads and yield the results in the order of the items.

    While one worker is at work the others and the caller go on: the caller draws the items, so that
    what reads them runs here too. Few items and results are held at once. Torch computes in one
    thread of each worker, so that results do not depend on their number.

    Args:
        name: of the work, in a trace.
        function: what is done with an item; it spends its time outside of Python.
        items: drawn as workers get free.
        workers: how many; default: `cores()`.
    """
    threads = torch.get_num_threads()
    workers = workers or threads
    pending = deque()

    def work(item: object) -> object:
        with span(name):
            return function(item)

    def draw() -> Iterator:
        iterator = iter(items)
        while True:
            with span(f"read to {name}"):
                item = next(iterator, pending)
            if item is pending:  # which is no item
                return
            yield item

    pool = ThreadPoolExecutor(workers)
    torch.set_num_threads(1)
    try:
        for item in draw():
            pending.append(pool.submit(work, item))
            while pending and (pending[0].done() or len(pending) > BACKLOG * workers):
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(threads)
