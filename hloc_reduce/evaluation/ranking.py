"""Measures of rankings: average precision, also of matching, and area under the ROC curve."""

import numpy as np
import torch


def average_precision(ranks: np.ndarray, number: int, trapezoids: bool = True) -> np.ndarray:
    """Compute the area under the precision-recall curve.

    Args:
        ranks: (..., K) ascending ranks of correct items, from 1 on.
        number: of correct items, at least K; the others are never found.
        trapezoids: interpolate precision linearly between recalls, beginning at precision 1, as in
            HPatches; else average the precision at each correct item.

    Returns:
        (...,) in [0, 1].
    """
    found = np.arange(1, ranks.shape[-1] + 1)
    precision = found / ranks
    if not trapezoids:
        return precision.sum(axis=-1) / number
    # recall changes only at a correct item: precision before it and at it
    before = np.where(ranks == 1, 1.0, (found - 1) / np.maximum(ranks - 1, 1))
    return (before + precision).sum(axis=-1) / (2 * number)


@torch.no_grad()
def nearest_neighbor_ap(
    descriptors0: torch.Tensor, descriptors1: torch.Tensor, block: int = 4096
) -> float:
    """Rank all first descriptors by the distance to their nearest second one.

    Args:
        descriptors0: (N, D) of unit norm.
        descriptors1: (M, D) of unit norm, M >= N. Row i matches row i of descriptors0 only; the
            rows after the first N match none.
        block: rows compared at once.

    Returns:
        The average precision in [0, 1], without trapezoids, of "the nearest one is the match". All
        N matches count: one that is not found is missed.
    """
    rows, columns = descriptors0.float(), descriptors1.float().T
    best = [(part @ columns).max(dim=1) for part in rows.split(block)]
    similarity, nearest = (torch.cat(parts).numpy() for parts in zip(*best, strict=True))
    order = np.argsort(-similarity, kind="stable")
    ranks = np.flatnonzero(nearest[order] == order) + 1
    return float(average_precision(ranks, len(order), trapezoids=False))


def roc_area(right: np.ndarray, wrong: np.ndarray) -> float:
    """Compute the area under the ROC curve from the distances of right and of wrong pairs.

    Args:
        right: (P,) distances.
        wrong: (N,) distances. Where distances are equal, a wrong pair counts as nearer.

    Returns:
        The share in [0, 1] of all P * N couples whose right pair is nearer.
    """
    return float(np.searchsorted(np.sort(right), wrong).mean() / len(right))
