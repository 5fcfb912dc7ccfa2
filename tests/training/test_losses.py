import math

import pytest
import torch

from hloc_reduce.training.losses import contrastive_loss, distance_loss, triplet_loss


def test_triplet_loss_by_hand():
    anchors = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    positives = torch.tensor([[0.0, 1.0], [0.0, -1.0]])
    # d(a0, p0) = sqrt 2, d(a1, p1) = 2; d(a0, p1) = sqrt 2; a1 = p0 counts as the same patch
    expected = (1 + 2**0.5 - 2**0.5 + 1 + 2 - 2**0.5) / 2
    assert triplet_loss(anchors, positives, 1.0).item() == pytest.approx(expected, abs=1e-3)


def test_contrastive_loss_by_hand():
    anchors = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    positives = torch.tensor([[1.0, 0.0], [0.6, 0.8]])
    # cosines 1, 0.6 / 0, 0.8 in rows, which are divided by 0.5
    rows = [math.log(1 + math.exp(-0.8)), math.log(1 + math.exp(-1.6))]
    columns = [math.log(1 + math.exp(-2.0)), math.log(1 + math.exp(-0.4))]
    expected = (sum(rows) + sum(columns)) / 4
    assert contrastive_loss(anchors, positives, 0.5).item() == pytest.approx(expected, abs=1e-6)


def test_contrastive_loss_of_sets_that_are_not_compared():
    """Two sets, one with a row that does not count: the mean over the rows that do."""
    generator = torch.Generator().manual_seed(0)
    anchors, positives = torch.nn.functional.normalize(
        torch.randn(2, 2, 4, 8, generator=generator), dim=-1
    )
    compared = torch.ones(2, 4, 4, dtype=torch.bool)
    compared[1, 3], compared[1, :, 3] = False, False
    first = contrastive_loss(anchors[0], positives[0], 0.1)
    second = contrastive_loss(anchors[1, :3], positives[1, :3], 0.1)
    found = contrastive_loss(anchors, positives, 0.1, compared)
    assert found.item() == pytest.approx((4 * first + 3 * second).item() / 7, rel=1e-4)


def test_distance_loss_by_hand():
    descriptors = torch.eye(3)
    embedded = torch.tensor([[1.0, 0.0], [1.0, 0.0], [-1.0, 0.0]])
    # sqrt 2 becomes 0, 2 and 2, each of them twice
    expected = (2 * (2 + 2 * (2 - 2**0.5) ** 2)) ** 0.5 / 6
    assert distance_loss(descriptors, embedded).item() == pytest.approx(expected, abs=1e-3)
    assert distance_loss(descriptors, descriptors).item() == pytest.approx(0, abs=1e-6)
