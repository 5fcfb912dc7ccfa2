"""The cores of a machine: each processes an item of its own, in one thread."""

import os
import sys
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from threading import Lock
from typing import TypeVar

from .trace import span

Item = TypeVar("Item")
Result = TypeVar("Result")
BACKLOG = 4  # results per worker that may wait to be taken

_lock = Lock()
_running = 0  # active blocks of `_one_thread_each`, in all threads
_threads = 1  # torch's threads before the first of them


def cores() -> int:
    """Return the number of cores to use: OMP_NUM_THREADS if it is set, else all."""
    torch = sys.modules.get("torch")
    if torch is None:  # nothing here imports it for this alone
        return int(os.environ.get("OMP_NUM_THREADS") or os.cpu_count() or 1)
    with _lock:
        return _threads if _running else torch.get_num_threads()


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Let torch, if it is loaded, compute in the calling thread only; such blocks may overlap."""
    global _running, _threads
    torch = sys.modules.get("torch")
    if torch is None:
        yield
        return
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


def ordered(
    name: str,
    function: Callable[[Item], Result],
    items: Iterable[Item],
    workers: int | None = None,
) -> Generator[Result, None, None]:
    """Apply a function to items in threads and yield the results in the order of the items.

    The calling thread draws the items, so whatever reads them runs in it, while the workers go on.
    Few items and results are held at once. Torch computes in one thread of each worker, so that
    results do not depend on the number of workers. If drawing an item fails, the results of the
    items before it are yielded first.

    Args:
        name: of the work, in a trace.
        function: should spend its time outside of Python.
        items: drawn as workers become free.
        workers: number of threads; default: `cores()`.
    """
    workers = workers or cores()
    pending: deque[Future[Result]] = deque()

    def work(item: Item) -> Result:
        with span(name):
            return function(item)

    with _one_thread_each():
        pool = ThreadPoolExecutor(workers)
        iterator, failure, is_over = iter(items), None, False
        try:
            while not is_over:
                try:
                    with span(f"read to {name}"):
                        item = next(iterator)
                    pending.append(pool.submit(work, item))
                except StopIteration:
                    is_over = True
                except Exception as error:
                    is_over, failure = True, error
                while pending and (
                    is_over or pending[0].done() or len(pending) > BACKLOG * workers
                ):
                    yield pending.popleft().result()
            if failure is not None:
                raise failure
        finally:
            pool.shutdown(cancel_futures=True)
