"""Runs that are killed, interrupted, started twice or out of space."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import command
import h5py
import numpy as np
import pytest
import survival

from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.runtime.outputs import LOCK, Lock
from hloc_reduce.utils import cli, interrupts
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.h5 import write_h5
from pipelines import aachen

SEED = 0
KILL, STOP = (signal.SIGKILL,), (signal.SIGINT, signal.SIGTERM)
BOTH = (None, 2)  # the serial executor, and one of two processes


@pytest.fixture(autouse=True)
def propagated(monkeypatch):
    monkeypatch.setattr(cli.logger, "propagate", True)  # for caplog


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


def test_outputs_of_another_configuration_are_refused(aachen_layout, tmp_path, monkeypatch, caplog):
    outputs = tmp_path / "outputs"
    given = ["--dataset", aachen_layout, "--outputs", outputs, "--feature"]
    command.run(monkeypatch, aachen, *given, "sift_sv16")
    before = command.results(outputs)
    for others, named in (
        (["sift_sv16", "--num_loc", 3], "differs: num_loc. "),
        (["sift_sv16", "--storage", "uint8"], "differs: feature (storage "),
        (
            ["sift_sv32", "--matcher", "NN-mutual"],
            "differs: feature (model, projection_sha256) and",
        ),
    ):
        message = command.refused(monkeypatch, caplog, aachen, *given, *others)
        assert f"What {outputs} was made from {named}" in message
        assert "Choose other --outputs" in message
    assert command.results(outputs) == before


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
from hloc_reduce import cli, interrupts

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


@pytest.mark.parametrize(
    "pipeline, workers, signals, number",
    [
        ("aachen", None, KILL, 2),
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


def test_what_a_full_disk_does_not_hold_is_one_error(disk):
    folder, set_free = disk
    with write_h5(folder / "a.h5") as file:
        file["whole"] = np.arange(1000)
    set_free(100_000)
    shutil.copy(folder / "a.h5", folder / "b.h5")
    with pytest.raises(OSError, match="No space left"), write_h5(folder / "b.h5") as file:
        for i in range(100):
            file[str(i)] = np.random.rand(1000)
            assert np.isfinite(file[str(i)][()]).all()
    with h5py.File(folder / "a.h5") as file:
        assert file["whole"][999] == 999


@pytest.fixture
def disk(tmp_path):
    """A folder that is a disk of its own, and a function that sets how many bytes it has free."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", folder]
    if os.getuid() or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("a small disk cannot be mounted here")

    def set_free(size):
        status = os.statvfs(folder)
        size += (status.f_blocks - status.f_bavail) * status.f_frsize
        subprocess.run(["mount", "-o", f"remount,size={size}", folder], check=True)

    yield folder, set_free
    subprocess.run(["umount", "--lazy", folder], check=True)


PROGRAM = """
import sys
from pathlib import Path
from hloc_reduce import cli, extract_features
from hloc_reduce.executors import processes_of_this_machine
from pipelines import aachen

def main():
    extract_features.CHUNK = 2
    with processes_of_this_machine(2) as executor:
        aachen.main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], executor=executor)

cli.run(main)
"""


def start(place, outputs, workers=None):
    """Start the pipeline for Aachen: its command line, or a program with so many processes."""
    given = ["-m", "pipelines.aachen", "--dataset", place, "--outputs", outputs, "--feature"]
    if workers:
        given = ["-c", PROGRAM, place, outputs]
    command = [sys.executable, *given, survival.FEATURE]
    return subprocess.Popen(command, stdout=-1, stderr=-1, text=True, start_new_session=True)


@pytest.mark.parametrize("workers", [None, pytest.param(2, marks=pytest.mark.long)])
@pytest.mark.parametrize(
    "stage, free, file",
    [
        # of tiny photos: pieces of 30 KB, matches of 2 KB, a database of 0.2 MB that grows twofold
        ("extract_features", 750_000, "feats-dog-"),
        ("triangulation", 250_000, "database.db"),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in (
                ("extract_features", 5_000, ""),
                ("extract_features", 100_000, ".h5.pieces/"),
                ("extract_features", 900_000, "feats-dog-"),
                ("extract_features", 1_100_000, "feats-dog-"),
                ("pairs_from_covisibility", 0, ""),
                ("match_map", 5_000, ".h5.pieces/"),
                ("match_map", 30_000, "_matches-"),
                ("triangulation", 20_000, "database.db"),
                ("triangulation", 150_000, "database.db"),
                ("triangulation", 400_000, "database.db"),
                ("triangulation", 440_000, ""),
                ("retrieval", 0, ""),
                ("retrieval", 9_000, ""),
                ("retrieval", 30_000, "global-feats"),
                ("match_queries", 0, ""),
                ("match_queries", 30_000, "_matches-"),
                ("localization", 0, ""),
                ("localization", 4096, ""),
                ("localization", 8192, ""),
                ("localization", 12288, ""),
            )
        ),
    ],
)
def test_a_full_disk_is_one_clear_error_and_the_run_goes_on_after_it(
    stage, free, file, workers, disk, aachen_layout, tmp_path
):
    folder, set_free = disk
    outputs = folder / "run"
    aachen.main(aachen_layout, tmp_path / "other/run", survival.FEATURE)
    expected = command.results(tmp_path / "other/run")
    shutil.copytree(tmp_path / "other/run", outputs)
    stages = json.loads((outputs / "stages.json").read_text())
    products = [
        name
        for later in list(stages)[list(stages).index(stage) :]
        for name in stages[later]["wrote"]
    ]
    for name in [*products, "queries.csv", "summary.json"]:
        path = outputs / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    set_free(free)
    before = survival.on_disk(outputs)

    run = start(aachen_layout, outputs, workers)
    printed, said = run.communicate(timeout=survival.TIMEOUT)
    assert run.returncode == 2, said
    assert "Traceback" not in said and not printed
    (error,) = [line for line in said.splitlines() if " ERROR] " in line]
    assert error == said.splitlines()[-1]
    assert "No space left on device" in error and f"'{folder}" in error and file in error
    done = survival.on_disk(outputs)
    assert before <= done
    if (stage, free) == ("extract_features", 750_000):
        assert len(done) == 7  # all pieces, which were to be merged

    set_free(2**24)
    aachen.main(aachen_layout, outputs, survival.FEATURE)
    assert command.results(outputs) == expected
    assert survival.names(outputs) == survival.names(tmp_path / "other/run")


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
    run = start(aachen_layout, tmp_path / "run", workers)
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
