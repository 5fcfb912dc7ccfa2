"""Matchers: the descriptors of two images to matches."""

import sys

import torch

from ..utils.base_model import BaseModel, dynamic_load

GPU_BYTES = 2**30  # of the memory of a GPU for what is computed at once


class Matcher(BaseModel):
    """Matches the descriptors of two images.

    A subclass writes `_forward`: from `descriptors0` (1, D, N) and `descriptors1` (1, D, M) of unit
    norm to `matches0` (1, N) int64, the index in 1 or -1, and `matching_scores0` (1, N) in [0, 1].
    """

    required_inputs = ("descriptors0", "descriptors1")

    @torch.no_grad()
    def match(
        self, pairs: list[tuple[torch.Tensor, torch.Tensor]], gpu_bytes: int = GPU_BYTES
    ) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Match several pairs; a subclass may do so at once.

        Args:
            pairs: of descriptors (N, D) and (M, D), all on one device.
            gpu_bytes: what may be taken of the memory of a GPU at once.

        Returns:
            Of each pair matches0 (N,) and matching_scores0 (N,).
        """
        found = [self({"descriptors0": a.T[None], "descriptors1": b.T[None]}) for a, b in pairs]
        return [(one["matches0"][0], one["matching_scores0"][0]) for one in found]


def load(conf: dict) -> Matcher:
    """Make the matcher of a model configuration, whose `name` is that of a module of this package.

    Raises:
        InputError: when there is no such matcher, or its configuration is wrong.
    """
    return dynamic_load(sys.modules[__name__], str(conf.get("name")))(conf)
