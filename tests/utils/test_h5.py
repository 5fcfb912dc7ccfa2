"""Names and matches in h5 files."""

import h5py
import numpy as np
import pytest

from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.h5 import list_h5_names
from hloc_reduce.utils.match_files import get_matches


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
