"""Patch verification on PhotoTour."""

import numpy as np


def fpr95(distances: np.ndarray, matches: np.ndarray) -> float:
    """Compute the false positive rate at 95 % recall.

    Args:
        distances: (P,) of the pairs.
        matches: (P,) bool, which of them show the same point.

    Returns:
        The share in [0, 1] of the pairs that do not match but are at most as far as the distance
        within which 95 % of the matching ones are.

    Raises:
        ValueError: when there are no matching pairs or no others.
    """
    if matches.all() or not matches.any():
        raise ValueError("Both matching and other pairs are needed.")
    positive = np.sort(distances[matches])
    threshold = positive[int(np.ceil(0.95 * len(positive))) - 1]
    return float((distances[~matches] <= threshold).mean())
