"""Axes along which points differ and light changes little, in closed form."""

import numpy as np
from scipy.linalg import eigh
from sklearn.preprocessing import normalize

from ..projections.network import MLP
from . import pca
from .tracks import Tracks


def train(maps: list[Tracks], dim: int, ridge: float) -> MLP:
    """Return the axes with the largest ratios of two variances (Fisher's criterion), in order.

    They are the variance of all descriptors, and the mean square of how much these change from a
    photo to its photometric variants; a keypoint that is not found again changes by 0. All maps
    have equal weight.

    Args:
        maps: tracks of one or more maps.
        dim: number of output dimensions.
        ridge: above 0; is added to the second variance, in units of the mean of the first.

    Returns:
        A network of one linear layer. Its rows have unit norm; they need not be orthogonal.

    Raises:
        InputError: when there are fewer observations than dimensions.
    """
    pca.check_number(sum(len(tracks.track) for tracks in maps), dim)
    size = maps[0].descriptors.shape[-1]
    mean = np.mean([_views(tracks, 0).mean(axis=0, dtype=float) for tracks in maps], axis=0)
    spread, change = np.zeros((size, size)), np.zeros((size, size))
    for tracks in maps:
        plain, variants = _views(tracks, 0), range(1, tracks.descriptors.shape[2])
        spread += _moments(plain - mean.astype(np.float32))
        for variant in variants:
            change += _moments(_views(tracks, variant) - plain) / len(variants)
    change += ridge * spread.trace() / size * np.eye(size)
    _, columns = eigh(spread, change, subset_by_index=(size - dim, size - 1))
    axes = normalize(np.fliplr(columns).T)
    largest = np.take_along_axis(axes, np.abs(axes).argmax(axis=1, keepdims=True), axis=1)
    return pca.layer(axes * np.sign(largest), mean)  # eigh leaves the signs open


def _views(tracks: Tracks, variant: int) -> np.ndarray:
    """Return the descriptors (M, D) float32 in a variant, not mirrored."""
    return tracks.descriptors[:, 0, variant].astype(np.float32)


def _moments(rows: np.ndarray) -> np.ndarray:
    """Return the mean outer product (D, D) float64 of rows (N, D)."""
    return (rows.T @ rows).astype(float) / len(rows)
