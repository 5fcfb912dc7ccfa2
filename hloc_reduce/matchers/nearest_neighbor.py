"""Nearest neighbours: mutual, with a ratio test and a distance threshold, as in hloc."""

from collections.abc import Iterator, Sequence

import torch
from torch.nn.utils.rnn import pad_sequence

from . import integers
from .base import GPU_BYTES, Features, Matcher, Tensors

PART_BYTES = 2**19  # of descriptors1 at once: they stay in the cache of a core
TILE_SIMILARITIES = 2**20  # at once


def nearest(
    descriptors0: torch.Tensor,
    descriptors1: torch.Tensor,
    ratio_threshold: float | None,
    gpu_bytes: int = GPU_BYTES,
    distance_threshold: float | None = None,
) -> Tensors:
    """Find the nearest descriptor1 of every descriptor0 that passes the tests.

    Args:
        descriptors0: (N, D) of unit norm.
        descriptors1: (M, D) like these, M > 0, and M > 1 for a ratio test.
        ratio_threshold: maximum ratio of the distances to the nearest and the second nearest; None
            for no ratio test.
        gpu_bytes: GPU memory for similarities at once.
        distance_threshold: maximum distance to the nearest; None for any.

    Returns:
        Its index (N,) int64, -1 where it does not pass, and its cosine (N,).
    """
    index, cosine, runner_up = _best_two(
        descriptors0, descriptors1, ratio_threshold is not None, gpu_bytes
    )
    accepted = _is_near(cosine, distance_threshold)
    if ratio_threshold is not None:
        accepted &= _is_distinct(cosine, runner_up, ratio_threshold)
    return torch.where(accepted, index, -1), cosine


