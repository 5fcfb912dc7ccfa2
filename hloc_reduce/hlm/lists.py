"""Lists of images with similar signs, so that retrieval need not look at all of a large map."""

import numpy as np

from . import signs

LEAST = 100_000  # images, above which a map has lists
SAMPLES, ROUNDS = 64, 8  # images of a list, and rounds, by which the signs of lists are learned
BLOCK = 4096  # images at once
VISITED = 0.04  # of the images, in the most similar lists, which a query is compared with


def build(packed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sort images into about as many lists as each has images, by k-means of their signs.

    Args:
        packed: (N, B) uint8, signs of images.

    Returns:
        The signs of the lists (L, B) uint8, those that most of their images have; where each list
        ends (L,); and the images (N,), list by list.
    """
    generator = np.random.default_rng(0)
    number = int(len(packed) ** 0.5)
    sample = packed[generator.choice(len(packed), min(len(packed), SAMPLES * number), False)]
    centers = sample[:number]
    for _ in range(ROUNDS):
        sums = np.zeros((number, 8 * packed.shape[1]), np.float32)
        for start in range(0, len(sample), BLOCK):
            values, nearest = _nearest(sample[start : start + BLOCK], centers)
            order = np.argsort(nearest, kind="stable")
            used, first = np.unique(nearest[order], return_index=True)
            sums[used] += np.add.reduceat(values[order], first)
        found = np.packbits(sums > 0, axis=1, bitorder="little")
        centers = np.where(sums.any(axis=1, keepdims=True), found, centers)
    blocks = range(0, len(packed), BLOCK)
    of_image = np.concatenate([_nearest(packed[i : i + BLOCK], centers)[1] for i in blocks])
    ends = np.cumsum(np.bincount(of_image, minlength=number))
    return centers, ends, np.argsort(of_image, kind="stable")


def _nearest(packed: np.ndarray, centers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the signs (N, S), and the index (N,) of the list with the most equal ones."""
    values = signs.unpack(packed)
    return values, (values @ signs.unpack(centers).T).argmax(axis=1)


def visited(similarity: np.ndarray, ends: np.ndarray, share: float = VISITED) -> list[slice]:
    """Return which images, list by list, a query is compared with.

    Args:
        similarity: (L,) of the query to the lists.
        ends: (L,) from `build`.
        share: of the images, at least.
    """
    found, number = [], 0
    starts = np.concatenate([[0], ends[:-1]])
    for i in np.argsort(-similarity, kind="stable"):
        if number >= share * int(ends[-1]):
            break
        found.append(slice(int(starts[i]), int(ends[i])))
        number += int(ends[i] - starts[i])
    return found
