"""Where the work of a stage is done: in this process, in others, or on other machines.

Work is a generator function from items to results. An executor runs it once on all items, or in
other processes on chunks of them. These processes find the same files at the same paths.
"""

import logging
import os
import re
import socket
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any, Protocol, TypeVar

from ..utils.cli import InputError
from ..utils.interrupts import interruptible, uninterrupted
from . import parallel, processes

Item = TypeVar("Item")
Result = TypeVar("Result")
Results = Generator[Result, None, None]
Work = Callable[[Iterable[Item]], Results[Result]]
BACKLOG_CHUNKS = 2  # handed out per worker
RETRIES = 20  # of a chunk whose machine was lost
CLUSTER_TIMEOUT_SECONDS = 10  # of waiting for a Ray cluster
WORKER_CHECK_SECONDS = 5  # between checks for workers
TOKEN = Path.home() / ".ray/auth_token"  # clusters of Ray 2.60 and later ask for it


class Executor(Protocol):
    """Runs work."""

    def map(
        self, work: Work[Item, Result], items: Iterable[Item], size: int, gpu: bool = False
    ) -> Results[Result]:
        """Yield the results of work, in any order.

        Args:
            work: pickled unless it runs in this process; repeated for the items of lost machines.
            items: drawn as they are needed.
            size: items per chunk, enough to be worth handing to another process.
            gpu: the work uses a GPU if there is one.

        Raises:
            InputError: raised by the work, or when a process was killed.
        """


class Serial:
    """Runs work in this process, with threads on all of its cores."""

    def map(
        self, work: Work[Item, Result], items: Iterable[Item], size: int, gpu: bool = False
    ) -> Results[Result]:
        """Yield the results of work, see `Executor.map`."""
        return work(items)


SERIAL = Serial()


class Pool:
    """Runs chunks of work in other processes.

    Args:
        submit: hands work and a chunk of items to a process.
        workers: returns the number of processes.
        gpu: runs work that uses a GPU; default: this pool.
        instead: runs work while there is no process; default: wait for one.
        cancel: cancels a submitted chunk.
        broken: errors that mean that processes or machines failed.
    """

    def __init__(
        self,
        submit: Callable[[Work, list], Future],
        workers: Callable[[], int],
        gpu: Executor | None = None,
        instead: Executor | None = None,
        cancel: Callable[[Future], object] = Future.cancel,
        broken: tuple[type[Exception], ...] = (),
    ):
        self.submit, self.workers, self.gpu, self.instead = submit, workers, gpu, instead
        self.cancel, self.broken = cancel, broken

    def map(
        self, work: Work[Item, Result], items: Iterable[Item], size: int, gpu: bool = False
    ) -> Results[Result]:
        """Yield the results of work chunk by chunk, see `Executor.map`."""
        if gpu and self.gpu is not None:
            yield from self.gpu.map(work, items, size)
            return
        drawn = iter(items)
        pending: dict[Future, list[Item]] = {}
        try:
            while (workers := self.workers()) or self.instead is None:
                backlog = BACKLOG_CHUNKS * max(1, workers)
                while len(pending) < backlog and (chunk := list(islice(drawn, size))):
                    pending[self.submit(work, chunk)] = chunk
                if not pending:
                    return
                for future in wait(pending, WORKER_CHECK_SECONDS, FIRST_COMPLETED).done:
                    del pending[future]
                    if isinstance(found := future.result(), Exception):
                        raise found
                    yield from found
        except BrokenExecutor:
            raise InputError(
                "A process was killed, perhaps for lack of memory: use fewer, for example with "
                "OMP_NUM_THREADS=1. Finished work is kept."
            ) from None
        except self.broken as error:
            reason = str(error).strip().splitlines()[-1]
            raise InputError(f"The cluster failed ({reason}). Finished work is kept.") from None
        finally:
            for future in pending:
                self.cancel(future)
        yield from self.instead.map(work, chain(*pending.values(), drawn), size)


def _run(work: Work[Item, Result], items: list[Item]) -> list[Result] | InputError | OSError:
    """Return the results of work, or its error, which a cluster would wrap in one of its own."""
    try:
        return list(work(items))
    except (InputError, OSError) as error:
        return error


