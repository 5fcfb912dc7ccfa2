"""Mutual nearest neighbours with a ratio test."""

import torch

from ..base_model import BaseModel


def nearest(
    similarity: torch.Tensor, ratio_threshold: float | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Find the best column of every row that passes the ratio test.

    Args:
        similarity: (N, M) cosines, M > 0; changed in between, but left as it was.
        ratio_threshold: accept if the distance to the best is at most this times the distance to
            the second best; None accepts all.

    Returns:
        The column (N,) int64, -1 where none passes, and its similarity (N,).
    """
    best, column = similarity.max(dim=1)
    if ratio_threshold is None or similarity.shape[1] < 2:
        return column, best
    # hiding the best and searching again is several times faster than topk
    rows = torch.arange(len(similarity), device=similarity.device)
    similarity[rows, column] = -torch.inf
    second = similarity.amax(dim=1)
    similarity[rows, column] = best
    # squared distances of unit vectors are 2 - 2 * cosine
    accepted = 2 * (1 - best) <= ratio_threshold**2 * 2 * (1 - second)
    return torch.where(accepted, column, -1), best


class NearestNeighbor(BaseModel):
    """The matches of hloc's `nearest_neighbor`: mutual, and both ways through the ratio test."""

    default_conf = {"ratio_threshold": None}
    required_inputs = ("descriptors0", "descriptors1")

    @torch.no_grad()
    def _forward(self, data: dict) -> dict:
        """Match descriptors (1, D, N) of unit norm with descriptors (1, D, M).

        Returns:
            matches0 (1, N) int64, the index in 1 or -1, and matching_scores0 (1, N) in [0, 1].
        """
        descriptors0, descriptors1 = data["descriptors0"][0], data["descriptors1"][0]
        size0, size1 = descriptors0.shape[1], descriptors1.shape[1]
        if min(size0, size1) == 0:
            return {
                "matches0": torch.full((1, size0), -1),
                "matching_scores0": torch.zeros((1, size0)),
            }
        # as in hloc, a lone descriptor on either side, which has no second best, skips the test
        ratio_threshold = self.conf["ratio_threshold"] if min(size0, size1) > 1 else None
        similarity = descriptors0.T @ descriptors1
        matches0, best = nearest(similarity, ratio_threshold)
        matches1, _ = nearest(similarity.T.contiguous(), ratio_threshold)
        mutual = matches1[matches0] == torch.arange(size0, device=matches0.device)
        matched = mutual & (matches0 >= 0)
        return {
            "matches0": torch.where(matched, matches0, -1)[None],
            "matching_scores0": torch.where(matched, (best + 1) / 2, 0)[None],
        }
