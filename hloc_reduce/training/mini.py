"""Train a network that finds and describes keypoints, to be stored as codes of a few bytes.

The student has the architecture of EdgePoint2, with weights of its own. It learns the descriptors
and scores that a teacher computes from clean photos, while it sees them dark, noisy and blurred;
and to match its own keypoints between two views, with the descriptors of one view rounded to 2 bits
a number. An interrupted training resumes.
"""

import hashlib
import json
import math
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import nn
from torch.nn.functional import (
    cosine_similarity,
    grid_sample,
    max_pool2d,
    normalize,
    smooth_l1_loss,
)

from .. import logger
from ..extractors.edgepoint2 import MIN_SCORE, RADIUS
from ..networks import EDGEPOINT2, MINI, MINI_SIZE, fetch_weights
from ..networks.edgepoint2 import EdgePoint2
from ..networks.loading import load_weights, output_size, read_into
from ..runtime.versions import versions
from ..utils import cli, options
from ..utils.cli import InputError
from ..utils.files import file_sha256, replacing
from ..utils.paths import strings_as_paths
from . import views
from .loop import device, fit
from .losses import contrastive_loss

RECIPE = {"weight_decay": 0.0, "final_lr": 0.0}
HIGHEST = 14.0  # logit at which the scores of the teacher are clamped
SCORES, MATCHES = 0.5, 0.5  # weights of the losses
# Scores near keypoints are few, and count more; errors above this many logits grow linearly.
HIGH_SCORE, HIGH_SCORE_WEIGHT, LINEAR_BEYOND = -6.0, 9.0, 4.0
NUM_KEYPOINTS, BORDER = 256, 8  # of a view
NEAR_PIXELS = 4.0  # keypoints nearer than that need not be told apart
TEMPERATURE = 0.06
# Lloyd-Max levels of 2 bits of a normal distribution, and the threshold between them
INNER, OUTER, THRESHOLD = 0.4528, 1.5104, 0.9816


def rounded(descriptors: torch.Tensor) -> torch.Tensor:
    """Round descriptors (N, D) of unit norm to 2 bits a number; the gradient passes straight."""
    values = descriptors.detach()
    mean, deviation = values.mean(dim=0), values.std(dim=0, correction=0) + 1e-6
    standard = (values - mean) / deviation
    levels = torch.where(standard.abs() < THRESHOLD, INNER, OUTER) * standard.sign()
    return descriptors + (normalize(mean + deviation * levels) - values)


