"""Runs that are killed or interrupted."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
import survival

from hloc_reduce.runtime import group_writer
from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.utils import files, h5, interrupts
from hloc_reduce.utils.h5 import write_h5

pytestmark = pytest.mark.check

SEED = 0
KILL, STOP = (signal.SIGKILL,), (signal.SIGINT, signal.SIGTERM)
BOTH = (None, 2)  # the serial executor, and one of two processes


@pytest.mark.parametrize("kind, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_run_writes_what_is_done(tmp_path, kind, code):
    program = f"""
import time
import numpy, pycolmap
from pathlib import Path
from hloc_reduce.utils import cli
from hloc_reduce.runtime.group_writer import GroupWriter

def main():
    with GroupWriter(Path({str(tmp_path / "f.h5")!r}), {{}}) as writer:
        writer.add("done", {{"a": numpy.arange(3)}})
        print("ready", flush=True)
        time.sleep(60)

cli.run(main)
"""
    run = subprocess.Popen(
        [sys.executable, "-c", program], stdout=-1, stderr=-1, text=True, start_new_session=True
    )
    assert run.stdout.readline() == "ready\n"
    os.killpg(run.pid, kind)
    _, said = run.communicate(timeout=30)
    assert run.returncode == code
    (line,) = said.splitlines()
    assert line.endswith("Interrupted. Run the same command again, without --overwrite, to resume.")
    with GroupWriter(tmp_path / "f.h5", {}) as writer:
        assert "done" in writer


def test_a_long_call_outside_of_python_is_interrupted(tmp_path):
    # a thread that holds no lock of Python's, as COLMAP's calls are; it cannot be ended
    program = """
import time
from hloc_reduce.utils import cli, interrupts

def main():
    assert interrupts.interruptible(divmod, 7, 4) == (1, 3)
    try:
        interrupts.interruptible(divmod, 7, 0)
    except ZeroDivisionError:
        print("ready", flush=True)
    try:
        interrupts.interruptible(time.sleep, 600)
    finally:
        print("written", flush=True)

cli.run(main)
"""
    run = subprocess.Popen([sys.executable, "-c", program], stdout=-1, stderr=-1, text=True)
    assert run.stdout.readline() == "ready\n"
    time.sleep(0.1)
    run.send_signal(signal.SIGINT)
    printed, said = run.communicate(timeout=30)
    assert (run.returncode, printed) == (130, "written\n")
    assert said.endswith(f"{interrupts.INTERRUPTED}\n") and said.count("\n") == 1


def test_an_interrupt_of_code_in_a_string_keeps_its_exit_code(tmp_path):
    program = """
import signal
from hloc_reduce.utils import cli

cli.run(lambda: exec("signal.raise_signal(signal.SIGTERM)", {"signal": signal}))
"""
    (tmp_path / "ended.py").write_text(program)
    command = [sys.executable, "-m", "ended"]
    found = ":".join([str(tmp_path), *sys.path])
    run = subprocess.run(command, env={**os.environ, "PYTHONPATH": found}, cwd=tmp_path)
    assert run.returncode == 143


@pytest.mark.parametrize(
    "pipeline, workers, signals, number",
    [
        ("aachen", None, KILL, 1),
        ("inloc", 2, KILL, 1),
        ("aachen", 2, STOP, 1),
        ("inloc", None, STOP, 1),
        *(
            pytest.param(pipeline, workers, signals, number, marks=pytest.mark.long)
            for signals, number in ((KILL, 20), (STOP, 5))
            for pipeline in survival.PIPELINES
            for workers in BOTH
        ),
    ],
)
def test_a_run_that_is_ended_at_any_moment_goes_on(
    pipeline, workers, signals, number, request, tmp_path
):
    place = request.getfixturevalue(f"{pipeline}_layout")
    survival.end_at_random(pipeline, place, tmp_path / "runs", workers, number, signals, SEED)


def test_an_h5_file_is_whole_when_an_interrupt_is_heard(tmp_path):
    with pytest.raises(KeyboardInterrupt), write_h5(tmp_path / "a.h5") as file:
        for i in range(100):
            file[str(i)] = np.arange(1000)
            if i == 50:
                signal.raise_signal(signal.SIGINT)
    with h5py.File(tmp_path / "a.h5") as file:
        assert len(file) == 100 and file["99"][999] == 999


@pytest.fixture
def heard():
    """The handlers of both signals; the one of SIGINT raises a KeyboardInterrupt."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield [signal.getsignal(stop) for stop in interrupts.STOPS]
    signal.signal(signal.SIGINT, before)


