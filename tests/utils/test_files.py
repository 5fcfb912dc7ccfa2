"""Files are replaced as a whole."""

import os

import pytest

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


def test_replacing_by_the_same_keeps_the_time(tmp_path):
    path = tmp_path / "a.txt"
    for text, kept in (("old", False), ("old", True), ("new", False), ("new", True)):
        with replacing(path) as temporary:
            temporary.write_text(text)
        assert path.read_text() == text and (path.stat().st_mtime_ns == 10**9) is kept
        os.utime(path, ns=(10**9, 10**9))
