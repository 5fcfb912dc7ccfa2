"""The training loop that all learned schemes share."""

import time
from collections.abc import Callable, Iterable
from pathlib import Path

import torch
from torch import nn, optim

from .. import logger
from ..utils.files import replacing
from ..utils.progress import progress

CHECKPOINT_STEPS, CHECKPOINT_SECONDS = 500, 30.0  # whichever comes first


def device() -> torch.device:
    """Return the device to train on: a GPU when there is one."""
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
        loss: returns the scalar loss of a step, given its number; it depends on nothing but that
            and the network, so that a resumed training equals an uninterrupted one.
        steps: their number.
        recipe: `lr`, `weight_decay` (L2) and `final_lr`: the learning rate falls linearly from
            `lr` to `final_lr * lr`.
        checkpoint: file to resume from; the caller deletes it.
        made_from: provenance of the training; a stale checkpoint is ignored.
        before: called before each step with its number. It may change the network, and returns
            the parameters that it reset, for which the optimizer's state is dropped. It may take
            long, so a checkpoint follows if it returns any.
    """
    optimizer = optim.Adam(
        network.parameters(), lr=recipe["lr"], weight_decay=recipe["weight_decay"]
    )
    schedule = optim.lr_scheduler.LinearLR(optimizer, 1.0, recipe["final_lr"], steps)
    parts: dict[str, nn.Module | optim.Optimizer | optim.lr_scheduler.LRScheduler] = {
        "network": network,
        "optimizer": optimizer,
        "schedule": schedule,
    }
    start, prepared = 0, None  # `prepared` is a step whose `before` was called already

    def save(step: int, prepared: bool = False) -> None:
        state: dict[str, object] = {key: part.state_dict() for key, part in parts.items()}
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
            logger.info("Resuming from step %d of %s.", start, checkpoint)
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
