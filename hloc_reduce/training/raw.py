"""Descriptors as they are, as a projection of one linear layer: a file for their levels."""

import torch

from ..projections.network import MLP
from .tracks import Tracks


def train(maps: list[Tracks], *_: object) -> MLP:
    """Return the identity; arguments as in `sv`, only the first one is used."""
    size = maps[0].descriptors.shape[-1]
    mlp = MLP([size, size])
    mlp.load_state_dict({"linears.0.weight": torch.eye(size), "linears.0.bias": torch.zeros(size)})
    return mlp.eval()
