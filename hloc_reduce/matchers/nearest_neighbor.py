"""Mutual nearest neighbours with a ratio test."""

import torch

from ..base_model import BaseModel

BLOCK = 1024  # rows of the similarity matrix in memory at once


def nearest(
    descriptors0: torch.Tensor, descriptors1: torch.Tensor, ratio_threshold: float | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Find the nearest descriptor1 of every descriptor0 that passes the ratio test.

    Args:
        descriptors0: (N, D) of unit norm.
        descriptors1: (M, D) of unit norm, M > 0, and M > 1 for a ratio test.
        ratio_threshold: accept if the distance to the nearest is at most this times the distance
            to the second nearest; None accepts all.

    Returns:
        Its index (N,) int64, -1 where it does not pass, and its cosine (N,).
    """
    indices, cosines = [], []
    for rows in descriptors0.split(BLOCK):
        similarity = rows @ descriptors1.T
        best, index = similarity.max(dim=1)
        if ratio_threshold is not None:
            # hiding the best and searching again is faster than topk
            similarity.scatter_(1, index[:, None], -torch.inf)
            second = similarity.amax(dim=1)
            # squared distances of unit vectors are 2 - 2 * cosine
            accepted = 2 * (1 - best) <= ratio_threshold**2 * 2 * (1 - second)
            index = torch.where(accepted, index, -1)
        indices.append(index)
        cosines.append(best)
    return torch.cat(indices), torch.cat(cosines)


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
        descriptors0 = data["descriptors0"][0].T.contiguous()
        descriptors1 = data["descriptors1"][0].T.contiguous()
        size0, size1 = len(descriptors0), len(descriptors1)
        if min(size0, size1) == 0:
            return {
                "matches0": torch.full((1, size0), -1),
                "matching_scores0": torch.zeros((1, size0)),
            }
        # as in hloc, a lone descriptor on either side, which has no second best, skips the test
        ratio_threshold = self.conf["ratio_threshold"] if min(size0, size1) > 1 else None
        forward, cosine = nearest(descriptors0, descriptors1, ratio_threshold)
        # the way back only for those that somebody wants
        wanted = forward[forward >= 0].unique()
        backward = torch.full((size1,), -1, device=forward.device)
        if len(wanted):
            backward[wanted], _ = nearest(descriptors1[wanted], descriptors0, ratio_threshold)
        mutual = backward[forward] == torch.arange(size0, device=forward.device)
        matched = mutual & (forward >= 0)
        return {
            "matches0": torch.where(matched, forward, -1)[None],
            "matching_scores0": torch.where(matched, (cosine + 1) / 2, 0)[None],
        }
