"""Self-supervised reduction: k-means clusters as labels (Sec. III-B)."""

from pathlib import Path

import numpy as np
import torch
from torch import nn

from .. import logger
from ..cli import InputError
from ..projections import MLP
from .loop import device, fit
from .sampling import DescriptorSampler
from .tracks import Tracks

# "paper" is Sec. III-D: 100,000 clusters for the 450,092 patches of Liberty, that is 4.5 patches
# each, 200 epochs, clustered anew every 10.
RECIPES = {
    "paper": {
        "per_cluster": 4.5,
        "descriptors": None,
        "epochs": 200,
        "cluster_epochs": 10,
        "batch_size": 256,
        "classes": None,
        "lr": 1e-3,
        "final_lr": 1.0,
        "weight_decay": 0.0,
        "augment": 0.0,
    },
    "best": {
        "per_cluster": 4.5,
        "descriptors": 100_000,
        "steps": 6000,
        "cluster_steps": 1500,
        "batch_size": 512,
        "classes": 2048,
        "lr": 3e-3,
        "final_lr": 0.0,
        "weight_decay": 1e-5,
        "augment": 0.35,
    },
}
DISTANCE_WEIGHTS = {}
ITERATIONS = 10  # of k-means
MARGIN = 0.1  # radians, as the authors' code has it
SCALE = 10.0


class ArcClassifier(nn.Module):
    """Cosine similarities to a learned direction for each class, with ArcFace's angular margin."""

    def __init__(self, num_classes: int, dim: int):
        super().__init__()
        self.weight = nn.Parameter(torch.empty(num_classes, dim))
        self.log_scale = nn.Parameter(torch.empty(()))
        self.reset()

    def reset(self) -> list[nn.Parameter]:
        """Forget everything and return what has been set anew."""
        nn.init.xavier_uniform_(self.weight)
        nn.init.constant_(self.log_scale, np.log(SCALE))
        return [self.weight, self.log_scale]

    def forward(
        self, embedded: torch.Tensor, labels: torch.Tensor, classes: torch.Tensor
    ) -> torch.Tensor:
        """Return the cross-entropy of (N, D) of unit norm with labels (N,).

        Only the classes (C,), sorted, the labels among them, are told apart.
        """
        labels = torch.searchsorted(classes, labels)
        cosine = embedded @ nn.functional.normalize(self.weight[classes], dim=1).T
        target = cosine.gather(1, labels[:, None])
        angle = target.clamp(-1 + 1e-6, 1 - 1e-6).acos() + MARGIN
        logits = cosine.scatter(1, labels[:, None], torch.minimum(angle.cos(), target))
        return nn.functional.cross_entropy(logits * self.log_scale.exp(), labels)


def cluster(descriptors: np.ndarray, num_clusters: int, seed: int) -> np.ndarray:
    """Cluster descriptors (N, D) float32 by k-means and return the labels (N,) int64.

    Raises:
        InputError: when faiss is not installed.
    """
    try:
        import faiss
    except ImportError:
        raise InputError("The scheme ss needs faiss: pip install faiss-cpu.") from None
    kmeans = faiss.Kmeans(
        descriptors.shape[1],
        num_clusters,
        niter=ITERATIONS,
        seed=seed,
        min_points_per_centroid=1,
        max_points_per_centroid=len(descriptors),
        gpu=faiss.get_num_gpus() > 0,
    )
    kmeans.train(descriptors)
    return kmeans.index.search(descriptors, 1)[1][:, 0]


def train(
    maps: list[Tracks], dim: int, recipe: dict, seed: int, checkpoint: Path, made_from: str = ""
) -> MLP:
    """Train a projection to tell clusters of descriptors apart; arguments as in `sv`.

    The first clusters are those of the base descriptors, the later ones of the projected; each
    time the classification layer begins anew.
    """
    torch.manual_seed(seed)
    sampler = DescriptorSampler(maps, recipe["augment"], mirror=False, balanced=False, seed=seed)
    generator = np.random.default_rng(seed)
    number = min(sampler.num_observations, recipe["descriptors"] or sampler.num_observations)
    chosen = np.sort(generator.choice(sampler.num_observations, number, replace=False))
    _, descriptors = sampler.views(chosen, np.random.default_rng(seed))
    size, place = recipe["batch_size"], device()
    per_epoch = -(-number // size)
    steps = recipe.get("steps") or recipe["epochs"] * per_epoch
    every = recipe.get("cluster_steps") or recipe["cluster_epochs"] * per_epoch
    num_clusters = max(2, int(number / recipe["per_cluster"]))
    mlp = MLP([descriptors.shape[1], *recipe["hidden"], dim])
    network = nn.Module()
    network.mlp, network.classifier = mlp, ArcClassifier(num_clusters, dim)
    network.register_buffer("labels", torch.zeros(number, dtype=torch.int64))
    network.train().to(place)

    def cluster_anew(step: int) -> list[nn.Parameter]:
        if step % every:
            return []
        logger.info("Clustering %d descriptors.", number)
        rows = embed(mlp, descriptors, place) if step else descriptors
        network.labels.copy_(torch.from_numpy(cluster(rows.numpy(), num_clusters, seed + step)))
        torch.manual_seed(seed + step)
        return network.classifier.reset()

    def loss(step: int) -> torch.Tensor:
        epoch, batch = divmod(step, per_epoch)
        order = np.random.default_rng([seed, epoch]).permutation(number)
        drawn = order[batch * size : (batch + 1) * size]
        generator = np.random.default_rng([seed, step, 1])
        seen, _ = sampler.views(chosen[drawn], generator)
        labels = network.labels[torch.from_numpy(drawn)]
        classes = torch.arange(num_clusters, device=place)
        if recipe["classes"] and recipe["classes"] < num_clusters:
            others = generator.integers(num_clusters, size=recipe["classes"])
            classes = torch.cat([torch.from_numpy(others).to(place), labels]).unique()
        return network.classifier(mlp(seen.to(place)), labels, classes)

    fit(network, loss, steps, recipe, checkpoint, made_from, cluster_anew)
    return mlp.eval().cpu()


@torch.no_grad()
def embed(mlp: MLP, descriptors: torch.Tensor, place: torch.device) -> torch.Tensor:
    """Project descriptors (N, 128) with the running statistics."""
    mlp.eval()
    embedded = torch.cat([mlp(rows.to(place)).cpu() for rows in descriptors.split(16384)])
    mlp.train()
    return embedded
