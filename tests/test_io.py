import os

import h5py
import numpy as np
import pytest

from hloc_reduce.runtime import group_writer
from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.files import replacing
from hloc_reduce.utils.h5 import list_h5_names, open_h5
from hloc_reduce.utils.images import read_image
from hloc_reduce.utils.match_files import get_matches


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


def test_only_groups_of_the_file_itself_are_listed(tmp_path):
    path = tmp_path / "f.h5"
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x/a"] = 1
    with h5py.File(path, "w") as file:
        for name in ("db/2.jpg/a", "db/2.jpg/b", "db/10.jpg/a", "db/sub/3.jpg/a", "q/1/a", "top"):
            file[name] = 1
        file.create_group("empty")
        file["elsewhere"] = h5py.ExternalLink("other.h5", "x")
        file["nowhere"] = h5py.SoftLink("/absent")
    assert list_h5_names(path) == ["db/10.jpg", "db/2.jpg", "db/sub/3.jpg", "q/1"]
    with h5py.File(path, "a") as file:
        file["db/sub/itself"] = file["db"]
    with pytest.raises(InputError, match="has a second name"):
        list_h5_names(path)


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


@pytest.mark.parametrize(
    "group, reverse",
    [
        ("db-1.jpg/query-2.jpg", False),
        ("query-2.jpg/db-1.jpg", True),
        ("db-1.jpg_query-2.jpg", False),
        ("query-2.jpg_db-1.jpg", True),
    ],
)
def test_matches_are_found_in_any_order_and_format(tmp_path, group, reverse):
    with h5py.File(tmp_path / "m.h5", "w") as file:
        file[f"{group}/matches0"] = np.array([-1, 5, -1, 0], np.int16)
        file[f"{group}/matching_scores0"] = np.array([0, 0.5, 0, 1], np.float16)
        matches, scores = get_matches(file, "db/1.jpg", "query/2.jpg")
        expected = [[5, 1], [0, 3]] if reverse else [[1, 5], [3, 0]]
        assert matches.tolist() == expected and scores.tolist() == [0.5, 1]
        with pytest.raises(InputError, match="not in the match file"):
            get_matches(file, "db/1.jpg", "query/3.jpg")


def test_unreadable_images_are_named(tmp_path):
    for content in (b"", b"no image"):
        (tmp_path / "a.jpg").write_bytes(content)
        with pytest.raises(InputError, match="a.jpg"):
            read_image(tmp_path / "a.jpg")
    with pytest.raises(InputError, match="b.jpg"):
        read_image(tmp_path / "b.jpg")


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
