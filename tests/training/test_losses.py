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


def test_distance_loss_by_hand():
    descriptors = torch.eye(3)
    embedded = torch.tensor([[1.0, 0.0], [1.0, 0.0], [-1.0, 0.0]])
    # sqrt 2 becomes 0, 2 and 2, each of them twice
    expected = (2 * (2 + 2 * (2 - 2**0.5) ** 2)) ** 0.5 / 6
    assert distance_loss(descriptors, embedded).item() == pytest.approx(expected, abs=1e-3)
    assert distance_loss(descriptors, descriptors).item() == pytest.approx(0, abs=1e-6)
