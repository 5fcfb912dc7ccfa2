"""Where the work of a stage is done: in this process, or in others of this or other machines.

Work is a function that takes items, one after the other, and yields results of them. An executor
gives it all items at once, or chunks of them in processes that find the same files under the same
paths.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from contextlib import contextmanager
from itertools import islice
from typing import Protocol, TypeVar

from . import parallel, processes
from .cli import InputError

Item, Result = TypeVar("Item"), TypeVar("Result")
BACKLOG = 2  # chunks for each worker that are handed out


class Executor(Protocol):
    """Does work."""

    def map(
        self, work: Callable[[Iterable[Item]], Iterator[Result]], items: Iterable[Item], size: int
    ) -> Iterator[Result]:
        """Yield what work makes of items, in any order.

        Args:
            work: as above; it is pickled where it is not done in this process.
            items: drawn as they are needed.
            size: how many items make a chunk that is worth a process's while.

        Raises:
            InputError: of the work, or when a process was killed.
        """


class Serial:
    """Does work in this process, with threads on all of its cores."""

    def map(
        self, work: Callable[[Iterable[Item]], Iterator[Result]], items: Iterable[Item], size: int
    ) -> Iterator[Result]:
        """Yield what work makes of items, as `Executor.map`."""
        return work(items)


SERIAL = Serial()


class Pool:
    """Does chunks of work in other processes.

    Args:
        submit: hands a function and its arguments to a process.
        workers: how many processes there are.
    """

    def __init__(self, submit: Callable[..., Future], workers: int):
        self.submit, self.workers = submit, workers

    def map(
        self, work: Callable[[Iterable[Item]], Iterator[Result]], items: Iterable[Item], size: int
    ) -> Iterator[Result]:
        """Yield what work makes of items, as `Executor.map`, chunk by chunk as they are done."""
        drawn, pending = iter(items), set()

        def submit() -> None:
            while len(pending) < BACKLOG * self.workers and (chunk := list(islice(drawn, size))):
                pending.add(self.submit(_all, work, chunk))

        try:
            submit()
            while pending:
                for future in wait(pending, return_when=FIRST_COMPLETED).done:
                    pending.remove(future)
                    yield from future.result()
                submit()
        except BrokenExecutor:
            raise InputError(
                "A process was killed, perhaps for want of memory: try fewer, for example with "
                "OMP_NUM_THREADS=1. What is written is kept."
            ) from None
        finally:
            for future in pending:
                future.cancel()


def _all(work: Callable[[Iterable[Item]], Iterator[Result]], items: list[Item]) -> list[Result]:
    return list(work(items))


@contextmanager
def processes_of_this_machine(workers: int | None = None) -> Iterator[Pool]:
    """Start processes, of one thread each, for the time of a block.

    Args:
        workers: how many; default: one for each core.
    """
    workers = workers or parallel.cores()
    with processes.pool(workers) as pool:
        yield Pool(pool.submit, workers)
