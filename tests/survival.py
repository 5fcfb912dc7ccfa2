"""Runs of a pipeline in processes that tests kill or interrupt, and what they leave."""

import json
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from pathlib import Path

import h5py
import loky
import pytest
from command import results

from hloc_reduce import extract_features, localize_inloc
from hloc_reduce import match_features as matching
from hloc_reduce.localization import stage as localization_stage
from hloc_reduce.localization.records import Log
from hloc_reduce.runtime import group_writer
from hloc_reduce.runtime.executors import SERIAL, processes_of_this_machine
from hloc_reduce.runtime.outputs import LOCK, RunFolder
from hloc_reduce.utils import cli, interrupts
from hloc_reduce.utils.h5 import iterate_h5_names
from pipelines import aachen, inloc

PIPELINES = {"aachen": aachen, "inloc": inloc}
FEATURE = "sift_sv16"
TRIES = 4  # to end a run in a stage, one after the other, before the stage is left to end
TIMEOUT = 120  # seconds

context = multiprocessing.get_context("forkserver")
# what runs import when they first need it
MODELS = "extractors.reduced", "descriptors.sift", "matchers.nearest_neighbor", "retrieval.vlad"


def _start_server() -> None:
    """Start the process that runs are forked from: imports take seconds."""
    imported = [f"hloc_reduce.{name}" for name in MODELS]
    context.set_forkserver_preload(["survival", "sklearn.cluster", *imported])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # else nothing is found there
        patch.setenv("OMP_NUM_THREADS", "1")
        forkserver.ensure_running()


class Run:
    """A run in a process of its own session.

    Args:
        pipeline: a key of PIPELINES.
        place: its data set.
        outputs: its outputs folder.
        workers: processes of an executor; None for the serial one.
        log: folder for what the run says, and the names of the groups and queries it computes.
    """

    def __init__(self, pipeline: str, place: Path, outputs: Path, workers: int | None, log: Path):
        _start_server()
        log.mkdir(parents=True)
        self.log = log
        self.events, theirs = context.Pipe(duplex=False)
        arguments = pipeline, place, outputs, workers, log, theirs
        self.process = context.Process(target=_run, args=arguments)
        self.process.start()
        theirs.close()
        self.stage: str | None = None  # that it is in
        self.ended: set[str] = set()
        self.seconds: dict[str, float] = {}

    def wait(self, until: float | None = None) -> str | None:
        """Wait for the begin of a stage, or the end of one if it is in one, or a time.

        Returns:
            "begin", "end", or "over" when the run is over; None when the time has come first.
        """
        left = TIMEOUT if until is None else max(0, until - time.perf_counter())
        if not self.events.poll(left):
            assert until is not None, f"hangs in {self.stage}: {self.said()}"
            return None
        try:
            what, stage = self.events.recv()
        except EOFError:
            return "over"
        now = time.perf_counter()
        if what == "begin":
            self.stage, self.since = stage, now
        else:
            self.stage, self.seconds[stage] = None, now - self.since
            self.ended.add(stage)
        return what

    def stop(self, number: int) -> float:
        """Send a signal, SIGKILL to this process only, and return the seconds until its end."""
        start = time.perf_counter()
        try:
            if number == signal.SIGINT:  # as a terminal does
                os.killpg(self.process.pid, number)
            else:
                os.kill(self.process.pid, number)
        except ProcessLookupError:
            pass
        while self.wait() != "over":
            pass
        self.join()
        return time.perf_counter() - start

    def join(self) -> int:
        """Wait for the end of the process, and of all that it started."""
        self.process.join(TIMEOUT)
        assert self.process.exitcode is not None, self.said()
        end = time.monotonic() + 15
        while left := processes_of_session(self.process.pid):
            assert time.monotonic() < end, f"orphans: {left}"
            time.sleep(0.02)
        return self.process.exitcode

    def said(self) -> str:
        return (self.log / "said").read_text()

    def computed(self) -> Counter:
        """Count the files and names of groups, and the queries, that the run computed."""
        path = self.log / "computed"
        return Counter(path.read_text().splitlines() if path.exists() else ())


