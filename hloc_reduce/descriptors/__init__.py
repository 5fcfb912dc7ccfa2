"""Base descriptors: 32x32 patches to 128 numbers."""

import kornia
import torch
from torch import nn

from ..cli import choose

PATCH_SIZE = 32
DIM = 128

# name -> the kornia module that maps (N, 1, 32, 32) in [0, 1] to (N, 128)
DESCRIPTORS = {
    "sift": lambda: kornia.feature.SIFTDescriptor(PATCH_SIZE, 8, 4, rootsift=False),
}


class Descriptor(nn.Module):
    """A base descriptor by name; computes in small batches, which stay in the cache.

    Args:
        name: a key of `DESCRIPTORS`.

    Raises:
        InputError: for an unknown name.
    """

    batch_size = 128  # kornia's SIFT is five times slower in batches of 1,024 on a CPU

    def __init__(self, name: str):
        super().__init__()
        self.describe = DESCRIPTORS[choose("descriptor", name, DESCRIPTORS)]()

    @torch.no_grad()
    def forward(self, patches: torch.Tensor) -> torch.Tensor:
        """Map patches (N, 1, 32, 32) in [0, 1] to descriptors (N, 128) float32 of unit norm."""
        if len(patches) == 0:
            return patches.new_zeros((0, DIM))
        batches = [self.describe(batch) for batch in patches.split(self.batch_size)]
        return nn.functional.normalize(torch.cat(batches), dim=1)
