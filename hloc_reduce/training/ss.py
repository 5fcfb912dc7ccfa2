"""Self-supervised reduction: k-means clusters as labels (Sec. III-B)."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import nn

from .. import logger
from ..projections.network import MLP
from ..runtime.group_writer import resume_or_replace
from ..utils.cli import InputError
from ..utils.h5 import get_dataset, open_h5
from . import sv
from .loop import device, fit
from .sampling import DescriptorSampler
from .tracks import Tracks

# "paper" is Sec. III-D: 100,000 clusters for the 450,092 patches of Liberty, 200 epochs, clustered
# again every 10. Its classification layer has the margin (radians), the initial scale and the
# iterations of k-means of the authors' code. "best" clusters each map once, within cells of about
# `per_cell` descriptors, and then learns as the supervised scheme.
RECIPES: dict[str, dict] = {
    "paper": {
        "loss": "classification",
        "per_cluster": 450_092 / 100_000,
        "iterations": 20,
        "margin": 0.1,
        "scale": 1.0,
        "epochs": 200,
        "cluster_epochs": 10,
        "batch_size": 256,
        "lr": 1e-3,
        "final_lr": 1.0,
        "weight_decay": 0.0,
        "augment": 0.0,
    },
    "best": {
        **sv.RECIPES["best"],
        "loss": "triplet",
        "per_cluster": 4.5,
        "per_cell": 64,
        "iterations": 10,
        "steps": 3000,
    },
}
OF_NETWORKS = sv.OF_NETWORKS
OF_BASES: dict[str, dict] = {}
DISTANCE_WEIGHTS: dict[str, float] = {}


class ArcClassifier(nn.Module):
    """Cosine similarities to a learned direction for each class, with ArcFace's angular margin.

    Args:
        num_classes: the number of classes.
        dim: of the descriptors.
        margin: radians.
        scale: initial scale of the logits, which is learned.
    """

    def __init__(self, num_classes: int, dim: int, margin: float, scale: float):
        super().__init__()
        self.margin, self.first_scale = margin, scale
        self.weight = nn.Parameter(torch.empty(num_classes, dim))
        self.scale = nn.Parameter(torch.empty(()))
        self.reset()

    def reset(self) -> list[nn.Parameter]:
        """Initialize the parameters again and return them."""
        nn.init.xavier_uniform_(self.weight)
        nn.init.constant_(self.scale, self.first_scale)
        return [self.weight, self.scale]

    def forward(self, embedded: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        """Return the cross-entropy of (N, D) of unit norm with labels (N,)."""
        cosine = embedded @ nn.functional.normalize(self.weight, dim=1).T
        target = cosine.gather(1, labels[:, None])
        angle = target.clamp(-1 + 1e-6, 1 - 1e-6).acos() + self.margin
        logits = cosine.scatter(1, labels[:, None], torch.minimum(angle.cos(), target))
        return nn.functional.cross_entropy(logits * self.scale, labels)


def check() -> None:
    """Raise an InputError if faiss is not installed."""
    if not importlib.util.find_spec("faiss"):
        raise InputError("The scheme ss needs faiss: pip install faiss-cpu.")


def cluster(descriptors: np.ndarray, num_clusters: int, iterations: int, seed: int) -> np.ndarray:
    """Cluster descriptors (N, D) float32 by k-means and return the labels (N,) int64."""
    import faiss

    kmeans = faiss.Kmeans(
        descriptors.shape[1],
        num_clusters,
        niter=iterations,
        seed=seed,
        min_points_per_centroid=1,
        max_points_per_centroid=len(descriptors),
        gpu=faiss.get_num_gpus() > 0,
    )
    kmeans.train(descriptors)
    return kmeans.index.search(descriptors, 1)[1][:, 0]


def cluster_in_cells(
    descriptors: np.ndarray, per_cluster: float, per_cell: int, iterations: int, seed: int
) -> np.ndarray:
    """Cluster within cells found by k-means: nearly the same clusters in a fraction of the time.

    Args:
        descriptors: (N, D) float32.
        per_cluster: the mean number of descriptors of a cluster.
        per_cell: the mean number of descriptors of a cell.
        iterations: of k-means.
        seed: of the initial centres.

    Returns:
        Labels (N,) int64, from 0 on.
    """
    cell = cluster(descriptors, max(1, len(descriptors) // per_cell), iterations, seed)
    order = np.argsort(cell, kind="stable")
    labels, number = np.empty(len(descriptors), np.int64), 0
    for rows in np.split(order, np.flatnonzero(np.diff(cell[order])) + 1):
        inside = max(1, round(len(rows) / per_cluster))
        labels[rows] = number + cluster(descriptors[rows], inside, iterations, seed)
        number += inside
    return labels


def train(
    maps: list[Tracks], dim: int, recipe: dict, seed: int, checkpoint: Path, made_from: str = ""
) -> MLP:
    """Train a projection to tell clusters of descriptors apart; arguments as in `sv`."""
    trainer = {"classification": _classify, "triplet": _match}[recipe["loss"]]
    return trainer(maps, dim, recipe, seed, checkpoint, made_from)


def clusters_of(checkpoint: Path) -> Path:
    """Return the h5 file of the clusters beside a checkpoint; the caller deletes both."""
    return checkpoint.with_name(f"{checkpoint.name}.clusters.h5")


def _match(
    maps: list[Tracks], dim: int, recipe: dict, seed: int, checkpoint: Path, made_from: str
) -> MLP:
    """Learn as the supervised scheme does, with clusters of base descriptors as points."""
    kept = clusters_of(checkpoint)
    with resume_or_replace(kept, {"made_from": made_from, "seed": seed}) as writer:
        for number, tracks in enumerate(maps):
            if str(number) not in writer:
                logger.info("Clustering %d descriptors.", len(tracks.track))
                descriptors = tracks.descriptors[:, 0, 0].astype(np.float32)
                how = {key: recipe[key] for key in ("per_cluster", "per_cell", "iterations")}
                labels = cluster_in_cells(descriptors, **how, seed=seed)
                writer.add(str(number), {"labels": labels})
    with open_h5(kept) as file:
        clustered = [
            _by_cluster(tracks, get_dataset(file, str(number), "labels")[()])
            for number, tracks in enumerate(maps)
        ]
    return sv.train(clustered, dim, recipe, seed, checkpoint, made_from)


def _by_cluster(tracks: Tracks, labels: np.ndarray) -> Tracks:
    """Make one track of each cluster, given the labels (M,) of the observations."""
    order = np.argsort(labels, kind="stable")
    views = np.arange(len(labels))  # each counts as an image of its own
    return replace(tracks.only(order), track=labels[order], image=views)


def _classify(
    maps: list[Tracks], dim: int, recipe: dict, seed: int, checkpoint: Path, made_from: str
) -> MLP:
    """Learn a classification layer behind the projection.

    It clusters the base descriptors first, later the projected ones, and resets the classification
    layer each time.
    """
    torch.manual_seed(seed)
    sampler = DescriptorSampler(maps, recipe["augment"], mirror=False, balanced=False, seed=seed)
    number = sampler.num_observations
    _, descriptors = sampler.views(np.arange(number), np.random.default_rng(seed))
    size, place = recipe["batch_size"], device()
    per_epoch = sampler.per_epoch(size)
    num_clusters = max(1, int(number / recipe["per_cluster"]))
    mlp = MLP([descriptors.shape[1], *recipe["hidden"], dim])
    classifier = ArcClassifier(num_clusters, dim, recipe["margin"], recipe["scale"])
    labels = torch.zeros(number, dtype=torch.int64, device=place)
    network = nn.ModuleDict({"mlp": mlp, "classifier": classifier}).train().to(place)
    network.register_buffer("labels", labels)  # kept in the checkpoint

    def recluster(step: int) -> list[nn.Parameter]:
        if step % (recipe["cluster_epochs"] * per_epoch):
            return []
        logger.info("Clustering %d descriptors.", number)
        rows = _embed(mlp, descriptors, place) if step else descriptors
        found = cluster(rows.numpy(), num_clusters, recipe["iterations"], seed + step)
        labels.copy_(torch.from_numpy(found))
        torch.manual_seed(seed + step)
        return classifier.reset()

    def loss(step: int) -> torch.Tensor:
        drawn = sampler.indices(step, size)
        seen, _ = sampler.views(drawn, np.random.default_rng([seed, step, 1]))
        return classifier(mlp(seen.to(place)), labels[torch.from_numpy(drawn).to(place)])

    steps = recipe.get("steps") or recipe["epochs"] * per_epoch
    fit(network, loss, steps, recipe, checkpoint, made_from, recluster)
    return mlp.eval().cpu()


@torch.no_grad()
def _embed(mlp: MLP, descriptors: torch.Tensor, place: torch.device) -> torch.Tensor:
    """Project descriptors (N, 128) as a frozen projection does."""
    mlp.eval()
    embedded = torch.cat([mlp(rows.to(place)).cpu() for rows in descriptors.split(16384)])
    mlp.train()
    return embedded
