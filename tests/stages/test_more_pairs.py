"""Pairs that are added where photos are missing in a map."""

import numpy as np

from hloc_reduce import pairs_from_verification


def test_which_pairs_are_added():
    names = [str(i) for i in range(6)]
    descriptors = np.eye(6, dtype=np.float32)
    descriptors[4] = descriptors[5] = [0.9, 0.1, 0.2, 0, 0, 0]
    chain = {("0", "1"): 90, ("1", "2"): 50, ("2", "3"): 40, ("4", "5"): 20}
    more = pairs_from_verification.more_pairs
    added = more(names, set(chain), chain, descriptors, 1, 1)
    # neighbours of neighbours, the most similar of the other component, any of those with few
    assert {("0", "2"), ("1", "3"), ("0", "4"), ("0", "5")} <= set(added)
    assert not set(added) & set(chain)
    assert added == more(names, set(chain), chain, descriptors, 1, 1)
    everything = {(a, b): 99 for a in names for b in names if a < b}
    assert more(names, set(everything), everything, descriptors, 1, 1) == []
    assert more(names, set(), {}, descriptors, 9)  # nothing is verified
