"""Pairs of images that see the same points."""

import numpy as np
import pytest

from hloc_reduce import pairs_from_covisibility
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.parsers import parse_retrieval


@pytest.mark.parametrize("block", [1, 256])
def test_covisibility_by_hand(monkeypatch, block):
    monkeypatch.setattr(pairs_from_covisibility, "IMAGES_PER_BLOCK", block)
    # image 0 sees point 9 twice, so that it shares 2 with 1, 3 with 2, which share 1; 4 is as 1
    ids = [[7, -1, 9, 9], [9, -1], [7, 9, 4], [-1], [9, -1]]
    ranking = pairs_from_covisibility.most_covisible(map(np.array, ids), 10)
    assert [row.tolist() for row in ranking] == [[2, 1, 4], [0, 2, 4], [0, 1, 4], [], [0, 1, 2]]
    ranking = pairs_from_covisibility.most_covisible(map(np.array, ids), 1)
    assert [row.tolist() for row in ranking] == [[2], [0], [0], [], [0]]


def test_covisible_pairs_of_the_map(built, tmp_path):
    with pytest.raises(InputError, match="no covisible images"):
        pairs_from_covisibility.main(built.model, tmp_path / "p.txt", 2)
    pairs = parse_retrieval(pairs_from_covisibility.main(built.sfm, tmp_path / "p.txt", 2))
    assert {name: len(others) for name, others in pairs.items()} == {
        f"db/{i}.jpg": 2 for i in range(6)
    }
