"""The h5 writer: what it keeps when a run is killed, and what it refuses."""

import h5py
import numpy as np
import pytest

from hloc_reduce.runtime import group_writer
from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.h5 import list_h5_names, open_h5


def read(path):
    with h5py.File(path) as file:
        return {name: file[name]["a"][()].tolist() for name in list_h5_names(path)}


def test_writer_extends_and_keeps_attributes(tmp_path):
    path = tmp_path / "f.h5"
    with GroupWriter(path, {"x": 1}) as writer:
        writer.add("db/1.jpg", {"a": np.arange(3)}, {"a": {"uncertainty": 2.0}})
    with GroupWriter(path, {"x": 1}) as writer:
        assert "db/1.jpg" in writer and "db/2.jpg" not in writer
        writer.add("db/2.jpg", {"a": np.zeros(0)})
    assert read(path) == {"db/1.jpg": [0, 1, 2], "db/2.jpg": []}
    with h5py.File(path) as file:
        assert file["db/1.jpg/a"].attrs["uncertainty"] == 2.0
    assert [p.name for p in tmp_path.iterdir()] == ["f.h5"]


def test_writer_keeps_what_was_finished_before_a_failure(tmp_path):
    path = tmp_path / "f.h5"
    with pytest.raises(RuntimeError), GroupWriter(path, {}) as writer:
        writer.add("1", {"a": np.ones(2)})
        raise RuntimeError
    assert not path.exists()
    with GroupWriter(path, {}) as writer:
        assert "1" in writer
        writer.add("2", {"a": np.zeros(1)})
    assert read(path) == {"1": [1, 1], "2": [0]}


def test_killed_writer_loses_only_its_buffer(tmp_path):
    path = tmp_path / "f.h5"
    writer = GroupWriter(path, {})
    writer.add("1", {"a": np.ones(2)})
    writer.added.flush()
    writer.add("2", {"a": np.ones(2)})  # and here the power fails
    (writer.folder / ".000001.h5.7.tmp").write_bytes(b"half a file")
    with GroupWriter(path, {}) as again:
        assert "1" in again and "2" not in again
    assert read(path) == {"1": [1, 1]}


def test_writer_finishes_a_merge_that_was_cut_before_clearing(tmp_path):
    path = tmp_path / "f.h5"
    writer = GroupWriter(path, {})
    writer.add("1", {"a": np.ones(2)})
    writer.added.flush()
    path.write_bytes(next(writer.folder.iterdir()).read_bytes())
    with GroupWriter(path, {}):
        pass
    assert read(path) == {"1": [1, 1]} and not writer.folder.exists()


def test_writer_refuses_another_configuration(tmp_path):
    path = tmp_path / "f.h5"
    with GroupWriter(path, {"dim": 64, "same": 1}) as writer:
        writer.add("1", {"a": np.ones(2)})
    with pytest.raises(InputError, match="dim: 64 before, 32 now"):
        GroupWriter(path, {"dim": 32, "same": 1})
    with GroupWriter(path, {"dim": 32}, overwrite=True) as writer:
        assert "1" not in writer


def test_broken_h5_is_refused_and_kept(tmp_path):
    path = tmp_path / "f.h5"
    path.write_bytes(b"\x89HDF\r\n\x1a\n truncated")
    with pytest.raises(InputError, match="not a whole h5 file"):
        GroupWriter(path, {})
    assert path.exists()
    with pytest.raises(InputError, match="does not exist"), open_h5(tmp_path / "absent.h5"):
        pass


def test_two_writers_of_a_file_lose_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(group_writer, "PIECE_BYTES", 0)
    first, second = GroupWriter(tmp_path / "f.h5", {}), GroupWriter(tmp_path / "f.h5", {})
    for writer, name in ((first, "a"), (second, "b"), (first, "c")):
        writer.add(name, {"a": np.zeros(1)})
    with second:
        pass
    with first:
        pass
    assert list_h5_names(tmp_path / "f.h5") == ["a", "b", "c"]


def test_a_gap_in_the_pieces_loses_none(tmp_path, monkeypatch):
    monkeypatch.setattr(group_writer, "PIECE_BYTES", 0)  # each group is a piece
    path = tmp_path / "f.h5"
    with pytest.raises(KeyboardInterrupt), GroupWriter(path, {}) as writer:
        for name in "abc":
            writer.add(name, {"a": np.arange(3)})
        raise KeyboardInterrupt
    min((tmp_path / "f.h5.pieces").iterdir()).unlink()
    with GroupWriter(path, {}) as writer:
        assert [name in writer for name in "abc"] == [False, True, True]
        for name in "de":
            writer.add(name, {"a": np.arange(3)})
    assert list_h5_names(path) == ["b", "c", "d", "e"]
