"""The three tasks of HPatches (Balntas et al., CVPR 2017), as in its Python benchmark."""

from collections.abc import Iterator

import numpy as np
from scipy.spatial.distance import cdist

from ...runtime import parallel
from ...utils.progress import progress
from ..ranking import average_precision, roc_area
from .data import IMAGE_NUMBERS, NOISE_LEVELS, PATCH_TYPES, Descriptors

POOLS = (100, 500, 1000, 5000, 10000, 15000, 20000)
IMBALANCE = 0.2  # share of the positive pairs in the imbalanced protocol
OWN = len(IMAGE_NUMBERS)  # noisy patches of a query in the retrieval task
PAIRS_PER_BLOCK, QUERIES_PER_BLOCK = 2**16, 2**8  # per block


def matching_ap(reference: np.ndarray, target: np.ndarray) -> float:
    """Match all rows of two images and rank the matches by distance.

    Args:
        reference: descriptors (N, D).
        target: descriptors (N, D); row i matches row i of the reference.

    Returns:
        The average precision of "the nearest row, the first one of a tie, is the match". All N
        matches count: one that is not found is missed.
    """
    # unlike a matrix product, it sums in a fixed order: equal descriptors are equally far
    apart = cdist(reference, target)
    nearest = apart.argmin(axis=1)
    order = np.argsort(apart.min(axis=1), kind="stable")
    right = nearest[order] == order
    return float(average_precision(np.flatnonzero(right) + 1, len(reference)))


def matching(descriptors: Descriptors) -> Iterator[tuple[str, str, float]]:
    """Match the reference image of each sequence with its other images.

    Yields:
        The noise, the sequence and image, and the average precision.
    """
    images = [
        (s, noise, i) for s in descriptors.sizes for noise in NOISE_LEVELS for i in IMAGE_NUMBERS
    ]

    def match(task: tuple[str, str, int]) -> float:
        sequence, noise, image = task
        target = descriptors.of(sequence, f"{noise}{image}")
        return matching_ap(descriptors.of(sequence, "ref"), target)

    scores = progress(parallel.ordered("match", match, images), "Matching", "image", len(images))
    for (sequence, noise, image), score in zip(images, scores, strict=True):
        yield noise, f"{sequence} {image}", score


def verification(
    descriptors: Descriptors, pairs: dict[str, np.ndarray]
) -> Iterator[tuple[str, str, float]]:
    """Tell pairs of the same patch from pairs of different patches.

    Args:
        descriptors: of the split.
        pairs: from `TaskLists.pairs`.

    Yields:
        The noise; the kind of negatives and the protocol; and the score: the area under the ROC
        curve (balanced), or the average precision of the first fifth of the positives among all
        negatives (imbalanced).
    """
    for noise in progress(NOISE_LEVELS, "Verification", "noise"):
        right = pair_distances(descriptors, pairs["pos"], noise)
        few = np.sort(right[: int(IMBALANCE * len(right))])
        for kind in ("inter", "intra"):
            wrong = pair_distances(descriptors, pairs[f"neg_{kind}"], noise)
            yield noise, f"{kind} balanced", roc_area(right, wrong)
            # in a tie the wrong pair comes first
            nearer = np.searchsorted(np.sort(wrong), few, side="right")
            ranks = np.arange(1, len(few) + 1) + nearer
            yield noise, f"{kind} imbalanced", float(average_precision(ranks, len(few)))


def pair_distances(descriptors: Descriptors, pairs: np.ndarray, noise: str) -> np.ndarray:
    """Return the L2 distances (P,) of pairs (P, 2, 2) of images and patches at a noise."""
    apart = []
    for part in np.array_split(pairs, -(-len(pairs) // PAIRS_PER_BLOCK)):
        first, second = (
            descriptors.rows_of_images(part[:, side, 1], part[:, side, 0], noise) for side in (0, 1)
        )
        apart.append(np.linalg.norm(first.astype(np.float64) - second, axis=1))
    return np.concatenate(apart)


def retrieval(
    descriptors: Descriptors, queries: np.ndarray, distractors: np.ndarray
) -> Iterator[tuple[str, str, float]]:
    """Find the five noisy patches of each query among distractors of other sequences.

    Args:
        descriptors: of the split.
        queries: (Q,) reference patches.
        distractors: (N,) reference patches; a query skips those of its own sequence.

    Yields:
        The noise, the size of the pool and the mean average precision.
    """
    pool, sequence = descriptors.rows(distractors, "ref"), descriptors.sequence

    def rank(block: np.ndarray) -> np.ndarray:
        described = descriptors.rows(block, "ref")
        own = np.stack([descriptors.rows(block, kind) for kind in PATCH_TYPES[1:]], axis=1)
        # summed as in the pool, so that equal descriptors are equally far
        right = np.stack([cdist(described[i : i + 1], own[i])[0] for i in range(len(block))])
        right = np.sort(right.reshape(len(block), len(NOISE_LEVELS), OWN))
        apart = cdist(described, pool)
        return np.stack(
            [
                ranks_in_pools(right[i], apart[i, sequence[distractors] != sequence[query]])
                for i, query in enumerate(block)
            ]
        )

    blocks = np.array_split(queries, -(-len(queries) // QUERIES_PER_BLOCK))
    ranks = progress(parallel.ordered("rank", rank, blocks), "Retrieval", "block", len(blocks))
    precision = average_precision(np.concatenate(list(ranks)), OWN).mean(axis=0)
    for noise, row in zip(NOISE_LEVELS, precision, strict=True):
        for size, value in zip(POOLS, row, strict=True):
            yield noise, str(size), float(value)


def ranks_in_pools(right: np.ndarray, wrong: np.ndarray) -> np.ndarray:
    """Rank a query's own patches in pools of these and the first distractors.

    Args:
        right: (3, 5) ascending distances of its own patches, which come first in a tie.
        wrong: (N,) distances of the distractors.

    Returns:
        (3, P, 5) ranks, from 1 on, in each of `POOLS`.
    """
    # row n: how many of the first n distractors are nearer
    nearer = np.zeros((len(wrong) + 1, right.size), np.int64)
    np.cumsum(wrong[:, None] < right.reshape(-1), axis=0, out=nearer[1:])
    number = np.minimum(np.array(POOLS) - OWN, len(wrong))
    before = nearer[number].reshape(len(POOLS), len(NOISE_LEVELS), OWN)
    return before.swapaxes(0, 1) + np.arange(1, OWN + 1)
