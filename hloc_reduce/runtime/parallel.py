"""The cores of a machine: each processes an item of its own, in one thread."""

import os
import sys
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from threading import Lock, local
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

from .trace import span

Item = TypeVar("Item")
Result = TypeVar("Result")
BACKLOG_RESULTS = 4  # per worker, that may wait to be taken


class _OfThread(local):
    """Of each thread, its blocks of `one_thread`, and torch's threads before the first of them."""

    blocks = 0
    before: int | None = None


_lock = Lock()
_of_thread = _OfThread()
_running = 0  # blocks of `one_thread` in all threads
_threads: int | None = None  # torch's threads before the first of these
_blas: Any  # ends the limit on BLAS that the first of these has set
_opencv = 0  # OpenCV's threads before the first of these
_libraries: tuple[int, ThreadpoolController] | None = None  # and the number of modules before


def cores() -> int:
    """Return the number of cores to use: OMP_NUM_THREADS if it is set, else all."""
    torch = sys.modules.get("torch")
    if torch is None:  # nothing here imports it for this alone
        return int(os.environ.get("OMP_NUM_THREADS") or os.cpu_count() or 1)
    with _lock:
        return _threads or torch.get_num_threads()


def _controller() -> ThreadpoolController:
    """Find the libraries with threads of their own: again only after an import, as it takes ms."""
    global _libraries
    number = len(sys.modules)
    if _libraries is None or _libraries[0] != number:
        _libraries = number, ThreadpoolController()
    return _libraries[1]


@contextmanager
def one_thread() -> Iterator[None]:
    """Let NumPy, OpenCV and torch compute in the calling thread only; such blocks may overlap.

    With several threads, BLAS waits much longer than it computes if matrices are small, if other
    programs use the cores, or if several threads of Python call it.
    """
    global _running, _threads, _blas, _opencv
    with _lock:
        if not _running:
            _blas = _controller().limit(limits=1, user_api="blas")
            if cv2 := sys.modules.get("cv2"):
                _opencv = cv2.getNumThreads()
                cv2.setNumThreads(1)
        _running += 1
        _of_thread.blocks += 1
        torch = sys.modules.get("torch")
        if torch is not None and _of_thread.before is None:
            # torch gives a new thread the number that was set last, perhaps by such a block
            _of_thread.before = max(torch.get_num_threads(), _threads or 1)
            _threads = _threads or _of_thread.before
            torch.set_num_threads(1)
    try:
        yield
    finally:
        with _lock:
            _running -= 1
            _of_thread.blocks -= 1
            if not _of_thread.blocks and _of_thread.before is not None:
                sys.modules["torch"].set_num_threads(_of_thread.before)
                _of_thread.before = None
            if not _running:
                _blas.restore_original_limits()
                _threads = None
                if _opencv:
                    sys.modules["cv2"].setNumThreads(_opencv)
                    _opencv = 0


def ordered(
    name: str,
    function: Callable[[Item], Result],
    items: Iterable[Item],
    workers: int | None = None,
) -> Generator[Result, None, None]:
    """Apply a function to items in threads and yield the results in the order of the items.

    The calling thread draws the items, so whatever reads them runs in it, while the workers go on.
    Few items and results are held at once. NumPy and torch compute in one thread of each worker, so
    that results do not depend on the number of workers. If drawing an item fails, the results of
    the items before it are yielded first.

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

    with one_thread():
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
                    is_over or pending[0].done() or len(pending) > BACKLOG_RESULTS * workers
                ):
                    yield pending.popleft().result()
            if failure is not None:
                raise failure
        finally:
            pool.shutdown(cancel_futures=True)
