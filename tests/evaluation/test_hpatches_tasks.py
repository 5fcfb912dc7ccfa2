"""The tasks of HPatches, on cases computed by hand."""

import numpy as np
import pytest
import torch
from test_ranking import curve_area

from hloc_reduce.evaluation.hpatches import data, tasks
from hloc_reduce.runtime.group_writer import GroupWriter


def test_matching_by_hand():
    rows = np.eye(6, dtype=np.float32)
    assert tasks.matching_ap(rows, rows) == 1
    # all are equally far: the first of the second image is every row's nearest
    constant = np.ones((6, 4), np.float32)
    assert tasks.matching_ap(constant, constant) == pytest.approx(1 / 6, abs=1e-6)
    # two rows are exchanged: equally near as the others, and first in their order
    swapped = rows[[1, 0, 2, 3, 4, 5]]
    expected = curve_area([False, False, True, True, True, True], 6)
    assert tasks.matching_ap(rows, swapped) == pytest.approx(expected, abs=1e-6)
    # row 3 finds row 0 at once, and before all others
    wrong = 0.9 * rows
    wrong[0] = rows[3]
    expected = curve_area([False, True, True, True, True, False], 6)
    assert tasks.matching_ap(rows, wrong) == pytest.approx(expected, abs=1e-6)


def described(tmp_path, of_sequence):
    """The descriptors of two sequences, of 4 and 3 patches; of_sequence(number, kind)."""
    sequences = ["i_one", "v_two"]
    with GroupWriter(tmp_path / "d.h5", {}) as writer:
        for number, name in enumerate(sequences):
            writer.add(name, {kind: of_sequence(number, kind) for kind in data.PATCH_TYPES})
    return data.Descriptors(tmp_path / "d.h5", sequences, torch.nn.Identity())


def perfect(number, kind):
    return np.eye(7, dtype=np.float32)[:4] if number == 0 else np.eye(7, dtype=np.float32)[4:]


def constant(number, kind):
    return np.ones((4 - number, 7), np.float32)


FIRST = [(0, 0), (2, 5), (3, 2), (1, 1), (1, 6)]
PAIRS = {
    "pos": [(1, 0), (0, 5), (4, 2), (5, 1), (2, 6)],
    "neg_inter": [(1, 4), (0, 1), (4, 6), (5, 5), (2, 3)],
    "neg_intra": [(1, 1), (0, 4), (4, 0), (5, 3), (2, 5)],
}
PAIRS = {kind: np.stack([FIRST, second], axis=1) for kind, second in PAIRS.items()}


def test_a_perfect_descriptor(tmp_path):
    descriptors = described(tmp_path, perfect)
    pool = np.array([1, 2, 4, 5])
    for scores in (
        tasks.matching(descriptors),
        tasks.verification(descriptors, PAIRS),
        tasks.retrieval(descriptors, np.array([0, 6]), pool),
    ):
        assert {score for _, _, score in scores} == {1}


def test_a_constant_descriptor(tmp_path):
    descriptors = described(tmp_path, constant)
    scores = list(tasks.matching(descriptors))
    assert len(scores) == 2 * 3 * 5
    assert {round(score, 6) for _, _, score in scores} == {0.25, 0.333333}
    # the only one of the positives that is left comes after five negatives
    for _, variant, score in tasks.verification(descriptors, PAIRS):
        assert score == pytest.approx(0 if "imb" not in variant else 1 / 12, abs=1e-6)
    # its own patches are first
    for _, _, score in tasks.retrieval(descriptors, np.array([0, 6]), np.array([1, 2, 4, 5])):
        assert score == 1


def test_verification_by_hand(tmp_path):
    """Patches at 0, 1, 2, ... on a line; noise moves those of image 1 and of hard image 2."""

    def line(number, kind):
        places = np.arange(4 - number)[:, None] + (0 if number == 0 else 4.0)
        return (places + {"e1": 0.25, "h1": 1.5}.get(kind, 0)).astype(np.float32)

    descriptors = described(tmp_path, line)
    right = np.stack([[(0, 0), (1, 5), (1, 1), (0, 2), (2, 3)]] * 2, axis=1)
    right[:, 1, 0] = [1, 0, 2, 1, 3]  # the same patches in other images
    wrong = [
        [(0, 0), (1, 1)],
        [(2, 5), (0, 3)],
        [(3, 1), (2, 3)],
        [(1, 3), (0, 4)],
        [(4, 2), (5, 2)],
    ]
    pairs = {"pos": right, "neg_inter": np.array(wrong), "neg_intra": np.array(wrong)}
    scores = {
        (noise, variant): score
        for noise, variant, score in tasks.verification(descriptors, pairs)
        if "inter" in variant
    }
    # easy: right 1/4, 1/4, 1/4, 1/4, 0; wrong 5/4, 2, 2, 3/4, 0
    assert scores["e", "inter balanced"] == pytest.approx((4 * 4 + 4) / 25, abs=1e-6)
    # of the positives the first one is left: second after the equal patches of the last pair
    assert scores["e", "inter imbalanced"] == pytest.approx((0 + 1 / 2) / 2, abs=1e-6)
    # hard: 3/2, and wrong 5/2, 2, 2, 1/2, 0
    assert scores["h", "inter imbalanced"] == pytest.approx((0 + 1 / 3) / 2, abs=1e-6)


def test_retrieval_by_hand(tmp_path):
    right = np.array([[1.0, 2, 3, 4, 5]] * 3)
    # in the smallest pool there are 95 distractors
    wrong = np.array([2, 0.5, *[9] * 93, 0.1, 0.1])
    ranks = tasks.ranks_in_pools(right, wrong)
    assert ranks.shape == (3, len(tasks.POOLS), 5)
    assert ranks[0, 0].tolist() == [2, 3, 5, 6, 7]  # its own before the equal one
    assert ranks[2, 1].tolist() == [4, 5, 7, 8, 9]
    assert tasks.ranks_in_pools(right, np.array([]))[0, 3].tolist() == [1, 2, 3, 4, 5]

    # its own patches are as far as a distractor, which counts as farther
    generator = np.random.default_rng(0)
    for i in range(10):
        rows = torch.nn.functional.normalize(torch.from_numpy(generator.normal(size=(3, 128))))
        reference, noisy, other = rows.float().numpy()

        def tied(number, kind, reference=reference, noisy=noisy, other=other):
            first = reference if kind == "ref" else noisy
            return np.stack([first, other, other, other] if number == 0 else [noisy] * 3)

        (tmp_path / str(i)).mkdir()
        descriptors = described(tmp_path / str(i), tied)
        scores = tasks.retrieval(descriptors, np.array([0]), np.array([4, 5, 6]))
        assert {score for _, _, score in scores} == {1}

    def line(number, kind):
        return np.arange(4 - number)[:, None].astype(np.float32) + 4 * number

    descriptors = described(tmp_path, line)
    # the distractors 1, 2, 3 are of the query's own sequence
    for _, _, score in tasks.retrieval(descriptors, np.array([0]), np.array([1, 2, 3, 5])):
        assert score == 1