def flush(writer):
    writer.added.flush()


def merge(writer):
    writer._merge()


@pytest.mark.parametrize("write", [flush, merge])
@pytest.mark.parametrize("step", [2, pytest.param(1, marks=pytest.mark.long)])
def test_an_interrupt_at_any_line_loses_no_group(step, write, heard, tmp_path, monkeypatch):
    modules = contextlib, files, group_writer, h5, interrupts
    monkeypatch.setattr(os, "fsync", lambda _: None)  # no power cut; it takes most of the time
    with GroupWriter(tmp_path / "before.h5", {}) as writer:
        writer.add("first", {"c": np.arange(3)})

    def extend(path, moment=None):
        """Add a group, interrupted at a line of the modules; return the number of lines."""
        lines, ended = 0, False

        def trace(frame, event, _):
            nonlocal lines
            if frame.f_code.co_filename not in {module.__file__ for module in modules}:
                return None
            lines += event == "line"
            if event == "line" and lines == moment:
                signal.raise_signal(signal.SIGINT)
            return trace

        shutil.copyfile(tmp_path / "before.h5", path)
        with contextlib.suppress(KeyboardInterrupt), GroupWriter(path, {}) as writer:
            writer.add("a/b", {"c": np.arange(3)})
            if write is merge:
                flush(writer)
            before = sys.gettrace()
            sys.settrace(trace)
            try:
                write(writer)
            finally:
                sys.settrace(before)
            ended = True
        assert ended is (moment is None), moment
        return lines

    for moment in range(1, extend(tmp_path / "whole.h5") + 1, step):
        extend(path := tmp_path / f"{moment}.h5", moment)
        assert [signal.getsignal(stop) for stop in interrupts.STOPS] == heard, moment
        with GroupWriter(path, {}) as writer:
            assert writer.names == {"first", "a/b"}, moment


@pytest.mark.parametrize("kind, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize(
    "workers, delay",
    [
        (None, 0),
        (2, 0),
        *(
            pytest.param(workers, delay, marks=pytest.mark.long)
            for workers in BOTH
            for delay in (0.5, 1, 2, 3, 4, 5)
        ),
    ],
)
def test_a_command_that_is_interrupted_says_how_to_go_on(
    workers, delay, kind, code, aachen_layout, tmp_path
):
    run = survival.start(aachen_layout, tmp_path / "run", workers)
    if workers:
        while len(survival.processes_of_session(run.pid)) < 3:  # the first of them begins
            assert run.poll() is None
            time.sleep(0.01)
    else:
        while "numpy" not in Path(f"/proc/{run.pid}/maps").read_text():  # it begins to import
            time.sleep(0.01)
    time.sleep(delay)
    began = time.perf_counter()
    (os.killpg if kind == signal.SIGINT else os.kill)(run.pid, kind)
    _, said = run.communicate(timeout=survival.TIMEOUT)
    took = time.perf_counter() - began
    if not (tmp_path / "run/summary.json").exists():  # else it was over before
        assert run.returncode == code, said
        assert said.splitlines()[-1].endswith(interrupts.INTERRUPTED), said
        assert "Traceback" not in said and "***" not in said
        assert took < 15
    while survival.processes_of_session(run.pid):
        assert time.perf_counter() < began + 15, "a process is left"
        time.sleep(0.02)
    print(f"interrupted after {delay} s, it took {took:.2f} s to end", file=sys.stderr)
