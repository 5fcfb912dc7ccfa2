"""An outputs folder is of one run at a time."""

import os
import subprocess
import sys

import command
import pytest

from hloc_reduce.runtime.outputs import LOCK, Lock
from hloc_reduce.utils.cli import InputError
from pipelines import aachen


def test_a_second_run_is_refused_and_a_dead_one_is_not_in_the_way(
    aachen_layout, tmp_path, monkeypatch, caplog
):
    outputs = tmp_path / "outputs"
    holder = (
        f"from hloc_reduce.runtime.outputs import Lock; from pathlib import Path; import time; \
lock = Lock(Path({str(outputs)!r})); print('held', flush=True); time.sleep(60)"
    )
    other = subprocess.Popen([sys.executable, "-c", holder], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout.readline() == "held\n"
        given = ("--dataset", aachen_layout, "--outputs", outputs, "--feature", "sift_sv16")
        message = command.refused(monkeypatch, caplog, aachen, *given)
        assert f"Another run is at work in {outputs} (process {other.pid} on " in message
        assert {path.name for path in outputs.iterdir()} == {LOCK}
    finally:
        other.kill()
        other.wait()
    command.run(monkeypatch, aachen, *given)
    assert command.outcome(outputs)[0]["queries_localized"] == 2


def test_a_lock_ends_with_its_block(tmp_path):
    lock = Lock(tmp_path)
    with pytest.raises(InputError, match=f"process {os.getpid()}"):
        Lock(tmp_path)
    lock.release()
    Lock(tmp_path).release()


@pytest.mark.skipif(os.getuid() == 0, reason="root may write to any folder")
def test_a_folder_that_cannot_be_written_needs_no_lock(tmp_path):
    tmp_path.chmod(0o500)
    Lock(tmp_path).release()
    tmp_path.chmod(0o700)
