"""Train a network that finds and describes keypoints, to be stored as codes of a few bytes.

The student has the architecture of EdgePoint2, with weights of its own. It learns the descriptors
and scores that a teacher computes from clean photos, while it sees them dark, noisy and blurred;
and to match its own keypoints between two views, with the descriptors of one view rounded to 2 bits
a number. An interrupted training resumes.
"""

import hashlib
import json
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import nn
from torch.nn.functional import cosine_similarity, grid_sample, normalize, smooth_l1_loss

from .. import logger
from ..networks import EDGEPOINT2, MINI, fetch_weights
from ..networks.edgepoint2 import EdgePoint2
from ..networks.keypoints import strongest
from ..networks.loading import load_weights, read_into
from ..runtime.versions import versions
from ..utils import cli
from ..utils.cli import InputError
from ..utils.files import file_sha256, replacing
from ..utils.paths import strings_as_paths
from . import views
from .loop import device, fit
from .losses import contrastive_loss

ARCHITECTURE = "M"
RECIPE = {"lr": 0.002, "weight_decay": 0.0, "final_lr": 0.0}
BATCH = 4  # pairs of views
HIGHEST = 14.0  # logit at which the scores of the teacher are clamped
SCORES, MATCHES = 0.5, 0.2  # weights of the losses
# Scores near keypoints are few, and count more; errors above this many logits grow linearly.
HIGH, WEIGHT, LINEAR = -6.0, 9.0, 4.0
KEYPOINTS, RADIUS, MIN_SCORE, BORDER = 256, 2, -5.0, 8  # of a view
FEWEST = 32  # matched keypoints of a pair
TEMPERATURE = 0.06
# Lloyd-Max levels of 2 bits of a normal distribution, and the threshold between them
INNER, OUTER, THRESHOLD = 0.4528, 1.5104, 0.9816


def rounded(descriptors: torch.Tensor) -> torch.Tensor:
    """Round descriptors (N, D) of unit norm to 2 bits a number; the gradient passes straight."""
    values = descriptors.detach()
    mean, deviation = values.mean(dim=0), values.std(dim=0) + 1e-6
    standard = (values - mean) / deviation
    levels = torch.where(standard.abs() < THRESHOLD, INNER, OUTER) * standard.sign()
    return descriptors + (normalize(mean + deviation * levels) - values)


