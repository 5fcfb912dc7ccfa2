"""Mutual nearest neighbours with a ratio test."""

import torch

from ..base_model import BaseModel

BLOCK = 256  # rows of the similarity matrix in memory at once


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
    buffer = descriptors0.new_empty(min(BLOCK, len(descriptors0)), len(descriptors1))
    for rows in descriptors0.split(BLOCK):
        # new memory for every block would cost as much as the product
        similarity = torch.mm(rows, descriptors1.T, out=buffer[: len(rows)])
        index = _argmax(similarity)
        best = similarity.gather(1, index[:, None])[:, 0]
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


def _argmax(similarity: torch.Tensor) -> torch.Tensor:
    """Return the column of the largest number of each row; of equal ones the first."""
    if similarity.is_cpu:  # NumPy's is twice as fast there
        return torch.from_numpy(similarity.numpy().argmax(axis=1))
    return similarity.argmax(dim=1)


def mutual_nearest(
    descriptors0: torch.Tensor,
    descriptors1: torch.Tensor,
    ratio_threshold: float | None,
    rows: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Match descriptors that are each other's nearest, both ways through the ratio test.

    Args:
        descriptors0: (N, D) of unit norm.
        descriptors1: (M, D) of unit norm.
        ratio_threshold: as of `nearest`.
        rows: (K,) of descriptors0, to find the matches of these only; default: all.

    Returns:
        For each of the rows the index of its match (K,) int64, or -1, and its cosine (K,).
    """
    chosen = descriptors0 if rows is None else descriptors0[rows]
    if min(len(chosen), len(descriptors1)) == 0:
        nothing = torch.full((len(chosen),), -1, device=chosen.device)
        return nothing, chosen.new_zeros(len(chosen))
    # as in hloc, a lone descriptor on either side, which has no second best, skips the test
    if min(len(descriptors0), len(descriptors1)) == 1:
        ratio_threshold = None
    forward, cosine = nearest(chosen, descriptors1, ratio_threshold)
    # the way back only for those that somebody wants
    wanted = forward[forward >= 0].unique()
    backward = torch.full((len(descriptors1),), -1, device=forward.device)
    if len(wanted):
        backward[wanted], _ = nearest(descriptors1[wanted], descriptors0, ratio_threshold)
    own = torch.arange(len(descriptors0), device=forward.device) if rows is None else rows
    matched = (backward[forward] == own) & (forward >= 0)
    return torch.where(matched, forward, -1), cosine


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
        matches, cosine = mutual_nearest(
            data["descriptors0"][0].T.contiguous(),
            data["descriptors1"][0].T.contiguous(),
            self.conf["ratio_threshold"],
        )
        return {
            "matches0": matches[None],
            "matching_scores0": torch.where(matches >= 0, (cosine + 1) / 2, 0)[None],
        }
