"""Base descriptors as torch modules."""

import torch
from torch import nn

from ..utils.cli import choose
from . import DESCRIPTORS, DIM, check_weights


class Descriptor(nn.Module):
    """A base descriptor, computed in batches.

    Args:
        name: a key of `DESCRIPTORS`.

    Raises:
        InputError: for an unknown name, or when its weights are broken or cannot be downloaded.
    """

    batch_size = 128  # intermediate results stay in the cache of a CPU

    def __init__(self, name: str):
        super().__init__()
        base = DESCRIPTORS[choose("descriptor", name, DESCRIPTORS)]
        check_weights(name)  # before kornia unpickles them
        self.name, self.describe = name, base.make().eval()

    @torch.no_grad()
    def forward(self, patches: torch.Tensor) -> torch.Tensor:
        """Map patches (N, 1, 32, 32) in [0, 1] to descriptors (N, 128) float32 of unit norm."""
        if len(patches) == 0:
            return patches.new_zeros((0, DIM))
        described = torch.cat([self.describe(batch) for batch in patches.split(self.batch_size)])
        if described.shape != (len(patches), DIM):
            found = tuple(described.shape)
            raise ValueError(f"The module of {self.name} returned {found} instead of (N, {DIM}).")
        return nn.functional.normalize(described, dim=1)
