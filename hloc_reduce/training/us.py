"""Unsupervised reduction: an auto-encoder (Sec. III-A)."""

from pathlib import Path

import torch
from torch import nn

from ..projections.network import MLP
from .loop import device, fit
from .losses import distance_loss
from .sampling import DescriptorSampler
from .tracks import Tracks

# "paper" is Sec. III-D; an epoch goes once through all descriptors.
RECIPES: dict[str, dict] = {
    "paper": {
        "epochs": 5,
        "batch_size": 1024,
        "lr": 1e-3,
        "final_lr": 1.0,
        "weight_decay": 0.0,
        "augment": 0.0,
        "mirror": False,
        "balanced": False,
    },
    "best": {
        "steps": 3000,
        "batch_size": 1024,
        "lr": 3e-3,
        "final_lr": 0.0,
        "weight_decay": 0.0,
        "augment": 0.25,
        "mirror": True,
        "balanced": True,
        "distance_weight": 1000.0,
    },
}
OF_NETWORKS = {"hidden": [], "steps": 1000}  # "best" for the descriptors of networks
OF_BASES: dict[str, dict] = {}
DISTANCE_WEIGHTS = {"hardnet": 0.1}  # alpha, unless the recipe has one


def train(
    maps: list[Tracks], dim: int, recipe: dict, seed: int, checkpoint: Path, made_from: str = ""
) -> MLP:
    """Train an encoder whose mirrored decoder recovers the descriptors; arguments as in `sv`.

    The loss is Eq. 3: the mean of ||x - x'||, plus the distance loss if it has a weight. The target
    of an augmented view is the descriptor of the photo itself.
    """
    torch.manual_seed(seed)
    drawing = {key: recipe[key] for key in ("augment", "mirror", "balanced")}
    sampler = DescriptorSampler(maps, **drawing, seed=seed)
    size, place = recipe["batch_size"], device()
    steps = recipe.get("steps") or recipe["epochs"] * sampler.per_epoch(size)
    sizes = [maps[0].descriptors.shape[-1], *recipe["hidden"], dim]
    encoder, decoder = MLP(sizes), MLP(sizes[::-1])
    network = nn.ModuleList([encoder, decoder]).train().to(place)

    def loss(step: int) -> torch.Tensor:
        seen, plain = (views.to(place) for views in sampler.batch(step, size))
        embedded = encoder(seen)
        value = (plain - decoder(embedded)).norm(dim=1).mean()
        if recipe["distance_weight"]:
            value = value + recipe["distance_weight"] * distance_loss(seen, embedded)
        return value

    fit(network, loss, steps, recipe, checkpoint, made_from)
    return encoder.eval().cpu()
