"""Where the work of a stage is done: in this process, or in others of this or other machines.

Work is a function that takes items, one after the other, and yields results of them. An executor
gives it all items at once, or chunks of them in processes that find the same files under the same
paths.
"""

import logging
import os
import re
import socket
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Protocol, TypeVar

from ..utils.cli import InputError
from ..utils.interrupts import interruptible, uninterrupted
from . import parallel, processes

Item = TypeVar("Item")
Result = TypeVar("Result")
Work = Callable[[Iterable[Item]], Iterator[Result]]
BACKLOG = 2  # chunks for each worker that are handed out
RETRIES = 20  # of a chunk whose machine is gone
TIMEOUT = 10  # seconds to wait for a Ray cluster
PATIENCE = 5  # seconds between looks whether there is a worker
TOKEN = Path.home() / ".ray/auth_token"  # from Ray 2.60 on a cluster asks for it


class Executor(Protocol):
    """Does work."""

    def map(
        self, work: Work, items: Iterable[Item], size: int, gpu: bool = False
    ) -> Iterator[Result]:
        """Yield what work makes of items, in any order.

        Args:
            work: as above; it is pickled where it is not done in this process. It may be done again
                for the same items, when a machine is gone.
            items: drawn as they are needed.
            size: how many items make a chunk that is worth a process's while.
            gpu: it uses a GPU where there is one.

        Raises:
            InputError: of the work, or when a process was killed.
        """


class Serial:
    """Does work in this process, with threads on all of its cores."""

    def map(
        self, work: Work, items: Iterable[Item], size: int, gpu: bool = False
    ) -> Iterator[Result]:
        """Yield what work makes of items, as `Executor.map`."""
        return work(items)


SERIAL = Serial()


class Pool:
    """Does chunks of work in other processes.

    Args:
        submit: hands a function and its arguments to a process.
        workers: tells how many processes there are.
        gpu: does the work that uses a GPU; default: the same.
        instead: does the work while there is no process; default: it waits for one.
        cancel: ends what was handed out.
        broken: errors of processes and machines.
    """

    def __init__(
        self,
        submit: Callable[..., Future],
        workers: Callable[[], int],
        gpu: Executor | None = None,
        instead: Executor | None = None,
        cancel: Callable[[Future], object] = Future.cancel,
        broken: tuple[type[Exception], ...] = (),
    ):
        self.submit, self.workers, self.gpu, self.instead = submit, workers, gpu, instead
        self.cancel, self.broken = cancel, broken

    def map(
        self, work: Work, items: Iterable[Item], size: int, gpu: bool = False
    ) -> Iterator[Result]:
        """Yield what work makes of items, as `Executor.map`, chunk by chunk as they are done."""
        if gpu and self.gpu is not None:
            yield from self.gpu.map(work, items, size)
            return
        drawn, pending = iter(items), {}
        try:
            while (workers := self.workers()) or self.instead is None:
                backlog = BACKLOG * max(1, workers)
                while len(pending) < backlog and (chunk := list(islice(drawn, size))):
                    pending[self.submit(_all, work, chunk)] = chunk
                if not pending:
                    return
                for future in wait(pending, PATIENCE, FIRST_COMPLETED).done:
                    del pending[future]
                    if isinstance(found := future.result(), Exception):
                        raise found
                    yield from found
        except BrokenExecutor:
            raise InputError(
                "A process was killed, perhaps for want of memory: try fewer, for example with "
                "OMP_NUM_THREADS=1. What is written is kept."
            ) from None
        except self.broken as error:
            reason = str(error).strip().splitlines()[-1]
            raise InputError(f"The cluster gave up ({reason}). What is written is kept.") from None
        finally:
            for future in pending:
                self.cancel(future)
        yield from self.instead.map(work, chain(*pending.values(), drawn), size)


def _all(work: Work, items: list[Item]) -> list[Result] | InputError | OSError:
    """Return what work makes of items, or its error, which a cluster would wrap in its own."""
    try:
        return list(work(items))
    except (InputError, OSError) as error:
        return error


