"""Files on file systems without locks, and files that another program has open for writing."""

import errno
import fcntl
import os
import shutil
import subprocess
import sys
from contextlib import contextmanager
from functools import partial

import h5py
import numpy as np
import pycolmap
import pytest

from hloc_reduce.runtime.group_writer import GroupWriter, failures, resume_or_replace
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.h5 import list_h5_names

pytestmark = pytest.mark.fault(4)

NO_LOCKS = """
#include <errno.h>
int flock(int fd, int how) { (void)fd; (void)how; errno = ENOLCK; return -1; }
"""
# writes, adds to and reads a file twice at once, as stages do
WORK = """
import sys
from pathlib import Path
import numpy as np
from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.runtime.outputs import Lock
from hloc_reduce.utils.h5 import get_array, open_h5
path = Path(sys.argv[1], "folder/file.h5")
with Lock(path.parent):
    for number in (1, 2):
        with GroupWriter(path, {}) as writer:
            writer.add(f"{number}.jpg", {"numbers": np.full(2, number)})
with open_h5(path) as file, open_h5(path) as again:
    print(get_array(file, "1.jpg", "numbers", (1,)), get_array(again, "2.jpg", "numbers", (1,)))
"""


@pytest.fixture
def stored(tmp_path):
    path = tmp_path / "feats.h5"
    with GroupWriter(path, {}) as writer:
        writer.add("a.jpg", {"keypoints": np.ones((3, 2))})
    return path


@contextmanager
def written_elsewhere(path):
    """Hold the lock of HDF5 as a program that writes to a file does."""
    with path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def no_locks(*_):
    raise OSError(errno.ENOLCK, "No locks available")


def test_a_file_system_without_locks(tmp_path):
    """Its locks fail in C, where HDF5 asks for them."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("there is no C compiler")
    (tmp_path / "no_locks.c").write_text(NO_LOCKS)
    library = tmp_path / "no_locks.so"
    subprocess.run(
        [compiler, "-shared", "-fPIC", "-o", library, "no_locks.c"], cwd=tmp_path, check=True
    )
    done = subprocess.run(
        [sys.executable, "-c", WORK, tmp_path],
        env={**os.environ, "LD_PRELOAD": str(library)},
        capture_output=True,
        text=True,
    )
    assert done.stdout == "[1 1] [2 2]\n", done.stderr
    assert "cannot be locked" in done.stderr and "start no second run" in done.stderr


def test_a_database_of_colmap_without_locks(tmp_path, monkeypatch):
    """It is read; COLMAP itself, which does not say why, cannot write one."""
    path = tmp_path / "colmap.db"
    with colmap.open_database(path):
        pass
    monkeypatch.setattr(fcntl, "lockf", no_locks)
    with colmap.open_stored(path) as stored:
        assert stored.images == {}

    def fails(_):
        raise RuntimeError("No registered database factory succeeded.")

    monkeypatch.setattr(pycolmap.Database, "open", fails)
    message = "colmap.db has no locks.*: choose a folder on a local disk"
    with pytest.raises(InputError, match=message), colmap.open_database(path):
        pass


@pytest.mark.parametrize("read", [list_h5_names, failures, partial(GroupWriter, conf={})])
def test_a_file_that_another_program_writes_to(read, stored):
    content = stored.read_bytes()
    with (
        written_elsewhere(stored),
        pytest.raises(InputError, match=f"{stored} is open for writing in another program: wa"),
    ):
        read(stored)
    assert stored.read_bytes() == content
    read(stored)


def test_an_intermediate_file_in_use_is_not_replaced(stored):
    with written_elsewhere(stored), pytest.raises(InputError):
        resume_or_replace(stored, {"stale": True})
    assert list_h5_names(stored) == ["a.jpg"]


def test_a_file_whose_writer_was_killed(tmp_path):
    """HDF5 marks a file of its latest format that is open; the mark stays if the writer dies."""
    path, copy = tmp_path / "feats.h5", tmp_path / "copy.h5"
    with h5py.File(path, "w", libver="latest") as file:
        file["numbers"] = 1
        file.flush()
        shutil.copy(path, copy)
    with pytest.raises(InputError, match=rf"killed, mend the file \(h5clear -s {copy}\)"):
        list_h5_names(copy)


@pytest.mark.parametrize("error", [errno.EACCES, errno.EIO, errno.EMFILE, errno.ESTALE])
def test_a_file_that_the_system_does_not_open_is_not_broken(error, stored, monkeypatch):
    def fails(*_, **__):
        raise OSError(error, "Unable to open file")

    monkeypatch.setattr(h5py, "File", fails)
    with pytest.raises(InputError, match=f"Cannot open {stored}: {os.strerror(error)}"):
        list_h5_names(stored)