def find(scores: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Find the keypoints of views, those with the highest scores.

    Args:
        scores: (B, 1, H, W), logits.

    Returns:
        Their pixels x, y (B, NUM_KEYPOINTS, 2), float32, and whether there is one
            (B, NUM_KEYPOINTS).
    """
    highest = max_pool2d(scores, 2 * RADIUS + 1, stride=1, padding=RADIUS)
    maxima = torch.where((scores == highest) & (scores > MIN_SCORE), scores, -torch.inf)
    inner = maxima[:, 0, BORDER:-BORDER, BORDER:-BORDER]
    found, index = inner.flatten(1).topk(NUM_KEYPOINTS)
    width = inner.shape[2]
    pixels = torch.stack([index % width, index // width], dim=2) + BORDER
    return pixels.float(), found.isfinite()


def sample(dense: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    """Return the descriptors (B, N, D) at pixels (B, N, 2) of views, from maps (B, D, h, w)."""
    grid = (pixels + 0.5) / views.SIZE * 2 - 1
    return normalize(grid_sample(dense, grid[:, None], align_corners=False)[:, :, 0].mT, dim=2)


def moved(pixels: torch.Tensor, matrices: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return where pixels (B, N, 2) are after homographies (B, 3, 3), and whether in the view."""
    there = pixels @ matrices[:, :, :2].mT + matrices[:, None, :, 2]
    there = there[..., :2] / there[..., 2:]
    return there, ((there >= BORDER) & (there < views.SIZE - BORDER)).all(dim=2)


def matching_loss(
    dense: torch.Tensor, scores: torch.Tensor, matrices: torch.Tensor
) -> torch.Tensor:
    """Compute the contrastive loss of the keypoints of first views at their places in the second.

    Args:
        dense: (2 B, D, h, w), the descriptors of first and second views in turn.
        scores: (2 B, 1, H, W), logits.
        matrices: (B, 3, 3) float32, from pixels of the first view to pixels of the second.

    Returns:
        The mean cross entropy of finding a keypoint among the others of its pair, in both
        directions, a scalar; 0 if no views have a keypoint in common.
    """
    pixels, found = find(scores[::2].detach())
    places, inside = moved(pixels, matrices)
    valid = found & inside
    places = places.where(valid[..., None], 0.0)  # some are at infinity
    if not valid.any():
        return dense.new_zeros(())
    here, there = sample(dense[::2], pixels), sample(dense[1::2], places)
    there = there.masked_scatter(valid[..., None], rounded(there[valid]))
    same = torch.eye(NUM_KEYPOINTS, dtype=torch.bool, device=dense.device)
    apart = same | (torch.cdist(places, places) > NEAR_PIXELS)
    compared = apart & valid[:, :, None] & valid[:, None]
    return contrastive_loss(here, there, TEMPERATURE, compared)


def score_loss(scores: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
    """Compute how far scores are from those of the teacher, (B, 1, H, W) logits; a scalar."""
    wanted = wanted.clamp(-HIGHEST, HIGHEST)
    errors = smooth_l1_loss(scores, wanted, reduction="none", beta=LINEAR_BEYOND)
    weights = 1 + HIGH_SCORE_WEIGHT * (wanted > HIGH_SCORE)
    return (weights * errors).sum() / weights.sum()


def loss(
    student: nn.Module, teacher: nn.Module, photos: views.Photos, batch: int, seed: int, step: int
) -> torch.Tensor:
    """Compute the loss of a training step."""
    pairs = photos.draw(batch, (seed, step))
    with torch.no_grad():
        wanted, wanted_scores = teacher(pairs.clean)
    dense, scores = student(pairs.degraded)
    unlike = (1 - cosine_similarity(dense, wanted, dim=1)).mean()
    wrong = score_loss(scores, wanted_scores)
    return unlike + SCORES * wrong + MATCHES * matching_loss(dense, scores, pairs.matrices)


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
    batch: int = 4,
    lr: float = 0.003,
    seed: int = 0,
) -> Path:
    """Train a network.

    Args:
        images: folders of photos.
        output: file of the weights, .safetensors.
        dim: dimension of the descriptors.
        towns: seeds of demo towns to render by day and by night.
        teacher: model of EdgePoint2 with the same dimension, such as E32; default: E<dim>.
        start: weights of an earlier training to start from, to adapt them to other photos; if its
            descriptors have another dimension, the last layer starts from random weights.
        steps: number of training steps.
        cache: folder for rendered photos.
        batch: pairs of views of a step; a GPU takes 32 and more.
        lr: learning rate of Adam, which falls linearly to 0.
        seed: seed of everything random.

    Raises:
        InputError: when there are no photos, no such teacher, its dimension is another one, the
            batch is empty, or the learning rate is not above 0.
    """
    teacher = cli.choose("teacher", teacher or f"E{dim}", EDGEPOINT2)
    if int(teacher[1:]) != dim:
        raise InputError(f"The teacher {teacher} has another dimension than {dim}.")
    if output.suffix != ".safetensors":
        raise InputError(f"--output {output}: it must end in .safetensors.")
    if batch < 1:
        raise InputError(f"--batch {batch}: it must be at least 1.")
    if not 0 < lr < math.inf:
        raise InputError(f"--lr {lr:g}: it must be a number above 0.")
    images, towns = list(images), list(towns)
    sources = views.of_folders(images) + views.render_towns(towns, cache)
    if not sources:
        raise InputError("Give photos, --images, or seeds of --towns.")
    torch.manual_seed(seed)
    student, guide = _networks(dim, teacher, start)
    recipe = {"lr": lr, **RECIPE}
    metadata = {
        "architecture": f"EdgePoint2 {MINI_SIZE}{dim}",
        "dim": dim,
        "teacher": f"EdgePoint2 {teacher}",
        "images": [path.resolve().parent.name for path in images],
        "towns": towns,
        "photos": len(sources),
        "steps": steps,
        "batch": batch,
        "recipe": recipe,
        "seed": seed,
        "start": start and file_sha256(start),
    }
    checkpoint = output.with_suffix(".checkpoint")
    photos = views.Photos(sources, device())
    step_loss = partial(loss, student, guide, photos, batch, seed)
    made_from = json.dumps({**metadata, "digest": _digest(sources)})
    fit(student.train(), step_loss, steps, recipe, checkpoint, made_from)
    metadata["versions"] = versions()
    weights = {key: value.contiguous().cpu() for key, value in student.state_dict().items()}
    with replacing(output) as temporary:
        save_file(weights, temporary, {"metadata": json.dumps(metadata)})
    checkpoint.unlink(missing_ok=True)
    logger.info("The weights are in %s.", output)
    return output


def _networks(dim: int, teacher: str, start: Path | None) -> tuple[nn.Module, nn.Module]:
    """Return the student and the teacher, on the device of the training."""
    student = EdgePoint2(MINI_SIZE, dim)
    if start:
        _start_from(student, start)
    networks = student, load_weights(EdgePoint2(teacher[0], dim), teacher)
    for network in networks:
        # channels last are faster
        network.to(device=device(), memory_format=torch.channels_last)  # type: ignore[call-overload]
    return networks


def _digest(sources: list[views.Source]) -> str:
    names = [f"{source.clean} {source.clean.stat().st_size}" for source in sources]
    return hashlib.sha256("\n".join(names).encode()).hexdigest()


def _start_from(student: EdgePoint2, start: Path) -> None:
    """Copy the weights of a file, except a last layer with another number of dimensions."""
    path, what = fetch_weights(MINI[0], start), "The weights"
    given = EdgePoint2(MINI_SIZE, output_size(path, EdgePoint2.last, what))
    weights, own = read_into(given, path, what).state_dict(), student.state_dict()
    same = {key: value for key, value in weights.items() if value.shape == own[key].shape}
    student.load_state_dict(own | same)


def _main() -> None:
    example = "--images scenes/fox/images --towns 1 2 --output weights/mini32.safetensors"
    options.call(main, __doc__, example, images=[])


if __name__ == "__main__":
    cli.run(_main)