def _best_two(
    descriptors0: torch.Tensor,
    descriptors1: torch.Tensor,
    two: bool = True,
    gpu_bytes: int = GPU_BYTES,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Find the largest product of every descriptor0 (N, D) with one of (M, D).

    Returns:
        The index of the nearest descriptor1 (N,) int64, the first of equal ones; the product
        (N,); and, if `two`, the second largest (N,).
    """
    number, dim = descriptors0.shape
    on_cpu = descriptors0.is_cpu
    parts = descriptors1.split(max(1, PART_BYTES // (4 * dim)) if on_cpu else len(descriptors1))
    rows = max(1, (TILE_SIMILARITIES if on_cpu else gpu_bytes // 4) // len(parts[0]))
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
            if two:
                # hiding the best and searching again is faster than topk
                tile.scatter_(1, nearest_one, -torch.inf)
                torch.amax(tile, 1, out=second[i, chosen])
        index[i] += i * len(parts[0])
    largest, winner = best.max(dim=0, keepdim=True)
    if two:
        others = best.scatter(0, winner, -torch.inf).amax(0, keepdim=True)
        runner_up = torch.maximum(second.gather(0, winner), others)
    else:
        runner_up = largest
    return index.gather(0, winner)[0], largest[0], runner_up[0]


def _is_near(cosine: torch.Tensor, distance_threshold: float | None) -> torch.Tensor:
    """Apply the distance threshold, if any, to the cosines of nearest neighbours."""
    if distance_threshold is None:
        return torch.ones_like(cosine, dtype=torch.bool)
    # squared distances of unit vectors are 2 - 2 * cosine
    return 2 * (1 - cosine) <= distance_threshold**2


def _is_distinct(
    cosine: torch.Tensor, runner_up: torch.Tensor, ratio_threshold: float
) -> torch.Tensor:
    """Apply the ratio test to the cosines of the nearest and second nearest neighbours."""
    return 1 - cosine <= ratio_threshold**2 * (1 - runner_up)


def _argmax(similarity: torch.Tensor) -> torch.Tensor:
    """Return the column of the largest number of each row, the first of equal ones."""
    if similarity.is_cpu:  # NumPy is twice as fast there
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
) -> Tensors:
    """Match descriptors that are each other's nearest and pass the tests of `nearest` both ways.

    Args:
        descriptors0: (N, D) of unit norm, or int16 from `utils.codes.to_integers`.
        descriptors1: (M, D) like these.
        ratio_threshold: maximum ratio of the distances to the nearest and the second nearest; None
            for no ratio test.
        rows: (K,) rows of descriptors0 to match; default: all.
        gpu_bytes: GPU memory that may be used at once.
        distance_threshold: maximum distance to the nearest; None for any.
        mutual: if False, match each row with its nearest only one way.

    Returns:
        For each of the rows the index of its match (K,) int64, or -1, and its cosine (K,).
    """
    if descriptors0.dtype == torch.int16:
        numbers = None if rows is None else rows.numpy()
        arrays = integers.mutual_nearest(
            descriptors0.numpy(),
            descriptors1.numpy(),
            ratio_threshold,
            numbers,
            distance_threshold,
            mutual,
        )
        return torch.from_numpy(arrays[0]), torch.from_numpy(arrays[1])
    chosen = descriptors0 if rows is None else descriptors0[rows]
    if min(len(chosen), len(descriptors1)) == 0:
        unmatched = torch.full((len(chosen),), -1, device=chosen.device)
        return unmatched, torch.zeros(len(chosen), device=chosen.device)
    # as in hloc, a lone descriptor on either side has no second nearest and skips the test
    if min(len(descriptors0), len(descriptors1)) == 1:
        ratio_threshold = None
    limits = ratio_threshold, gpu_bytes, distance_threshold
    forward, cosine = nearest(chosen, descriptors1, *limits)
    if not mutual:
        return forward, cosine
    # the way back, only for descriptors that are someone's nearest
    wanted = forward[forward >= 0].unique()
    backward = torch.full((len(descriptors1),), -1, device=forward.device)
    if len(wanted):
        returned, _ = nearest(descriptors1[wanted], descriptors0, *limits)
        backward[wanted] = returned
    own = torch.arange(len(descriptors0), device=forward.device) if rows is None else rows
    matched = (backward[forward] == own) & (forward >= 0)
    return torch.where(matched, forward, -1), cosine


def mutual_nearest_padded(
    descriptors0: Sequence[torch.Tensor],
    descriptors1: Sequence[torch.Tensor],
    ratio_threshold: float | None,
    distance_threshold: float | None = None,
    mutual: bool = True,
) -> list[Tensors]:
    """Match several pairs as `mutual_nearest` does, at once, for a GPU.

    Args:
        descriptors0: (N, D) of unit norm of each pair, N > 0.
        descriptors1: (M, D) of unit norm of each pair, M > 0.
        ratio_threshold: maximum ratio of the distances to the nearest and the second nearest; None
            for no ratio test.
        distance_threshold: maximum distance to the nearest; None for any.
        mutual: if False, match each descriptor0 with its nearest only one way.

    Returns:
        For each pair the index of the match of each descriptor0 (N,) int64, or -1, and its cosine
        (N,).
    """
    sizes0, sizes1 = (
        torch.tensor([len(part) for part in parts], device=parts[0].device)
        for parts in (descriptors0, descriptors1)
    )
    padded0, padded1 = (pad_sequence(list(d), True) for d in (descriptors0, descriptors1))
    similarity = padded0 @ padded1.mT
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


def _nearest_padded(
    similarity: torch.Tensor,
    dim: int,
    ratio_threshold: float | None,
    lone: torch.Tensor,
    distance_threshold: float | None,
) -> Tensors:
    """Find nearest neighbours along a dimension of cosines (P, N, M), see `nearest`.

    The pairs in `lone` (P,) skip the ratio test.
    """
    best, index = similarity.max(dim)
    # nothing is the nearest of padding
    accepted = (best > -torch.inf) & _is_near(best, distance_threshold)
    if ratio_threshold is not None:
        hidden = index.unsqueeze(dim)
        similarity.scatter_(dim, hidden, -torch.inf)
        distinct = _is_distinct(best, similarity.amax(dim), ratio_threshold)
        similarity.scatter_(dim, hidden, best.unsqueeze(dim))
        accepted &= distinct | lone[:, None]
    return torch.where(accepted, index, -1), best


class NearestNeighbor(Matcher):
    """The matches of hloc's `nearest_neighbor`, with its options."""

    takes_codes = True
    default_conf = {
        "ratio_threshold": None,
        "distance_threshold": None,
        "do_mutual_check": True,
    }

    @torch.no_grad()
    def match(
        self, pairs: Sequence[tuple[Features, Features]], gpu_bytes: int = GPU_BYTES
    ) -> list[Tensors]:
        """Match pairs, see `Matcher.match`; on a GPU several small ones at once."""
        described = [(a["descriptors"].T, b["descriptors"].T) for a, b in pairs]
        options = {
            "ratio_threshold": self.conf["ratio_threshold"],
            "distance_threshold": self.conf["distance_threshold"],
            "mutual": self.conf["do_mutual_check"],
        }
        on_cpu = all(descriptors.is_cpu for pair in described for descriptors in pair)
        max_bytes = 0 if on_cpu else gpu_bytes
        found: dict[int, Tensors] = {}
        for batch in _batches([(len(a), len(b)) for a, b in described], max_bytes):
            if len(batch) == 1:
                matched = [mutual_nearest(*described[batch[0]], gpu_bytes=gpu_bytes, **options)]
            else:
                descriptors0, descriptors1 = zip(*(described[i] for i in batch), strict=True)
                matched = mutual_nearest_padded(descriptors0, descriptors1, **options)
            found.update(zip(batch, matched, strict=True))
        results = (found[i] for i in range(len(pairs)))
        return [(m, torch.where(m >= 0, (cosine.clamp(max=1) + 1) / 2, 0)) for m, cosine in results]

    @torch.no_grad()
    def match_rows(
        self, features0: Features, features1: Features, rows1: torch.Tensor
    ) -> torch.Tensor:
        """Match only some descriptors1, see `Matcher.match_rows`."""
        if not self.conf["do_mutual_check"]:
            return super().match_rows(features0, features1, rows1)
        matches1, cosine = mutual_nearest(
            features1["descriptors"].T,
            features0["descriptors"].T,
            self.conf["ratio_threshold"],
            rows1,
            distance_threshold=self.conf["distance_threshold"],
        )
        matched = matches1 >= 0
        found = (matches1[matched], rows1[matched], cosine[matched])
        ordered = integers.most_similar_first(*(part.cpu().numpy() for part in found))
        return torch.from_numpy(ordered).to(matches1.device)

    def _forward(self, data: dict) -> dict:
        # `match` wants the numbers of a descriptor beside each other in memory
        first, second = (
            {"descriptors": data[key][0].T.contiguous().T} for key in self.required_inputs
        )
        ((matches, scores),) = self.match([(first, second)])
        return {"matches0": matches[None], "matching_scores0": scores[None]}


def _batches(sizes: list[tuple[int, int]], max_bytes: int) -> Iterator[list[int]]:
    """Split pairs of (N, M) descriptors into batches whose padded similarities fit into memory.

    Pairs of similar sizes share a batch. A pair that is too large, or empty, is alone.
    """
    empty = [i for i, size in enumerate(sizes) if 0 in size]
    yield from ([i] for i in empty)
    batch: list[int] = []
    height = width = 0
    for i in sorted(set(range(len(sizes))).difference(empty), key=sizes.__getitem__):
        n, m = sizes[i]
        height, width = max(height, n), max(width, m)
        if batch and 4 * (len(batch) + 1) * height * width > max_bytes:
            yield batch
            batch, height, width = [], n, m
        batch.append(i)
    if batch:
        yield batch
