"""Hostile records of runs and lists of HPatches are read or refused."""

import json

import pytest
from hostile import check_text, fuzzed
from hypothesis import given
from hypothesis import strategies as st

from hloc_reduce.evaluation.hpatches import lists
from hloc_reduce.evaluation.hpatches.data import test_sequences as sequences
from hloc_reduce.evaluation.poses import read_estimates
from hloc_reduce.localization.records import RECORDS
from hloc_reduce.utils.cli import InputError

RECORD = {
    "localized": True,
    "qvec": [1.0, 0.0, 0.0, 0.0],
    "tvec": [0.0, 0.0, 1.0],
    "num_inliers": 9,
}


FRAMES = {"i_a": 2, "v_b": 3}
# what is read: its file, the lines of a sound one, and the parser of its path
TEXTS = {
    "records": (
        "r_logs.jsonl",
        [
            json.dumps({"records": RECORDS}),
            json.dumps(["a.jpg", RECORD]),
            '["b.jpg", {"localized": false, "qvec": null}]',
        ],
        read_estimates,
    ),
    "pairs of HPatches": (
        "l.csv",
        [",".join(lists.PAIR_COLUMNS), "i_a,0,1,v_b,5,2"],
        lambda path: lists._read(path, lists.PAIR_COLUMNS, FRAMES),
    ),
    "patches of HPatches": (
        "l.csv",
        [",".join(lists.PATCH_COLUMNS), "i_a,1", "v_b,2"],
        lambda path: lists._read(path, lists.PATCH_COLUMNS, FRAMES),
    ),
    "splits of HPatches": (
        "splits.json",
        ['{"a": {"test": ["i_a"], "train": []}}'],
        lambda path: sequences(path.parent, path.parent, "a"),
    ),
}


@pytest.mark.parametrize("kind", TEXTS)
def test_text_files_are_read_or_refused(kind, tmp_path):
    (tmp_path / "i_a").mkdir()
    (tmp_path / "i_a/ref.png").touch()  # beside the splits
    name, lines, read = TEXTS[kind]
    check_text(tmp_path / name, lines, read)


def test_a_table_with_a_cell_without_an_end_is_refused(tmp_path):
    path = tmp_path / "l.csv"
    path.write_text("s,idx\n" + "i" * 200_000 + ",1\n")
    with pytest.raises(InputError, match="l.csv, line 2: field larger"):
        lists._read(path, lists.PATCH_COLUMNS, {"i_a": 2})


@fuzzed
@given(
    rows=st.lists(
        st.tuples(st.sampled_from(["i_a", "v,b"]), st.integers(0, 1)), min_size=1, max_size=9
    )
)
def test_lists_of_hpatches_round_trip(tmp_path, rows):
    path = tmp_path / "list.csv"
    lists._write(rows, lists.PATCH_COLUMNS, path)
    assert lists._read(path, lists.PATCH_COLUMNS, {"i_a": 2, "v,b": 2}) == rows
