"""Runs whose disk is full."""

import json
import os
import shutil
import subprocess

import command
import h5py
import numpy as np
import pytest
import survival

from hloc_reduce.utils.h5 import write_h5
from pipelines import aachen

pytestmark = pytest.mark.check


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


@pytest.mark.parametrize("workers", [None, pytest.param(2, marks=pytest.mark.long)])
@pytest.mark.parametrize(
    "stage, free, file",
    [
        # of tiny photos: pieces of 60 KB, matches of 2 KB, a database of 0.2 MB that grows twofold
        ("extract_features", 500_000, "feats-dog-"),
        ("triangulation", 250_000, "database.db"),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in (
                ("extract_features", 5_000, ""),
                ("extract_features", 100_000, ".h5.pieces/"),
                ("extract_features", 450_000, "feats-dog-"),
                ("extract_features", 600_000, "feats-dog-"),
                ("pairs_from_covisibility", 0, ""),
                ("match_map", 5_000, ".h5.pieces/"),
                ("match_map", 20_000, "_matches-"),
                ("triangulation", 20_000, "database.db"),
                ("triangulation", 150_000, "database.db"),
                ("triangulation", 400_000, "database.db"),
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

    run = survival.start(aachen_layout, outputs, workers)
    printed, said = run.communicate(timeout=survival.TIMEOUT)
    assert run.returncode == 2, said
    assert "Traceback" not in said and not printed
    (error,) = [line for line in said.splitlines() if " ERROR] " in line]
    assert error == said.splitlines()[-1]
    assert "No space left on device" in error and str(folder) in error and file in error
    done = survival.on_disk(outputs)
    assert before <= done
    if (stage, free) == ("extract_features", 500_000):
        assert len(done) == 7  # all pieces, which were to be merged

    set_free(2**24)
    aachen.main(aachen_layout, outputs, survival.FEATURE)
    assert command.results(outputs) == expected
    assert survival.names(outputs) == survival.names(tmp_path / "other/run")
