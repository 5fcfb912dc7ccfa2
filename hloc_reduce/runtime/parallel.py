"""The cores of a machine: each works on an item of its own, in one thread."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Lock

from .trace import span

BACKLOG = 4  # results for each worker that may wait to be taken


_lock = Lock()
_running = 0  # blocks of `_one_thread_each`, of whatever threads
_threads = 1  # of torch before the first of them


def cores() -> int:
    """Return how many cores to use: OMP_NUM_THREADS if it is set, else all."""
    import torch

    with _lock:
        return _threads if _running else torch.get_num_threads()


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Have torch compute in the thread that asks it to; several such blocks may overlap."""
    global _running, _threads
    import torch

    with _lock:
        if not _running:
            _threads = torch.get_num_threads()
        _running += 1
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _lock:
            _running -= 1
            torch.set_num_threads(1 if _running else _threads)


def ordered(name: str, function: Callable, items: Iterable, workers: int | None = None) -> Iterator:
    """Apply a function to items in threads and yield the results in the order of the items.

    While one worker is at work the others and the caller go on: the caller draws the items, so that
    what reads them runs here too. Few items and results are held at once. Torch computes in one
    thread of each worker, so that results do not depend on their number. If drawing an item fails,
    the results of those before it are yielded first.

    Args:
        name: of the work, in a trace.
        function: what is done with an item; it spends its time outside of Python.
        items: drawn as workers get free.
        workers: how many; default: `cores()`.
    """
    workers = workers or cores()
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

    with _one_thread_each():
        pool = ThreadPoolExecutor(workers)
        try:
            drawn, failure = draw(), None
            while failure is None:
                try:
                    item = next(drawn)
                except StopIteration:
                    break
                except Exception as error:
                    failure = error
                    break
                pending.append(pool.submit(work, item))
                while pending and (pending[0].done() or len(pending) > BACKLOG * workers):
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
            if failure is not None:
                raise failure
        finally:
            pool.shutdown(cancel_futures=True)
