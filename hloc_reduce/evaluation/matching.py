"""Average precision of nearest-neighbour matching."""

import numpy as np
import torch


@torch.no_grad()
def average_precision(
    descriptors0: torch.Tensor, descriptors1: torch.Tensor, block: int = 4096
) -> float:
    """Rank all first descriptors by the distance to their nearest second one.

    Args:
        descriptors0: (N, D) of unit norm.
        descriptors1: (M, D) of unit norm, M >= N, row i matching row i of descriptors0 only;
            the rows after the first N match none.
        block: rows compared at once.

    Returns:
        The average precision in [0, 1] of "the nearest is the match", with N positives: a match
        that is not found counts as missed, as in HPatches' matching task.
    """
    similarity, nearest = [], []
    for rows in descriptors0.float().split(block):
        best, index = (rows @ descriptors1.float().T).max(dim=1)
        similarity.append(best)
        nearest.append(index)
    similarity, nearest = torch.cat(similarity).numpy(), torch.cat(nearest).numpy()
    order = np.argsort(-similarity, kind="stable")
    correct = (nearest == np.arange(len(nearest)))[order]
    precision = np.cumsum(correct) / np.arange(1, len(correct) + 1)
    return float(precision[correct].sum() / len(correct))
