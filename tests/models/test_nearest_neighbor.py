"""Nearest-neighbour matching, compared with its definition."""

import pytest
import torch

from hloc_reduce.matchers import nearest_neighbor
from hloc_reduce.matchers.nearest_neighbor import (
    NearestNeighbor,
    _batches,
    mutual_nearest,
    mutual_nearest_padded,
)
from hloc_reduce.training.levels import fit
from hloc_reduce.utils import best_two
from hloc_reduce.utils.codes import restore, store, to_integers


def unit(number, dim, seed):
    descriptors = torch.randn(number, dim, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(descriptors, dim=1)


def match(descriptors0, descriptors1, ratio_threshold=None, **options):
    matcher = NearestNeighbor({"ratio_threshold": ratio_threshold, **options})
    result = matcher({"descriptors0": descriptors0.T[None], "descriptors1": descriptors1.T[None]})
    return result["matches0"][0], result["matching_scores0"][0]


def by_definition(
    descriptors0, descriptors1, ratio_threshold, distance_threshold=None, do_mutual_check=True
):
    """Nearest neighbours both ways through the tests, from sorted distances."""
    distances = (2 - 2 * descriptors0 @ descriptors1.T).clamp(min=0).sqrt()

    def nearest(distances):
        values, indices = distances.sort(dim=1)
        passed = torch.ones(len(values), dtype=torch.bool)
        if ratio_threshold:
            passed &= values[:, 0] <= ratio_threshold * values[:, 1]
        if distance_threshold:
            passed &= values[:, 0] <= distance_threshold
        return [int(i) if ok else -1 for i, ok in zip(indices[:, 0], passed, strict=True)]

    forward, backward = nearest(distances), nearest(distances.T)
    if not do_mutual_check:
        return forward
    return [j if j >= 0 and backward[j] == i else -1 for i, j in enumerate(forward)]


# as hloc's configurations have them
OPTIONS = {
    "plain": {},
    "distance": {"distance_threshold": 0.7},
    "one way": {"do_mutual_check": False},
    "distance, one way": {"distance_threshold": 0.7, "do_mutual_check": False},
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("ratio_threshold", [None, 0.8, 0.95])
@pytest.mark.parametrize("sizes", [(200, 300), (300, 2), (2, 2)])
def test_matches_by_definition(sizes, ratio_threshold, options):
    base = unit(max(sizes), 16, 0)
    descriptors0 = base[: sizes[0]]
    descriptors1 = torch.nn.functional.normalize(base + 0.5 * unit(len(base), 16, 1), dim=1)
    descriptors1 = descriptors1.flip(0)[: sizes[1]]
    matches, scores = match(descriptors0, descriptors1, ratio_threshold, **options)
    expected = by_definition(descriptors0, descriptors1, ratio_threshold, **options)
    assert matches.tolist() == expected
    assert (scores[matches < 0] == 0).all()
    cosines = (descriptors0[matches >= 0] * descriptors1[matches[matches >= 0]]).sum(1)
    torch.testing.assert_close(scores[matches >= 0], (cosines + 1) / 2)


@pytest.mark.parametrize("ratio_threshold", [None, 0.8, 0.95])
@pytest.mark.parametrize(("part", "tile"), [(1, 1), (7, 70), (200, 1000)])
def test_tiles_of_any_size_give_the_same(part, tile, ratio_threshold, monkeypatch):
    monkeypatch.setattr(nearest_neighbor, "PART_BYTES", 4 * 16 * part)
    monkeypatch.setattr(nearest_neighbor, "TILE_SIMILARITIES", tile)
    descriptors0, descriptors1 = unit(60, 16, 0), unit(50, 16, 1)
    descriptors1[:30] = torch.nn.functional.normalize(descriptors0[:30] + 0.1 * descriptors1[:30])
    matches, _ = match(descriptors0, descriptors1, ratio_threshold)
    assert matches.tolist() == by_definition(descriptors0, descriptors1, ratio_threshold)
    assert (matches >= 0).sum() >= 30


def features(*described):
    """As a matcher takes images with descriptors (N, D)."""
    return tuple({"descriptors": descriptors.T} for descriptors in described)


def integers(descriptors):
    return torch.from_numpy(to_integers(descriptors.numpy()))


@pytest.fixture(params=["compiled", "numpy"])
def arithmetic(request, monkeypatch):
    if request.param == "numpy":
        monkeypatch.setattr(best_two, "instructions", list)
    elif not best_two.instructions():
        pytest.skip("integer matching was not compiled: no C++ compiler?")


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("ratio_threshold", [None, 0.8, 0.95])
@pytest.mark.parametrize("sizes", [(200, 300), (300, 2), (2, 2), (5, 1), (1, 5), (0, 5), (5, 0)])
def test_integers_match_as_floats(sizes, ratio_threshold, options, arithmetic):
    base = unit(300, 16, 0)
    other = torch.nn.functional.normalize(base + 0.3 * unit(300, 16, 1), dim=1).flip(0)
    pair = base[: sizes[0]], other[: sizes[1]]
    matcher = NearestNeighbor({"ratio_threshold": ratio_threshold, **options})
    assert matcher.takes_codes
    rounded = tuple(integers(one) for one in pair)
    ((matches, scores),) = matcher.match([features(*rounded)])
    ((expected, expected_scores),) = matcher.match([features(*pair)])
    assert matches.tolist() == expected.tolist()
    torch.testing.assert_close(scores, expected_scores, atol=1e-3, rtol=0)
    rows1 = torch.arange(0, sizes[1], 2)
    found = matcher.match_rows(*features(*rounded), rows1)
    assert sorted(found.tolist()) == sorted(matcher.match_rows(*features(*pair), rows1).tolist())


def test_codes_pass_the_ratio_test(arithmetic):
    """Rounding shrinks the cosines of matches, so that a third of them failed the ratio test."""
    base = unit(1000, 32, 0)
    other = torch.nn.functional.normalize(base + 0.8 * unit(1000, 32, 1), dim=1)
    stored = store({"descriptors": other.numpy().T}, "uint2", fit(other, 2).numpy())
    matcher = NearestNeighbor({"ratio_threshold": 0.8})
    right = {}
    for unbiased in (False, True):
        coded = torch.from_numpy(to_integers(restore(*stored, unbiased=unbiased)))
        ((matches, scores),) = matcher.match([features(integers(base), coded)])
        right[unbiased] = int((matches == torch.arange(1000)).sum())
        assert scores.max() <= 1
    ((matches, _),) = matcher.match([features(base, other)])
    floats = int((matches == torch.arange(1000)).sum())
    assert right[False] < 0.75 * floats and right[True] > 0.8 * floats


def test_integers_match_the_same_in_either_order(arithmetic):
    pair = integers(unit(400, 8, 0)), integers(unit(300, 8, 1))  # random: near ties abound
    matcher = NearestNeighbor({"ratio_threshold": 0.95})
    ((forward, _),) = matcher.match([features(*pair)])
    ((backward, _),) = matcher.match([features(*pair[::-1])])
    found = {(i, j) for i, j in enumerate(forward.tolist()) if j >= 0}
    assert found and found == {(i, j) for j, i in enumerate(backward.tolist()) if i >= 0}


@pytest.mark.parametrize("sizes", [(0, 5), (5, 0), (0, 0)])
def test_no_descriptors_no_matches(sizes):
    matches, scores = match(unit(sizes[0], 8, 0), unit(sizes[1], 8, 1), 0.8)
    assert matches.tolist() == [-1] * sizes[0] and scores.tolist() == [0] * sizes[0]


def test_a_lone_descriptor_skips_the_ratio_test():
    matches, _ = match(unit(5, 8, 0), unit(1, 8, 1), 0.8)
    assert (matches >= 0).sum() == 1


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("ratio_threshold", [None, 0.8, 0.95])
def test_padded_pairs_match_as_single_ones(ratio_threshold, options):
    distance_threshold = options.get("distance_threshold")
    limits = {"distance_threshold": distance_threshold, "mutual": "do_mutual_check" not in options}
    sizes = [(200, 300), (300, 2), (2, 150), (5, 1), (1, 5), (1, 1), (300, 300)]
    base = unit(300, 16, 0)
    other = torch.nn.functional.normalize(base + 0.5 * unit(300, 16, 1), dim=1).flip(0)
    pairs = [(base[:n], other[:m]) for n, m in sizes]
    padded = mutual_nearest_padded(*zip(*pairs, strict=True), ratio_threshold, **limits)
    for pair, (matches, cosines) in zip(pairs, padded, strict=True):
        expected, expected_cosines = mutual_nearest(*pair, ratio_threshold, **limits)
        assert matches.tolist() == expected.tolist()
        torch.testing.assert_close(cosines, expected_cosines)


def test_padded_empty_descriptors_have_no_match():
    ((first, _), (second, _)) = mutual_nearest_padded(
        [unit(5, 8, 0), unit(3, 8, 1)], [unit(0, 8, 2), unit(4, 8, 3)], 0.8
    )
    assert first.tolist() == [-1] * 5 and len(second) == 3


def test_batches_fit_into_memory():
    sizes = [(10, 20), (0, 5), (10, 21), (100, 100), (12, 20), (5, 0), (11, 20)]
    batches = list(_batches(sizes, 4 * 3 * 12 * 21))
    assert sorted(i for batch in batches for i in batch) == list(range(len(sizes)))
    assert [3] in batches and [1] in batches and [5] in batches  # too large, and empty
    assert max(map(len, batches)) > 1
    for batch in batches:
        height, width = (max(column) for column in zip(*(sizes[i] for i in batch), strict=True))
        assert len(batch) == 1 or 4 * len(batch) * height * width <= 4 * 3 * 12 * 21
