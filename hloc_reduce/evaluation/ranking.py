"""Measures of rankings: average precision and area under the ROC curve."""

import numpy as np


def average_precision(ranks: np.ndarray, number: int) -> np.ndarray:
    """Compute the area under the precision-recall curve by trapezoids over recall.

    The curve begins at recall 0 and precision 1 and has a point after each item of the ranking,
    as in HPatches.

    Args:
        ranks: (..., K) ascending places of right items in the ranking, from 1 on.
        number: how many right items there are, K at least; the others are never found.

    Returns:
        (...,) in [0, 1].
    """
    found = np.arange(1, ranks.shape[-1] + 1)
    # precision before an item and at it; recall changes only there
    before = np.where(ranks == 1, 1.0, (found - 1) / np.maximum(ranks - 1, 1))
    return (before + found / ranks).sum(axis=-1) / (2 * number)


def roc_area(right: np.ndarray, wrong: np.ndarray) -> float:
    """Compute the area under the ROC curve from the distances of right and of wrong pairs.

    Args:
        right: (P,) distances.
        wrong: (N,) distances. Of equal ones the wrong count as nearer.

    Returns:
        The share in [0, 1] of all P * N couples whose right pair is nearer.
    """
    return float(np.searchsorted(np.sort(right), wrong).mean() / len(right))
