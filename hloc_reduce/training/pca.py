"""Principal component analysis, the paper's baseline, as a projection of one linear layer."""

import numpy as np
import torch
from sklearn.decomposition import PCA

from ..projections.network import MLP
from ..utils.cli import InputError
from .tracks import Tracks


def train(maps: list[Tracks], dim: int, recipe: dict, seed: int, **_) -> MLP:
    """Fit the observations as they were seen.

    Args:
        maps: tracks of one or more maps.
        dim: number of output dimensions.
        recipe: has no entries.
        seed: of scikit-learn's solver.

    Raises:
        InputError: when there are fewer observations than dimensions.

    Returns:
        One linear layer: the projection of the centred descriptors.
    """
    descriptors = np.concatenate([tracks.descriptors[:, 0, 0] for tracks in maps]).astype(
        np.float32
    )
    if len(descriptors) < dim:
        raise InputError(f"{len(descriptors)} observations are too few for {dim} dimensions.")
    pca = PCA(dim, random_state=seed).fit(descriptors)
    mlp = MLP([descriptors.shape[1], dim])
    mlp.linears[0].weight.data = torch.from_numpy(pca.components_).float()
    mlp.linears[0].bias.data = torch.from_numpy(-pca.components_ @ pca.mean_).float()
    return mlp.eval()