@contextmanager
def processes_of_this_machine(workers: int | None = None) -> Iterator[Pool]:
    """Start single-threaded processes for the duration of a block; a GPU is left to this process.

    Args:
        workers: number of processes; default: one for each core.
    """
    import torch

    workers = workers or parallel.cores()
    with processes.pool(workers) as pool:
        gpu = SERIAL if torch.cuda.is_available() else None
        yield Pool(partial(pool.submit, _run), lambda: workers, gpu)


@contextmanager
def ray_cluster(address: str | None = None) -> Iterator[Pool]:
    """Use a Ray cluster for the duration of a block, with a single-threaded process on each core.

    Work that uses a GPU runs on the cluster's GPUs if it has any when the work begins, and on
    cores once all of them have left. Tasks of lost machines are rescheduled. TORCH_HOME is passed
    to all machines.

    Args:
        address: see `ray.init`; default: the environment variable RAY_ADDRESS, else a new cluster
            of this machine only.

    Raises:
        InputError: when Ray is not installed or the cluster does not answer.
    """
    address = address or os.environ.get("RAY_ADDRESS") or "local"
    if address != "local" and TOKEN.exists():
        os.environ.setdefault("RAY_AUTH_MODE", "token")  # otherwise Ray does not send it
    try:
        import ray
    except ImportError:
        raise InputError("Ray is not installed: pip install 'hloc-reduce[ray]'.") from None
    # In this thread Ray sets no signal handlers (it warns of that), and its processes end with it.
    thread = ThreadPoolExecutor(1)
    logging.getLogger("ray._private.worker").setLevel("ERROR")
    try:
        _connect(address, thread)
        remote: Any = ray.remote(_run)
        running: dict[Future, ray.ObjectRef] = {}

        def submit(num_gpus: int, work: Work, items: list) -> Future:
            task = remote.options(num_cpus=1, num_gpus=num_gpus, max_retries=RETRIES)
            reference = task.remote(work, items)
            future = reference.future()
            running[future] = reference
            future.add_done_callback(lambda done: running.pop(done, None))
            return future

        def count(kind: str) -> int:
            return int(ray.cluster_resources().get(kind, 0))

        def cancel(future: Future) -> None:
            if reference := running.get(future):
                ray.cancel(reference)

        of_work = (ray.exceptions.RayError, ray.exceptions.RayTaskError)
        errors = [e for e in vars(ray.exceptions).values() if isinstance(e, type)]
        broken = tuple(e for e in errors if issubclass(e, of_work[0]) and e not in of_work)
        pool = partial(Pool, cancel=cancel, broken=broken)
        cpus = partial(submit, 0), partial(count, "CPU")
        gpus = pool(partial(submit, 1), partial(count, "GPU"), instead=pool(*cpus))
        yield pool(*cpus, gpu=gpus)
    finally:
        ray.shutdown()
        thread.shutdown()


def _connect(address: str, thread: ThreadPoolExecutor) -> None:
    """Connect to a Ray cluster, or start one of this machine in a thread."""
    import ray

    env = {"OMP_NUM_THREADS": "1"}
    if "TORCH_HOME" in os.environ:
        env["TORCH_HOME"] = os.path.abspath(os.path.expanduser(os.environ["TORCH_HOME"]))
    begin = partial(
        ray.init,
        address,
        include_dashboard=False,
        logging_level=logging.WARNING,
        runtime_env={"env_vars": env},
    )
    try:
        if match := re.fullmatch(r"(?:ray://)?(.+):(\d+)", address):
            # Ray itself would try for minutes
            socket.create_connection(
                (match[1], int(match[2])), timeout=CLUSTER_TIMEOUT_SECONDS
            ).close()
        if address == "local":
            with uninterrupted():  # half started, it would not end
                thread.submit(begin, num_cpus=parallel.cores()).result()
        else:
            interruptible(begin)
    except (OSError, ValueError, OverflowError, RuntimeError) as error:
        raise InputError(
            f"The Ray cluster {address} does not answer, or refuses the connection: is {TOKEN} the "
            f"same on all machines? ({error})"
        ) from None


# by name; each takes the address of a cluster
EXECUTORS: dict[str, Callable[[str | None], AbstractContextManager[Executor]]] = {
    "serial": lambda _: nullcontext(SERIAL),
    "processes": lambda _: processes_of_this_machine(),
    "ray": ray_cluster,
}
