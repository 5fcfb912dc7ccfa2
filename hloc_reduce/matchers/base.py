"""The base class of matchers."""

import torch

from ..utils.base_model import BaseModel

GPU_BYTES = 2**30  # of GPU memory that a matcher may use at once

Tensors = tuple[torch.Tensor, torch.Tensor]


class Matcher(BaseModel):
    """Matches the descriptors of two images.

    A subclass writes `_forward`: from `descriptors0` (1, D, N) and `descriptors1` (1, D, M) of unit
    norm to `matches0` (1, N) int64, the index in 1 or -1, and `matching_scores0` (1, N) in [0, 1].
    It sets `takes_codes` if its `match` and `match_rows` also take unbiased codes, whose norms are
    above 1 (`utils.codes.restore`), and, on a CPU, pairs of int16 descriptors (`to_integers`).
    """

    takes_codes = False

    required_inputs = ("descriptors0", "descriptors1")

    @torch.no_grad()
    def match(self, pairs: list[Tensors], gpu_bytes: int = GPU_BYTES) -> list[Tensors]:
        """Match several pairs; a subclass may match them at once.

        Args:
            pairs: descriptors (N, D) and (M, D) of unit norm, all on one device.
            gpu_bytes: GPU memory to use at once.

        Returns:
            matches0 (N,) and matching_scores0 (N,) of each pair.
        """
        found = [self({"descriptors0": a.T[None], "descriptors1": b.T[None]}) for a, b in pairs]
        return [(one["matches0"][0], one["matching_scores0"][0]) for one in found]

    def match_rows(
        self, descriptors0: torch.Tensor, descriptors1: torch.Tensor, rows1: torch.Tensor
    ) -> torch.Tensor:
        """Match a pair and keep the matches of some descriptors1; a subclass may skip the others.

        Args:
            descriptors0: (N, D) of unit norm.
            descriptors1: (M, D) of unit norm.
            rows1: (K,) int64, ascending rows of descriptors1.

        Returns:
            Matches (L, 2) int64, rows of descriptors0 and descriptors1, the most similar first, in
            the order that `utils.match_files.most_similar_first` gives.
        """
        ((matches0, scores),) = self.match([(descriptors0, descriptors1)])
        rows0 = torch.nonzero(torch.isin(matches0, rows1))[:, 0]
        # as float16, as a match file has them
        rows0 = rows0[scores[rows0].half().float().argsort(descending=True, stable=True)]
        return torch.stack([rows0, matches0[rows0]], dim=1)
