"""Principal component analysis, the paper's baseline, as a projection of one linear layer."""

import numpy as np
import torch
from sklearn.decomposition import PCA

from ..projections.network import MLP
from ..utils.cli import InputError
from .tracks import Tracks


def train(maps: list[Tracks], dim: int, recipe: dict, seed: int, *_: object) -> MLP:
    """Fit the descriptors of the unchanged photos; arguments as in `sv`, most of them not used.

    Raises:
        InputError: when there are fewer observations than dimensions.
    """
    views = np.concatenate([tracks.descriptors[:, 0, 0] for tracks in maps]).astype(np.float32)
    check_number(len(views), dim)
    pca = PCA(dim, random_state=seed).fit(views)
    return layer(pca.components_, pca.mean_)


def layer(axes: np.ndarray, mean: np.ndarray) -> MLP:
    """Return a network of one linear layer: axes (dim, D) of descriptors less their mean (D,)."""
    mlp = MLP(axes.shape[::-1])
    mlp.linears[0].weight.data = torch.from_numpy(axes).float()
    mlp.linears[0].bias.data = torch.from_numpy(-axes @ mean).float()
    return mlp.eval()


def check_number(observations: int, dim: int) -> None:
    """Raise an InputError when there are fewer observations than dimensions."""
    if observations < dim:
        raise InputError(f"{observations} observations are too few for {dim} dimensions.")
