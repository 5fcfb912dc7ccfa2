"""Files are replaced as a whole."""

import os

import pytest

from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.runtime.outputs import Lock
from hloc_reduce.triangulation import replacing_map
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.files import replacing


def test_replacing_keeps_the_old_file_on_failure(tmp_path):
    path = tmp_path / "sub" / "a.txt"
    with replacing(path) as temporary:
        temporary.write_text("old")
    with pytest.raises(RuntimeError), replacing(path) as temporary:
        temporary.write_text("new")
        raise RuntimeError
    assert path.read_text() == "old"
    assert list(path.parent.iterdir()) == [path]


def test_replacing_a_file_while_another_writer_does(tmp_path):
    path = tmp_path / "a.txt"
    with replacing(path) as one:
        one.write_text("one")
        with replacing(path) as other:
            assert not other.exists()
            other.write_text("other")
        assert path.read_text() == "other"
    assert path.read_text() == "one"
    assert list(tmp_path.iterdir()) == [path]


def test_replacing_by_the_same_keeps_the_time(tmp_path):
    path = tmp_path / "a.txt"
    for text, kept in (("old", False), ("old", True), ("new", False), ("new", True)):
        with replacing(path) as temporary:
            temporary.write_text(text)
        assert path.read_text() == text and (path.stat().st_mtime_ns == 10**9) is kept
        os.utime(path, ns=(10**9, 10**9))


WRITERS = {
    "text": lambda folder: replacing(folder / "a.txt").__enter__(),
    "h5": lambda folder: GroupWriter(folder / "a.h5", {}),
    "run": Lock,
    "model": lambda folder: replacing_map(folder, {}).__enter__(),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_a_file_in_place_of_a_folder(tmp_path, kind):
    file = tmp_path / "file"
    file.write_text("mine")
    for folder in (file, file / "a/b"):
        with pytest.raises(InputError, match="file is a file: choose a folder for the results"):
            WRITERS[kind](folder)
    assert file.read_text() == "mine"
    if kind in ("text", "h5"):
        (tmp_path / "a.txt").mkdir()
        (tmp_path / "a.h5").mkdir()
        with pytest.raises(InputError, match="is a folder: name a file in it"):
            WRITERS[kind](tmp_path)
