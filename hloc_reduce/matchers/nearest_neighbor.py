"""Nearest neighbours: mutual, with a ratio test and a distance threshold, as in hloc."""

from collections.abc import Iterator

import torch
from torch.nn.utils.rnn import pad_sequence

from . import GPU_BYTES, Matcher

PART_BYTES = 2**19  # of descriptors1 at once, which stay in the cache of a core
TILE = 2**20  # similarities at once


def nearest(
    descriptors0: torch.Tensor,
    descriptors1: torch.Tensor,
    ratio_threshold: float | None,
    gpu_bytes: int = GPU_BYTES,
    distance_threshold: float | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Find the nearest descriptor1 of every descriptor0 that passes the tests.

    Args:
        descriptors0: (N, D) of unit norm.
        descriptors1: (M, D) of unit norm, M > 0, and M > 1 for a ratio test.
        ratio_threshold: accept if the distance to the nearest is at most this times the distance
            to the second nearest; None accepts all.
        gpu_bytes: what similarities may take of the memory of a GPU at once.
        distance_threshold: accept if the distance to the nearest is at most this.

    Returns:
        Its index (N,) int64, -1 where it does not pass, and its cosine (N,).
    """
    number, dim = descriptors0.shape
    on_cpu = descriptors0.is_cpu
    parts = descriptors1.split(max(1, PART_BYTES // (4 * dim)) if on_cpu else len(descriptors1))
    rows = max(1, (TILE if on_cpu else gpu_bytes // 4) // len(parts[0]))
    best, second = descriptors0.new_empty(2, len(parts), number)
    index = best.new_empty(best.shape, dtype=torch.int64)
    buffer = best.new_empty(min(rows, number) * len(parts[0]))
    for i, part in enumerate(parts):
        for start in range(0, number, rows):
            chosen = slice(start, start + rows)
            block = descriptors0[chosen]
            # new memory for every tile would cost as much as the product
            tile = buffer[: len(block) * len(part)].view(len(block), len(part))
            torch.mm(block, part.T, out=tile)
            index[i, chosen] = _argmax(tile)
            nearest_one = index[i, chosen, None]
            torch.gather(tile, 1, nearest_one, out=best[i, chosen, None])
            if ratio_threshold is not None:
                # hiding the best and searching again is faster than topk
                tile.scatter_(1, nearest_one, -torch.inf)
                torch.amax(tile, 1, out=second[i, chosen])
        index[i] += i * len(parts[0])
    cosine, winner = best.max(dim=0, keepdim=True)
    found = index.gather(0, winner)[0]
    runner_up = None
    if ratio_threshold is not None:
        runner_up = torch.maximum(
            second.gather(0, winner), best.scatter(0, winner, -torch.inf).amax(0, keepdim=True)
        )[0]
    accepted = _accepted(cosine[0], runner_up, ratio_threshold, distance_threshold)
    return torch.where(accepted, found, -1), cosine[0]


def _accepted(
    cosine: torch.Tensor,
    runner_up: torch.Tensor | None,
    ratio_threshold: float | None,
    distance_threshold: float | None,
) -> torch.Tensor:
    """Tell which nearest neighbours pass the tests, by their cosines and those of the second."""
    # squared distances of unit vectors are 2 - 2 * cosine
    accepted = torch.ones_like(cosine, dtype=torch.bool)
    if ratio_threshold is not None:
        accepted &= 1 - cosine <= ratio_threshold**2 * (1 - runner_up)
    if distance_threshold is not None:
        accepted &= 2 * (1 - cosine) <= distance_threshold**2
    return accepted


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
    gpu_bytes: int = GPU_BYTES,
    distance_threshold: float | None = None,
    mutual: bool = True,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Match descriptors that are each other's nearest, both ways through the tests.

    Args:
        descriptors0: (N, D) of unit norm.
        descriptors1: (M, D) of unit norm.
        ratio_threshold: as of `nearest`.
        rows: (K,) of descriptors0, to find the matches of these only; default: all.
        gpu_bytes: as of `nearest`.
        distance_threshold: as of `nearest`.
        mutual: if not, match each row with its nearest, whatever that one's nearest is.

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
    limits = ratio_threshold, gpu_bytes, distance_threshold
    forward, cosine = nearest(chosen, descriptors1, *limits)
    if not mutual:
        return forward, cosine
    # the way back only for those that somebody wants
    wanted = forward[forward >= 0].unique()
    backward = torch.full((len(descriptors1),), -1, device=forward.device)
    if len(wanted):
        returned, _ = nearest(descriptors1[wanted], descriptors0, *limits)
        backward[wanted] = returned
    own = torch.arange(len(descriptors0), device=forward.device) if rows is None else rows
    matched = (backward[forward] == own) & (forward >= 0)
    return torch.where(matched, forward, -1), cosine


def mutual_nearest_padded(
    descriptors0: list[torch.Tensor],
    descriptors1: list[torch.Tensor],
    ratio_threshold: float | None,
    distance_threshold: float | None = None,
    mutual: bool = True,
) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Match several pairs as `mutual_nearest` does, at once, as suits a GPU.

    Args:
        descriptors0: of P pairs (N, D), N > 0, of unit norm.
        descriptors1: of these (M, D), M > 0, of unit norm.
        ratio_threshold: as of `nearest`.
        distance_threshold: as of `nearest`.
        mutual: as of `mutual_nearest`.

    Returns:
        Of each pair the index of the match of each descriptor0 (N,) int64, or -1, and its cosine
        (N,).
    """
    sizes0, sizes1 = (
        torch.tensor([len(part) for part in parts], device=parts[0].device)
        for parts in (descriptors0, descriptors1)
    )
    similarity = _pad(descriptors0) @ _pad(descriptors1).mT
    for dim, sizes in ((1, sizes0), (2, sizes1)):
        padding = torch.arange(similarity.shape[dim], device=sizes.device) >= sizes[:, None]
        similarity.masked_fill_(padding.unsqueeze(3 - dim), -torch.inf)
    lone = torch.minimum(sizes0, sizes1) == 1
    limits = ratio_threshold, lone, distance_threshold
    matches, cosine = _nearest_padded(similarity, 2, *limits)
    if mutual:
        backward, _ = _nearest_padded(similarity, 1, *limits)
        own = torch.arange(similarity.shape[1], device=matches.device)
        returned = backward.gather(1, matches.clamp(min=0)) == own
        matches = torch.where(returned, matches, -1)
    return [(matches[i, :n], cosine[i, :n]) for i, n in enumerate(sizes0.tolist())]


def _pad(descriptors: list[torch.Tensor]) -> torch.Tensor:
    return pad_sequence(descriptors, batch_first=True)


def _nearest_padded(
    similarity: torch.Tensor,
    dim: int,
    ratio_threshold: float | None,
    lone: torch.Tensor,
    distance_threshold: float | None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Do what `nearest` does along a dimension of cosines (P, N, M); `lone` (P,) skip the test."""
    best, index = similarity.max(dim)
    # nothing is the nearest of padding
    accepted = (best > -torch.inf) & _accepted(best, None, None, distance_threshold)
    if ratio_threshold is None:
        return torch.where(accepted, index, -1), best
    hidden = index.unsqueeze(dim)
    similarity.scatter_(dim, hidden, -torch.inf)
    second = similarity.amax(dim)
    similarity.scatter_(dim, hidden, best.unsqueeze(dim))
    accepted &= _accepted(best, second, ratio_threshold, None) | lone[:, None]
    return torch.where(accepted, index, -1), best


class NearestNeighbor(Matcher):
    """The matches of hloc's `nearest_neighbor`, with its options."""

    default_conf = {
        "ratio_threshold": None,
        "distance_threshold": None,
        "do_mutual_check": True,
    }

    @torch.no_grad()
    def match(
        self, pairs: list[tuple[torch.Tensor, torch.Tensor]], gpu_bytes: int = GPU_BYTES
    ) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Match descriptors of unit norm, on a GPU several pairs at once.

        Args:
            pairs: of descriptors (N, D) and (M, D).
            gpu_bytes: what similarities may take of the memory of a GPU at once. A pair that needs
                more is matched in blocks.

        Returns:
            Of each pair matches0 (N,) int64, the index in 1 or -1, and matching_scores0 (N,) in
            [0, 1].
        """
        ratio_threshold = self.conf["ratio_threshold"]
        options = {
            "distance_threshold": self.conf["distance_threshold"],
            "mutual": self.conf["do_mutual_check"],
        }
        found = {}
        if all(descriptors.is_cpu for pair in pairs for descriptors in pair):
            batches = [[i] for i in range(len(pairs))]
        else:
            batches = _batches([(len(first), len(second)) for first, second in pairs], gpu_bytes)
        for batch in batches:
            parts = [pairs[i] for i in batch]
            if len(batch) == 1:
                matched = [mutual_nearest(*parts[0], ratio_threshold, None, gpu_bytes, **options)]
            else:
                matched = mutual_nearest_padded(
                    *zip(*parts, strict=True), ratio_threshold, **options
                )
            found.update(zip(batch, matched, strict=True))
        results = [found[i] for i in range(len(pairs))]
        return [(m, torch.where(m >= 0, (cosine + 1) / 2, 0)) for m, cosine in results]

    def _forward(self, data: dict) -> dict:
        """Match descriptors (1, D, N) of unit norm with descriptors (1, D, M).

        Returns:
            matches0 (1, N) and matching_scores0 (1, N), as of `match`.
        """
        pair = (data["descriptors0"][0].T.contiguous(), data["descriptors1"][0].T.contiguous())
        ((matches, scores),) = self.match([pair])
        return {"matches0": matches[None], "matching_scores0": scores[None]}


def _batches(sizes: list[tuple[int, int]], max_bytes: int) -> Iterator[list[int]]:
    """Split pairs of (N, M) descriptors into batches whose similarities, padded, take so much.

    Pairs of similar sizes come together. One that is too large, or empty, is alone.
    """
    empty = [i for i, size in enumerate(sizes) if 0 in size]
    yield from ([i] for i in empty)
    batch, height, width = [], 0, 0
    for i in sorted(set(range(len(sizes))).difference(empty), key=sizes.__getitem__):
        n, m = sizes[i]
        height, width = max(height, n), max(width, m)
        if batch and 4 * (len(batch) + 1) * height * width > max_bytes:
            yield batch
            batch, height, width = [], n, m
        batch.append(i)
    if batch:
        yield batch
