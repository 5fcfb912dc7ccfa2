"""Supervised reduction: triplet margin loss with the hardest negative in the batch (Sec. III-C)."""

from pathlib import Path

import torch
from tqdm import trange

from .. import logger
from ..io import replacing
from ..projections import MLP
from .sampling import PairSampler
from .tracks import Tracks

# "paper" is Sec. III-D; an epoch goes once through as many pairs as there are observations.
# "best" adds what helped on places kept out of training (docs/training.md).
RECIPES = {
    "paper": {
        "hidden": [512, 512],
        "epochs": 10,
        "batch_size": 1024,
        "lr": 1e-3,
        "margin": 1.0,
        "weight_decay": 0.0,
        "augment": 0.0,
        "balanced": False,
        "maps_per_batch": None,
    },
    "best": {
        "hidden": [512, 512],
        "steps": 6000,
        "batch_size": 1024,
        "lr": 1e-2,
        "margin": 1.0,
        "weight_decay": 1e-5,
        "augment": 0.25,
        "balanced": True,
        "maps_per_batch": 2,
    },
}
CHECKPOINT_STEPS = 500
DUPLICATE_DISTANCE = 0.008  # HardNet takes what is nearer than this for the same patch


def triplet_loss(anchors: torch.Tensor, positives: torch.Tensor, margin: float) -> torch.Tensor:
    """Compute the triplet margin loss of Eq. 7 with HardNet's hardest-in-batch negatives.

    Args:
        anchors: (N, D) of unit norm.
        positives: (N, D) of unit norm, row i matching anchor i only.
        margin: m.

    Returns:
        The mean over i of max(0, m + d(a_i, p_i) - d(a_i, n_i)), a scalar, where d(a_i, n_i) is
        the least distance of anchor i or positive i to a row of the other side that is not i.
    """
    distances = (2 - 2 * anchors @ positives.T).clamp(min=1e-8).sqrt()
    positive = distances.diagonal()
    masked = torch.eye(len(anchors), dtype=torch.bool) | (distances < DUPLICATE_DISTANCE)
    others = distances.masked_fill(masked, torch.inf)
    negative = torch.minimum(others.amin(dim=0), others.amin(dim=1))
    return (margin + positive - negative).clamp(min=0).mean()


def train(
    maps: list[Tracks], dim: int, recipe: dict, seed: int, checkpoint: Path, made_from: str = ""
) -> MLP:
    """Train a projection on the tracks of maps, the same for the same seed.

    Args:
        maps: tracks of one or more maps.
        dim: number of output dimensions.
        recipe: an entry of `RECIPES`.
        seed: of the initial weights and the batches.
        checkpoint: file from which a killed training goes on; the caller deletes it.
        made_from: says what the training is made from; a checkpoint of another is not used.

    Returns:
        The trained network.
    """
    torch.manual_seed(seed)
    drawing = {key: recipe[key] for key in ("augment", "balanced", "maps_per_batch")}
    sampler = PairSampler(maps, **drawing, seed=seed)
    size = recipe["batch_size"]
    steps = recipe.get("steps") or recipe["epochs"] * -(-sampler.num_observations // size)
    mlp = MLP([maps[0].descriptors.shape[-1], *recipe["hidden"], dim]).train()
    optimizer = torch.optim.Adam(
        mlp.parameters(), lr=recipe["lr"], weight_decay=recipe["weight_decay"]
    )
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, steps)
    parts = {"mlp": mlp, "optimizer": optimizer, "schedule": schedule}
    step = 0
    if checkpoint.exists():
        state = torch.load(checkpoint, weights_only=True)
        if state["made_from"] == made_from:
            step = state["step"]
            for key, part in parts.items():
                part.load_state_dict(state[key])
            logger.info("Going on from step %d of %s.", step, checkpoint)
    mean_loss = None
    progress = trange(step, steps, initial=step, total=steps, desc=f"Training {dim}-D", unit="step")
    for step in progress:
        anchors, positives = sampler.batch(step, size)
        embedded = mlp(torch.cat([anchors, positives]))
        loss = triplet_loss(*embedded.chunk(2), recipe["margin"])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        mean_loss = loss.item() if mean_loss is None else 0.99 * mean_loss + 0.01 * loss.item()
        progress.set_postfix(loss=f"{mean_loss:.4f}", refresh=False)
        if (step + 1) % CHECKPOINT_STEPS == 0:
            with replacing(checkpoint) as temporary:
                state = {key: part.state_dict() for key, part in parts.items()}
                torch.save({"step": step + 1, "made_from": made_from, **state}, temporary)
    return mlp.eval()