def _run(
    pipeline: str, place: Path, outputs: Path, workers: int | None, log: Path, events: Connection
) -> None:
    os.setsid()
    said = os.open(log / "said", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for number in (1, 2):
        os.dup2(said, number)
    loky.backend.context.set_start_method("fork")  # imports again
    _log_computed(log)
    for module in (extract_features, matching, localize_inloc, localization_stage):
        module.CHUNK = 2
    measured = RunFolder.stage

    @contextmanager
    def stage(self: RunFolder, name: str) -> Iterator[None]:
        with measured(self, name):
            events.send(("begin", name))
            yield
        events.send(("end", name))

    RunFolder.stage = stage

    def main() -> None:
        with processes_of_this_machine(workers) if workers else nullcontext(SERIAL) as executor:
            list(executor.map(_warm, range(2 * (workers or 0)), 1))
            executor = _Logging(executor, log)
            PIPELINES[pipeline].main(place, outputs, FEATURE, executor=executor)

    cli.run(main)


class _Logging:
    """An executor that logs what it computes."""

    def __init__(self, executor: SERIAL, log: Path):
        self.executor, self.log = executor, log

    def map(self, work: Callable, items: Iterable, *how) -> Iterator:
        return self.executor.map(partial(_logged, work, self.log), items, *how)


def _logged(work: Callable, log: Path, items: Iterable) -> Iterator:
    _log_computed(log)
    yield from work(items)


def _warm(items: list[int]) -> Iterator[int]:
    time.sleep(0.1)  # so that each process gets one
    yield from items


def _log_computed(log: Path) -> None:
    """Have this process log each group and query that it computes; every group is a piece."""
    group_writer.PIECE_SECONDS = 0
    path = log / "computed"

    def logging(add: Callable, file: Callable[[object], str]) -> Callable:
        def logged(self: object, name: str, *args) -> object:
            with path.open("a") as opened:
                opened.write(f"{file(self)} {name}\n")
            return add(self, name, *args)

        logged.logs = True
        return logged

    pieces, records = group_writer.Pieces, Log
    if not hasattr(pieces.add, "logs"):
        pieces.add = logging(pieces.add, lambda self: self.folder.name.removesuffix(".pieces"))
        records.add = logging(records.add, lambda self: self.path.name)


PROGRAM = """
import sys
from pathlib import Path
from hloc_reduce import extract_features
from hloc_reduce.runtime.executors import processes_of_this_machine
from hloc_reduce.utils import cli
from pipelines import aachen

def main():
    extract_features.CHUNK = 2
    with processes_of_this_machine(2) as executor:
        aachen.main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], executor=executor)

cli.run(main)
"""


def start(place, outputs, workers=None):
    """Start the pipeline for Aachen: its command line, or a program with a number of processes."""
    given = ["-m", "pipelines.aachen", "--dataset", place, "--outputs", outputs, "--feature"]
    if workers:
        given = ["-c", PROGRAM, place, outputs]
    command = [sys.executable, *given, FEATURE]
    return subprocess.Popen(command, stdout=-1, stderr=-1, text=True, start_new_session=True)


def processes_of_session(session: int) -> list[str]:
    """List the command lines of the processes of a session that are not over."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            state, _, _, of = (folder / "stat").read_text().rpartition(")")[2].split()[:4]
            if int(of) == session and state != "Z":
                found.append((folder / "cmdline").read_text().replace("\0", " "))
        except (FileNotFoundError, ProcessLookupError):
            pass
    return found


def on_disk(outputs: Path) -> set[str]:
    """Return the files and names of groups and queries that are done; each file is whole."""
    done = set()
    for path in [*outputs.glob("*.h5"), *outputs.glob("*.h5.pieces/*.h5")]:
        if path.name.startswith("."):
            continue
        file = path.name if path.parent == outputs else path.parent.name.removesuffix(".pieces")
        with h5py.File(path) as opened:
            for name in iterate_h5_names(opened.id):
                for dataset in opened[name].values():
                    dataset[()]
                done.add(f"{file} {name}")
    for path in outputs.glob("*_logs.jsonl"):
        for line in path.read_text().split("\n")[1:-1]:
            done.add(f"{path.name} {json.loads(line)[0]}")
    return done


def names(outputs: Path) -> set[str]:
    """Return the names of all in a folder, but for those of a killed run's temporary files."""
    found = set()
    for path in outputs.rglob("*"):
        inside = path.relative_to(outputs).parts
        temporary = any(part.startswith(".") and part.endswith(".tmp") for part in inside)
        if not temporary and not inside[0].endswith(".h5.pieces"):
            found.add("/".join(inside))
        elif not temporary and len(inside) > 1:
            assert path.suffix == ".h5", path
    return found


def undisturbed(pipeline: str, place: Path, folder: Path, workers: int | None) -> Run:
    """Run a pipeline to its end; its outputs are in `folder / "run"`."""
    run = Run(pipeline, place, folder / "run", workers, folder / "log")
    while run.wait() != "over":
        pass
    assert run.join() == 0, run.said()
    assert set(run.computed()) == on_disk(folder / "run")
    assert set(run.computed().values()) == {1}
    return run


def end_at_random(
    pipeline: str,
    place: Path,
    folder: Path,
    workers: int | None,
    number: int,
    signals: tuple[int, ...],
    seed: int,
) -> tuple[Counter, list[float]]:
    """End a pipeline at several random moments of each stage, and resume it each time.

    Checks that each file is whole, that nothing is computed again, that no process is left, that
    what is said is short, and that the results are those of an undisturbed run.

    Returns:
        How often it was ended in each stage, and the seconds that each took to end.
    """
    draw = random.Random(seed)
    reference = undisturbed(pipeline, place, folder / "undisturbed", workers)
    expected = results(folder / "undisturbed/run")
    whole = names(folder / "undisturbed/run")
    ended, seconds, runs, life = Counter(), [], 0, 0
    takes = reference.seconds
    while min(ended[stage] for stage in takes) < number:
        life += 1
        assert life < 10 * number, ended
        outputs = folder / f"{life}" / "run"
        here, done, finished = Counter(), set(), set()
        while True:
            runs += 1
            run = Run(pipeline, place, outputs, workers, folder / f"logs/{runs}")
            stopped = False
            until = None
            while (what := run.wait(until)) != "over":
                until = None
                if what is None:
                    kind = draw.choice(signals)
                    took = run.stop(kind)
                    stopped = True
                    break
                stage = run.stage
                wanted = ended[stage] < number and here[stage] < TRIES
                if what == "begin" and wanted and stage not in finished:
                    until = run.since + draw.uniform(0, takes[stage])
            for stage in run.ended - finished - set(here):  # the first time may have been slow
                takes[stage] = min(takes[stage], run.seconds[stage])
            assert not done & set(run.computed()), "computed again"
            if not stopped:
                assert run.join() == 0, run.said()
                break
            again = set(run.computed().values())
            assert again <= {1}, "computed twice"
            finished |= run.ended
            code = run.process.exitcode
            if run.stage is not None:
                ended[run.stage] += 1
                here[run.stage] += 1
            if outputs.exists():
                assert done <= (now := on_disk(outputs)), "lost"
                done = now
                assert names(outputs) <= whole
            if kind == signal.SIGKILL:
                assert code in (-kind, 0)
                continue
            seconds.append(took)
            assert took < 15
            if set(takes) <= run.ended:  # it was over before
                continue
            assert code in (128 + kind, 0), (code, run.said())
            lines = run.said().replace("\r", "\n").splitlines()
            assert "Traceback" not in run.said(), run.said()
            assert code == 0 or lines[-1].endswith(interrupts.INTERRUPTED), lines
        assert results(outputs) == expected
        left = {path.name for path in outputs.iterdir() if path.name.startswith(".")}
        assert left == {LOCK}
        assert names(outputs) == whole
        assert not [name for name in os.listdir(outputs) if name.endswith(".pieces")]
    slowest = f"{max(seconds, default=0):.2f} s at most to end by {[*signals]}"
    print(f"seed {seed}, {runs} runs, {slowest}:", dict(ended), file=sys.stderr)
    return ended, seconds
