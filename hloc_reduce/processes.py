"""Processes for what lets no other thread of its process run; they import nothing but that."""

import os
import time
from concurrent.futures import Executor
from threading import Thread

from loky import ProcessPoolExecutor

POLL = 2.0  # seconds


def pool(number: int) -> Executor:
    """Start processes of one thread each; use it in a `with` block.

    They end with the block, and within seconds also when this process is killed.
    """
    return ProcessPoolExecutor(
        number, env={"OMP_NUM_THREADS": "1"}, initializer=_end_without, initargs=(os.getpid(),)
    )


def _end_without(parent: int) -> None:
    """End this process when its parent is gone, even while it waits to be read."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(POLL)
        os._exit(1)

    Thread(target=watch, daemon=True).start()