@contextmanager
def processes_of_this_machine(workers: int | None = None) -> Iterator[Pool]:
    """Start processes, of one thread each, for the time of a block.

    A GPU is left to this process.

    Args:
        workers: how many; default: one for each core.
    """
    import torch

    workers = workers or parallel.cores()
    with processes.pool(workers) as pool:
        yield Pool(pool.submit, lambda: workers, SERIAL if torch.cuda.is_available() else None)


@contextmanager
def ray_cluster(address: str | None = None) -> Iterator[Pool]:
    """Use a Ray cluster for the time of a block: a process of one thread on each of its cores.

    If it has GPUs when work begins that uses one, it is done there, unless they all leave; one
    that joins is for what begins later. What a machine that is gone had to do is done by another.
    TORCH_HOME is the same everywhere.

    Args:
        address: as of `ray.init`; default: that of the environment variable RAY_ADDRESS, or else a
            new cluster of this machine only.

    Raises:
        InputError: when Ray is not installed or the cluster does not answer.
    """
    address = address or os.environ.get("RAY_ADDRESS") or "local"
    if address != "local" and TOKEN.exists():
        os.environ.setdefault("RAY_AUTH_MODE", "token")  # or Ray would not send it
    try:
        import ray
    except ImportError:
        raise InputError("Ray is not installed: pip install 'hloc-reduce[ray]'.") from None
    kept = {"OMP_NUM_THREADS": "1"}
    if "TORCH_HOME" in os.environ:
        kept["TORCH_HOME"] = os.path.abspath(os.path.expanduser(os.environ["TORCH_HOME"]))
    # in a thread, with which its processes end, Ray sets no handler of signals, but warns of that
    thread = ThreadPoolExecutor(1)
    logging.getLogger("ray._private.worker").setLevel("ERROR")
    try:
        try:
            if match := re.fullmatch(r"(?:ray://)?(.+):(\d+)", address):
                # Ray itself would try for minutes
                socket.create_connection((match[1], int(match[2])), timeout=TIMEOUT).close()
            begin = partial(
                ray.init,
                address,
                include_dashboard=False,
                logging_level="warning",
                runtime_env={"env_vars": kept},
            )
            if address == "local":
                with uninterrupted():  # half begun, it would not end
                    thread.submit(begin, num_cpus=parallel.cores()).result()
            else:
                interruptible(begin)
        except (OSError, ValueError, OverflowError, RuntimeError) as error:
            raise InputError(
                f"The Ray cluster {address} does not answer, or refuses: is {TOKEN} the same here "
                f"and there? ({error})"
            ) from None
        task = ray.remote(_all)
        running: dict[Future, ray.ObjectRef] = {}

        def start(number_of_gpus: int, _: Callable, *arguments: object) -> Future:
            options = {"num_cpus": 1, "num_gpus": number_of_gpus, "max_retries": RETRIES}
            reference = task.options(**options).remote(*arguments)
            future = reference.future()
            running[future] = reference
            future.add_done_callback(lambda done: running.pop(done, None))
            return future

        def number(kind: str) -> int:
            return int(ray.cluster_resources().get(kind, 0))

        def cancel(future: Future) -> None:
            if reference := running.get(future):
                ray.cancel(reference)

        errors = [e for e in vars(ray.exceptions).values() if isinstance(e, type)]
        of_work = (ray.exceptions.RayError, ray.exceptions.RayTaskError)
        broken = tuple(e for e in errors if issubclass(e, of_work[0]) and e not in of_work)
        how = {"cancel": cancel, "broken": broken}
        cpus = partial(start, 0), partial(number, "CPU")
        gpus = Pool(partial(start, 1), partial(number, "GPU"), instead=Pool(*cpus, **how), **how)
        yield Pool(*cpus, gpus, **how)
    finally:
        ray.shutdown()
        thread.shutdown()


# by name; each is given the address of a cluster
EXECUTORS: dict[str, Callable[[str | None], AbstractContextManager[Executor]]] = {
    "serial": lambda _: nullcontext(SERIAL),
    "processes": lambda _: processes_of_this_machine(),
    "ray": ray_cluster,
}