def sample(dense: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Return the descriptors (N, D) at pixels (N, 2) of a view, from a map (D, h, w)."""
    grid = (points + 0.5) / views.SIZE * 2 - 1
    return normalize(grid_sample(dense[None], grid[None, None], align_corners=False)[0, :, 0].T)


def matching_loss(
    dense: torch.Tensor, scores: torch.Tensor, matrices: torch.Tensor
) -> torch.Tensor:
    """Compute the contrastive loss of the keypoints of first views at their places in the second.

    Args:
        dense: (2 B, D, h, w), the descriptors of first and second views in turn.
        scores: (2 B, 1, H, W), logits.
        matrices: (B, 3, 3) float32, from pixels of the first view to pixels of the second.

    Returns:
        A scalar, the mean over pairs with enough keypoints in common; 0 if there are none.
    """
    losses = []
    for i, matrix in enumerate(matrices):
        limits = RADIUS, MIN_SCORE, BORDER, KEYPOINTS
        points, _ = strongest(scores[2 * i, 0].detach(), *limits)
        moved = points @ matrix[:, :2].T + matrix[:, 2]
        moved = moved[:, :2] / moved[:, 2:]
        inside = ((moved >= BORDER) & (moved < views.SIZE - BORDER)).all(dim=1)
        if inside.sum() < FEWEST:
            continue
        here, there = sample(dense[2 * i], points[inside]), sample(dense[2 * i + 1], moved[inside])
        losses.append(contrastive_loss(here, rounded(there), TEMPERATURE))
    return torch.stack(losses).mean() if losses else dense.new_zeros(())


def score_loss(scores: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
    """Compute how far scores are from those of the teacher, (B, 1, H, W) logits; a scalar."""
    wanted = wanted.clamp(-HIGHEST, HIGHEST)
    errors = smooth_l1_loss(scores, wanted, reduction="none", beta=LINEAR)
    weights = 1 + WEIGHT * (wanted > HIGH)
    return (weights * errors).sum() / weights.sum()


def loss(
    student: nn.Module, teacher: nn.Module, sources: list[views.Source], seed: int, step: int
) -> torch.Tensor:
    """Compute the loss of a training step."""
    rng = np.random.default_rng([seed, step])
    pairs = list(views.draw(sources, BATCH, rng))
    device = next(student.parameters()).device
    clean, degraded = (
        torch.from_numpy(np.concatenate(part))[:, None].to(device)
        for part in ([pair.clean for pair in pairs], [pair.degraded for pair in pairs])
    )
    matrices = torch.tensor(np.stack([p.matrix for p in pairs]), dtype=torch.float32, device=device)
    with torch.no_grad():
        wanted, wanted_scores = teacher(clean)
    dense, scores = student(degraded)
    unlike = (1 - cosine_similarity(dense, wanted, dim=1)).mean()
    wrong = score_loss(scores, wanted_scores)
    return unlike + SCORES * wrong + MATCHES * matching_loss(dense, scores, matrices)


@strings_as_paths
def main(
    images: Iterable[Path],
    output: Path,
    dim: int = 32,
    towns: Iterable[int] = (),
    teacher: str | None = None,
    start: Path | None = None,
    steps: int = 4000,
    cache: Path = Path("outputs/training/towns"),
    seed: int = 0,
) -> Path:
    """Train a network.

    Args:
        images: folders of photos.
        output: file of its weights, .safetensors.
        dim: dimension of its descriptors.
        towns: seeds of demo towns that are rendered by day and by night.
        teacher: a model of EdgePoint2 with the same dimension, such as E32.
        start: weights of an earlier training to start from; default: random ones.
        steps: number of training steps, of 8 views each.
        cache: folder for the rendered photos.
        seed: of everything random.

    Raises:
        InputError: when there are no photos, no such teacher, or its dimension is another one.
    """
    teacher = cli.choose("teacher", teacher or f"E{dim}", EDGEPOINT2)
    if int(teacher[1:]) != dim:
        raise InputError(f"The teacher {teacher} has another dimension than {dim}.")
    if output.suffix != ".safetensors":
        raise InputError(f"--output {output}: it must end in .safetensors.")
    images, towns = list(images), list(towns)
    sources = views.of_folders(images) + views.render_towns(towns, cache)
    if not sources:
        raise InputError("Give photos, --images, or seeds of --towns.")
    torch.manual_seed(seed)
    student = EdgePoint2(ARCHITECTURE, dim)
    if start:
        read_into(student, fetch_weights(MINI[0], start), "The weights")
    student = student.to(device())
    guide = load_weights(EdgePoint2(teacher[0], dim), teacher).to(device())
    metadata = {
        "architecture": f"EdgePoint2 {ARCHITECTURE}{dim}",
        "dim": dim,
        "teacher": f"EdgePoint2 {teacher}",
        "images": [path.resolve().parent.name for path in images],
        "towns": towns,
        "photos": len(sources),
        "steps": steps,
        "recipe": RECIPE,
        "seed": seed,
        "start": start and file_sha256(start),
    }
    names = [f"{source.clean} {source.clean.stat().st_size}" for source in sources]
    digest = hashlib.sha256("\n".join(names).encode()).hexdigest()
    checkpoint = output.with_suffix(".checkpoint")
    step_loss = partial(loss, student, guide, sources, seed)
    made_from = json.dumps({**metadata, "digest": digest, "batch": BATCH})
    fit(student.train(), step_loss, steps, RECIPE, checkpoint, made_from)
    metadata["versions"] = versions()
    weights = {key: value.contiguous().cpu() for key, value in student.state_dict().items()}
    with replacing(output) as temporary:
        save_file(weights, temporary, {"metadata": json.dumps(metadata)})
    checkpoint.unlink(missing_ok=True)
    logger.info("The weights are in %s.", output)
    return output


def _main() -> None:
    parser = cli.Parser(
        __doc__, "--images scenes/fox/images --towns 1 2 --output weights/mini32.safetensors"
    )
    add = parser.add_argument
    add("--images", type=Path, nargs="*", default=[], help="folders of photos")
    add("--output", type=Path, required=True, help="file of the weights, .safetensors")
    add("--dim", type=int, default=32, help="dimension of the descriptors")
    add("--towns", type=int, nargs="*", default=[], help="seeds of demo towns to render")
    add("--teacher", help="model of EdgePoint2 (default: E<dim>)")
    add("--start", type=Path, help="weights to start from, to adapt them to other photos")
    add("--steps", type=int, default=4000, help="number of training steps")
    cache = Path("outputs/training/towns")
    add("--cache", type=Path, default=cache, help="folder for rendered photos")
    add("--seed", type=int, default=0, help="seed of everything random")
    main(**vars(parser.parse_args()))


if __name__ == "__main__":
    cli.run(_main)
