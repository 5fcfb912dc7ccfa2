"""Worker processes for functions that block other threads, such as COLMAP's detector."""

import os
import signal
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Future
from contextlib import contextmanager
from multiprocessing import resource_tracker
from threading import Thread

from loky import ProcessPoolExecutor
from loky.backend import resource_tracker as loky_tracker

from ..utils.interrupts import STOPS, uninterrupted

POLL = 0.5  # seconds
# loky kills a process all the same where there is no `pgrep` to look for its children
warnings.filterwarnings("ignore", "Failed to kill subprocesses", UserWarning)


@contextmanager
def pool(number: int) -> Iterator["_Pool"]:
    """Start single-threaded processes for the duration of a block.

    They end with it: at once after an error or Ctrl-C, and soon if this process is killed.
    """
    for trackers in (resource_tracker, loky_tracker):
        trackers.ensure_running()  # which may unblock the signals that `_starting` blocks
    with _starting():
        processes = _Pool(number)
    try:
        yield processes
    except BaseException:
        processes.executor.shutdown(kill_workers=True)
        raise
    processes.executor.shutdown()


class _Pool:
    def __init__(self, number: int):
        self.number = number
        self.executor = self._start()

    def _start(self) -> ProcessPoolExecutor:
        env, arguments = {"OMP_NUM_THREADS": "1"}, (os.getpid(),)
        return ProcessPoolExecutor(
            self.number, env=env, initializer=_end_without, initargs=arguments
        )

    def submit(self, function: Callable, *args: object) -> Future:
        """Hand a function to a process, and start processes if need be, also when one was killed.

        They do not hear Ctrl-C, which is for this process, which ends them.
        """
        with _starting():
            try:
                return self.executor.submit(function, *args)
            except BrokenExecutor:
                self.executor = self._start()
                return self.executor.submit(function, *args)


@contextmanager
def _starting() -> Iterator[None]:
    """Have Ctrl-C and SIGTERM wait until the block ends, and processes of it never hear them."""
    with uninterrupted():
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)  # of this thread, is inherited
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _end_without(parent: int) -> None:
    """End this process when its parent is gone, even while it waits to be read."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(POLL)
        os._exit(1)

    Thread(target=watch, daemon=True).start()
