"""Areas under curves, on cases computed by hand."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hloc_reduce.evaluation.ranking import average_precision, nearest_neighbor_ap, roc_area


def curve_area(right, number):
    """The area under a precision-recall curve, point by point, of items in their order."""
    tp, points = 0, [(0.0, 1.0)]
    for place, is_right in enumerate(right, 1):
        tp += is_right
        points.append((tp / number, tp / place))
    x, y = np.array(points).T
    return np.trapezoid(y, x)


@given(st.lists(st.booleans(), min_size=1, max_size=30), st.integers(0, 5))
def test_average_precision_is_the_area_under_the_curve(right, missed):
    number = sum(right) + missed
    ranks = np.flatnonzero(right) + 1
    if number:
        assert average_precision(ranks, number) == pytest.approx(curve_area(right, number))


def test_average_precision_by_hand():
    assert average_precision(np.array([1, 2, 3]), 3) == 1
    assert average_precision(np.array([2]), 1) == 0.25  # from precision 0 to 1/2
    # (1 + 1) / 2 for the first; the second comes fourth, from 1/3 to 2/4; the third is missed
    assert average_precision(np.array([1, 4]), 3) == pytest.approx((1 + 5 / 12) / 3)
    assert average_precision(np.array([], int), 4) == 0


def test_roc_area_by_hand():
    assert roc_area(np.array([1.0, 2]), np.array([3.0, 4])) == 1
    assert roc_area(np.array([1.0, 1]), np.array([1.0, 1])) == 0  # ties count against
    assert roc_area(np.array([1.0, 3]), np.array([2.0, 4])) == 0.75


@pytest.mark.parametrize(
    ("angles", "shifted", "expected"),
    [
        # nearest: 0 -> 0 (.01), 1 -> 3 (.1), 2 -> 1 (.05), 3 -> 2 (.8)
        ([0.0, 1, 2, 3], [0.01, 1.95, 2.2, 1.1], 1 / 4),
        ([0.0, 1, 2, 3], [0.0, 1, 2, 3], 1),
        # nearest: 0 -> 0 (.01), 1 -> 3 (.1), 2 -> 2 (.2), 3 -> 2 (1.8): hit, miss, hit, miss
        ([0.0, 1, 2, 4], [0.01, 1.3, 2.2, 1.1], (1 + 2 / 3) / 4),
        # a fifth descriptor in the way of the first: miss, miss, hit, miss
        ([0.0, 1, 2, 4], [0.01, 1.3, 2.2, 1.1, 0], 1 / 3 / 4),
    ],
)
def test_nearest_neighbor_ap_by_hand(angles, shifted, expected):
    angles, shifted = torch.tensor(angles), torch.tensor(shifted)
    unit = [torch.stack([a.cos(), a.sin()], 1) for a in (angles, shifted)]
    assert nearest_neighbor_ap(*unit) == pytest.approx(expected)
