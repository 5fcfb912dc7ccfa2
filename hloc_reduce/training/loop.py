"""The loop that all learned schemes share."""

import time
from collections.abc import Callable, Iterable
from pathlib import Path

import torch
from torch import nn

from .. import logger
from ..utils.files import replacing
from ..utils.progress import progress

CHECKPOINT_STEPS, CHECKPOINT_SECONDS = 500, 30.0  # whichever comes first


def device() -> torch.device:
    """Return the device that trainings run on: a GPU when there is one."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def fit(
    network: nn.Module,
    loss: Callable[[int], torch.Tensor],
    steps: int,
    recipe: dict,
    checkpoint: Path,
    made_from: str = "",
    before: Callable[[int], Iterable[nn.Parameter]] | None = None,
) -> None:
    """Minimize a loss with Adam.

    Args:
        network: everything that is learned, on its device.
        loss: returns the scalar loss of a step, given its number; depends on nothing else but the
            network, so that a killed training that goes on is the same as an undisturbed one.
        steps: their number.
        recipe: `lr`, `weight_decay` (L2) and `final_lr`, the share of `lr` that the learning rate
            falls to, linearly.
        checkpoint: file from which a killed training goes on; the caller deletes it.
        made_from: says what the training is made from; a checkpoint of another is not used.
        before: called before each step with its number, may change the network and returns the
            parameters that were set anew, of which the optimizer knows nothing then. As this may
            take long, a checkpoint follows.
    """
    optimizer = torch.optim.Adam(
        network.parameters(), lr=recipe["lr"], weight_decay=recipe["weight_decay"]
    )
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, recipe["final_lr"], steps)
    parts = {"network": network, "optimizer": optimizer, "schedule": schedule}
    start, prepared = 0, None  # the step before which `before` was called already

    def save(step: int, prepared: bool = False) -> None:
        state = {key: part.state_dict() for key, part in parts.items()}
        state |= {"step": step, "prepared": prepared, "made_from": made_from}
        with replacing(checkpoint) as temporary:
            torch.save(state, temporary)

    if checkpoint.exists():
        state = torch.load(checkpoint, weights_only=True, map_location="cpu")
        if state["made_from"] == made_from:
            start = state["step"]
            prepared = start if state.get("prepared") else None
            for key, part in parts.items():
                part.load_state_dict(state[key])
            logger.info("Going on from step %d of %s.", start, checkpoint)
    mean_loss, saved = None, time.monotonic()
    shown = progress(range(start, steps), "Training", "step", steps, start)
    for step in shown:
        if before and step != prepared and (renewed := list(before(step))):
            for parameter in renewed:
                optimizer.state.pop(parameter, None)
            save(step, prepared=True)
        value = loss(step)
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        schedule.step()
        mean_loss = value.item() if mean_loss is None else 0.99 * mean_loss + 0.01 * value.item()
        shown.set_postfix(loss=f"{mean_loss:.4f}", refresh=False)
        late = time.monotonic() - saved > CHECKPOINT_SECONDS
        if (step + 1) % CHECKPOINT_STEPS == 0 or late:
            save(step + 1)
            saved = time.monotonic()
