"""Supervised reduction: pull descriptors of the same point together (Sec. III-C)."""

import copy
from pathlib import Path

import torch
from torch import nn

from ..projections.network import MLP, read
from . import pca, steady
from .loop import device, fit
from .losses import contrastive_loss, distance_loss, triplet_loss
from .sampling import PairSampler
from .tracks import Tracks

# "paper" is Sec. III-D; an epoch has as many pairs as there are observations. "best" adds what
# helped on places kept out of training (docs/training.md). "tune" begins with a shipped projection.
RECIPES: dict[str, dict] = {
    "paper": {
        "epochs": 10,
        "batch_size": 1024,
        "lr": 1e-3,
        "final_lr": 0.0,
        "weight_decay": 0.0,
        "margin": 1.0,
        "augment": 0.0,
        "balanced": False,
        "maps_per_batch": None,
    },
    "best": {
        "steps": 6000,
        "batch_size": 1024,
        "lr": 1e-2,
        "final_lr": 0.0,
        "weight_decay": 1e-5,
        "margin": 1.0,
        "augment": 0.25,
        "balanced": True,
        "maps_per_batch": 2,
    },
}
RECIPES["tune"] = {**RECIPES["best"], "steps": 1000, "lr": 1e-3}
# "best" and "tune" for the descriptors of networks: one layer
OF_NETWORKS = {
    "hidden": [],
    "steps": 1000,
    "batch_size": 2048,
    "lr": 1e-3,
    "maps_per_batch": 1,
    "temperature": 0.04,
}
DISTANCE_WEIGHTS = {"hardnet": 3.0}  # beta
# what "best" also has for some bases (docs/training.md)
OF_BASES: dict[str, dict] = {
    "xfeat": {"pca_share": 0.6},
    "aliked": {"ridge": 0.2, "steady_share": 0.6, "steps": 200},
}


def train(
    maps: list[Tracks], dim: int, recipe: dict, seed: int, checkpoint: Path, made_from: str = ""
) -> MLP:
    """Train a projection on the tracks of maps, the same for the same seed on the CPU.

    Args:
        maps: tracks of one or more maps.
        dim: number of output dimensions.
        recipe: an entry of `RECIPES` with `hidden`, the sizes of the hidden layers, and
            `distance_weight`, the weight of the distance loss. Without hidden layers, the only
            layer begins with the principal axes or, with a `ridge`, with those of `steady`.
            Optional: `prefixes`, the lengths of leading parts of a descriptor that are trained to
            match, too; `begin_with`, name or path of a projection to begin with; `temperature`, of
            the contrastive loss, which replaces the triplet loss; `pca_share` or `steady_share`,
            between 0 and 1, the weight of those axes in the layer that is returned, the weighted
            mean of them and the trained layer.
        seed: of the initial weights and the batches.
        checkpoint: file to resume from; the caller deletes it.
        made_from: provenance of the training; a stale checkpoint is ignored.

    Returns:
        The trained network.
    """
    torch.manual_seed(seed)
    drawing = {key: recipe[key] for key in ("augment", "balanced", "maps_per_batch")}
    sampler = PairSampler(maps, **drawing, seed=seed)
    size, place = recipe["batch_size"], device()
    steps = recipe.get("steps") or recipe["epochs"] * -(-sampler.num_observations // size)
    if "begin_with" in recipe:
        mlp, _ = read(recipe["begin_with"])
    elif not recipe["hidden"]:
        mlp = _axes(maps, dim, recipe, seed)
    else:
        mlp = MLP([maps[0].descriptors.shape[-1], *recipe["hidden"], dim])
    initial = copy.deepcopy(mlp)
    mlp.train().to(place)

    def loss(step: int) -> torch.Tensor:
        descriptors = torch.cat(sampler.batch(step, size)).to(place)
        embedded = mlp(descriptors)
        value = embedded.new_zeros(())
        for prefix in recipe.get("prefixes", [dim]):
            anchors, positives = nn.functional.normalize(embedded[:, :prefix], dim=1).chunk(2)
            if "temperature" in recipe:
                value = value + contrastive_loss(anchors, positives, recipe["temperature"])
            else:
                value = value + triplet_loss(anchors, positives, recipe["margin"])
        if recipe["distance_weight"]:
            value = value + recipe["distance_weight"] * distance_loss(descriptors, embedded)
        return value

    fit(mlp, loss, steps, recipe, checkpoint, made_from)
    mlp.eval().cpu()
    share = recipe.get("pca_share") or recipe.get("steady_share")
    return weighted_mean(mlp, initial, share) if share else mlp


def _axes(maps: list[Tracks], dim: int, recipe: dict, seed: int) -> MLP:
    """Return the axes that a single layer begins with."""
    if "ridge" in recipe:
        return steady.train(maps, dim, recipe["ridge"])
    return pca.train(maps, dim, recipe, seed)


def weighted_mean(trained: MLP, axes: MLP, share: float) -> MLP:
    """Return the weighted mean of two layers, whose matrices are scaled to the same norm.

    Args:
        trained: a network of one layer.
        axes: another one of the same sizes.
        share: the weight of `axes`.
    """
    mean = copy.deepcopy(axes)
    norm, norm_of_axes = (next(mlp.parameters()).norm() for mlp in (trained, axes))
    for into, one, other in zip(
        mean.parameters(), trained.parameters(), axes.parameters(), strict=True
    ):
        into.data = ((1 - share) * one / norm + share * other / norm_of_axes).detach()
    return mean.eval()
