"""Processes for what lets no other thread of its process run; they import nothing but that."""

import os
import signal
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from multiprocessing import resource_tracker
from threading import Thread

from loky import ProcessPoolExecutor
from loky.backend import resource_tracker as loky_tracker

POLL = 0.5  # seconds
# loky kills a process all the same where there is no `pgrep` to look for its children
warnings.filterwarnings("ignore", "Failed to kill subprocesses", UserWarning)


@contextmanager
def pool(number: int) -> Iterator["_Pool"]:
    """Start processes of one thread each for the time of a block.

    They end with the block, at once if that is by an error or Ctrl-C, and soon also when this
    process is killed.
    """
    for trackers in (resource_tracker, loky_tracker):
        trackers.ensure_running()  # which may unblock the signals that `submit` blocks
    processes = _Pool(
        number, env={"OMP_NUM_THREADS": "1"}, initializer=_end_without, initargs=(os.getpid(),)
    )
    try:
        yield processes
    except BaseException:
        processes.shutdown(kill_workers=True)
        raise
    processes.shutdown()


class _Pool(ProcessPoolExecutor):
    def submit(self, function: Callable, *args) -> Future:
        """Hand a function to a process, and start processes if need be.

        They inherit the mask of signals: Ctrl-C is for this process, which ends them.
        """
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
        try:
            return super().submit(function, *args)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _end_without(parent: int) -> None:
    """End this process when its parent is gone, even while it waits to be read."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(POLL)
        os._exit(1)

    Thread(target=watch, daemon=True).start()
