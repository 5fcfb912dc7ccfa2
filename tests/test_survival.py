"""Runs that are killed, interrupted, started twice or out of space."""

import os
import signal
import subprocess
import sys

import command
import pytest

from hloc_reduce import cli, io
from hloc_reduce.cli import InputError
from hloc_reduce.group_writer import GroupWriter
from pipelines import aachen


@pytest.fixture(autouse=True)
def propagated(monkeypatch):
    monkeypatch.setattr(cli.logger, "propagate", True)  # for caplog


def test_a_second_run_is_refused_and_a_dead_one_is_not_in_the_way(
    aachen_layout, tmp_path, monkeypatch, caplog
):
    outputs = tmp_path / "outputs"
    holder = f"from hloc_reduce.io import Lock; from pathlib import Path; import time; \
lock = Lock(Path({str(outputs)!r})); print('held', flush=True); time.sleep(60)"
    other = subprocess.Popen([sys.executable, "-c", holder], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout.readline() == "held\n"
        given = ("--dataset", aachen_layout, "--outputs", outputs, "--feature", "sift_sv16")
        message = command.refused(monkeypatch, caplog, aachen, *given)
        assert f"Another run is at work in {outputs} (process {other.pid} on " in message
        assert {path.name for path in outputs.iterdir()} == {io.LOCK}
    finally:
        other.kill()
        other.wait()
    command.run(monkeypatch, aachen, *given)
    assert command.outcome(outputs)[0]["queries_localized"] == 2


def test_a_lock_ends_with_its_block(tmp_path):
    lock = io.Lock(tmp_path)
    with pytest.raises(InputError, match=f"process {os.getpid()}"):
        io.Lock(tmp_path)
    lock.release()
    io.Lock(tmp_path).release()


@pytest.mark.skipif(os.getuid() == 0, reason="root may write to any folder")
def test_a_folder_that_cannot_be_written_needs_no_lock(tmp_path):
    tmp_path.chmod(0o500)
    io.Lock(tmp_path).release()
    tmp_path.chmod(0o700)


@pytest.mark.parametrize("kind, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_run_writes_what_is_done(tmp_path, kind, code):
    program = f"""
import time
import numpy, pycolmap
from pathlib import Path
from hloc_reduce import cli
from hloc_reduce.group_writer import GroupWriter

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
    assert line.endswith(
        "Interrupted. The same command, but for any --overwrite, goes on from here."
    )
    with GroupWriter(tmp_path / "f.h5", {}) as writer:
        assert "done" in writer
