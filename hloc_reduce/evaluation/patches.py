"""Descriptors of patches, computed once and kept in an h5 file."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import torch

from ..descriptors.model import Descriptor
from ..runtime import parallel
from ..runtime.group_writer import GroupWriter
from ..utils.progress import progress


def describe_patches(
    path: Path,
    conf: dict,
    descriptor: str,
    names: Iterable[str],
    read: Callable[[str], Iterable[tuple[str, np.ndarray]]],
    unit: str,
) -> None:
    """Describe groups of patches; groups that the file already has are skipped.

    Args:
        path: the h5 file, for each group data sets (N, 128) float32.
        conf: what else the descriptors depend on: a file made with another one is refused.
        descriptor: the base descriptor.
        names: of the groups.
        read: returns the data sets of a group, their names and patches (N, 32, 32) float32 in
            [0, 1].
        unit: what a group is, for the progress bar.
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = Descriptor(descriptor).to(device)

    def describe_group(name: str) -> tuple[str, dict[str, np.ndarray]]:
        batches = ((key, torch.from_numpy(patches)[:, None]) for key, patches in read(name))
        return name, {key: model(batch.to(device)).cpu().numpy() for key, batch in batches}

    with GroupWriter(path, {"descriptor": descriptor, **conf}) as writer:
        todo = [name for name in names if name not in writer]
        workers = None if device == "cpu" else 1
        done = parallel.ordered("describe", describe_group, todo, workers)
        for name, described in progress(done, f"Describing by {descriptor}", unit, len(todo)):
            writer.add(name, described)
