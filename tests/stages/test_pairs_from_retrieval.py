"""Pairs by the similarity of global descriptors."""

import h5py
import numpy as np
import pytest

from hloc_reduce import pairs_from_retrieval
from hloc_reduce.retrieval import ranking
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.parsers import parse_retrieval


@pytest.mark.parametrize("block", [1, 2, 2**26])
def test_retrieval_ranks_by_similarity(tmp_path, monkeypatch, block):
    monkeypatch.setattr(ranking, "MAX_BLOCK_BYTES", block * 3 * 4)
    monkeypatch.setattr(ranking, "MAX_SIMILARITY_ROWS", 1)
    path = tmp_path / "global.h5"
    vectors = {
        "q/0": [1, 0, 0],
        "q/blank": [0, 0, 0],
        "db/same": [1, 0, 0],
        "db/near": [0.8, 0.6, 0],
        "db/opposite": [-1, 0, 0],
        "db/blank": [0, 0, 0],
    }
    with h5py.File(path, "w") as file:
        for name, vector in vectors.items():
            file[f"{name}/global_descriptor"] = np.array(vector, np.float16)
    output = tmp_path / "pairs.txt"
    arguments = {"query_prefix": "q/", "db_prefix": "db/"}
    pairs_from_retrieval.main(path, output, 10, **arguments)
    retrieval = parse_retrieval(output)
    assert retrieval["q/0"] == ["db/same", "db/near", "db/opposite", "db/blank"]
    # as similar as others, in the order of the names
    assert retrieval["q/blank"] == ["db/near", "db/opposite", "db/same", "db/blank"]
    pairs_from_retrieval.main(path, output, 2)
    retrieval = parse_retrieval(output)
    assert all(name not in others and len(others) == 2 for name, others in retrieval.items())
    with pytest.raises(InputError, match="db/none is not in"):
        pairs_from_retrieval.main(path, output, 2, query_prefix="q/", db_list=["db/none"])
    with pytest.raises(InputError, match="No image is selected"):
        pairs_from_retrieval.main(path, output, 2, query_prefix="x/")


def put(group, key, value):
    if key in group:
        del group[key]
    if value is not None:
        group[key] = value


@pytest.mark.parametrize("value", [None, 3.0, "none", np.zeros(0), np.full(9, np.nan), np.eye(9)])
def test_global_descriptors_of_other_tools(value, tmp_path):
    path, output = tmp_path / "global.h5", tmp_path / "pairs.txt"
    with h5py.File(path, "w") as file:
        file["version"] = 1  # at the root, where no image is
        for name in "abc":
            file[f"{name}.jpg/global_descriptor"] = np.eye(9)[ord(name) - ord("a")]
    pairs_from_retrieval.main(path, output, 2)
    with h5py.File(path, "r+") as file:
        put(file["a.jpg"], "note", 3)
        put(file["a.jpg"], "global_descriptor", value)
    with pytest.raises(InputError, match="global.h5.*a.jpg"):
        pairs_from_retrieval.main(path, output, 2)
