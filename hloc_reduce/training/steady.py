"""Axes along which points differ and light changes little, in closed form."""

import numpy as np
import torch
from scipy.linalg import eigh
from sklearn.preprocessing import normalize

from ..projections.network import MLP
from .tracks import Tracks


def train(maps: list[Tracks], dim: int, ridge: float) -> MLP:
    """Find the axes, the best one first, by Fisher's criterion.

    It is the variance of all descriptors along an axis, divided by how much they change there, as
    a mean square, from a photo to its photometric variants. All maps count the same.

    Args:
        maps: tracks of one or more maps.
        dim: number of output dimensions.
        ridge: above 0; is added to the changes, in units of the mean variance along an axis.

    Returns:
        A network of one linear layer. Its rows have unit norm; they need not be orthogonal.
    """
    size = maps[0].descriptors.shape[-1]
    mean = np.mean(
        [tracks.descriptors[:, 0, 0].mean(axis=0, dtype=float) for tracks in maps], axis=0
    )
    spread, change = np.zeros((size, size)), np.zeros((size, size))
    for tracks in maps:
        plain, *variants = tracks.descriptors[:, 0].swapaxes(0, 1).astype(np.float32)
        spread += _moments(plain - mean.astype(np.float32))
        for variant in variants:
            change += _moments(variant - plain) / len(variants)
    change += ridge * spread.trace() / size * np.eye(size)
    _, columns = eigh(spread, change, subset_by_index=(size - dim, size - 1))
    axes = normalize(np.fliplr(columns).T)
    mlp = MLP([size, dim])
    mlp.linears[0].weight.data = torch.from_numpy(axes).float()
    mlp.linears[0].bias.data = torch.from_numpy(-axes @ mean).float()
    return mlp.eval()


def _moments(rows: np.ndarray) -> np.ndarray:
    """Return the mean outer product (D, D) float64 of rows (N, D)."""
    return (rows.T @ rows).astype(float) / len(rows)
