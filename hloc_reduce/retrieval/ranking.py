"""Which images of a database are most similar to queries, by their global descriptors."""

from pathlib import Path

import numpy as np

from ..utils.cli import InputError
from ..utils.h5 import get_array, open_h5

# global descriptors of queries, and of database images, in memory at once: at most this many rows
# and bytes
MAX_BLOCK_ROWS, MAX_BLOCK_BYTES = 2**14, 2**28
MAX_SIMILARITY_ROWS = 1024  # in memory at once


def similarity(queries: np.ndarray, database: np.ndarray) -> np.ndarray:
    """Return the similarity of global descriptors.

    Args:
        queries: (Q, G) of unit norm.
        database: (N, G) of unit norm, or zero for images without features.

    Returns:
        (Q, N) cosines, -inf for images without features.
    """
    found = queries @ database.T
    found[:, ~database.any(axis=1)] = -np.inf
    return found


def rank(similarity: np.ndarray, num_matched: int) -> np.ndarray:
    """Find the most similar images of a database.

    Args:
        similarity: (Q, N) of queries to the database.
        num_matched: maximum number of images to find.

    Returns:
        (Q, num_matched) rows of the database, best first; ties keep their order.
    """
    return np.argsort(-similarity, axis=1, kind="stable")[:, :num_matched]


def rank_file(
    queries: np.ndarray, path: Path, names: list[str], num_matched: int, size: int
) -> np.ndarray:
    """Rank as `rank` does, but read the database from a file.

    Args:
        queries: (Q, G) of unit norm.
        path: h5 file of the global descriptors of the database.
        names: of its images.
        num_matched: maximum number of images to find.
        size: images in memory at once, see `block`.

    Returns:
        (Q, num_matched) rows of `names`.

    Raises:
        InputError: when an image has no global descriptor, or one of another size.
    """
    rows = np.empty((len(queries), 0), np.int64)
    cosines = np.empty((len(queries), 0), np.float32)
    for start in range(0, len(names), size):
        database = read_global(path, names[start : start + size])
        if queries.shape[1] != database.shape[1]:
            raise InputError(
                f"Global descriptors of {queries.shape[1]} numbers cannot be compared with "
                f"{database.shape[1]} numbers in {path}."
            )
        new = np.arange(start, start + len(database))
        best = []
        for i in range(0, len(queries), MAX_SIMILARITY_ROWS):
            part = slice(i, i + MAX_SIMILARITY_ROWS)
            values = np.hstack([cosines[part], similarity(queries[part], database)])
            found = np.hstack([rows[part], np.broadcast_to(new, (len(values), len(new)))])
            order = rank(values, num_matched)
            best.append([np.take_along_axis(array, order, 1) for array in (found, values)])
        rows, cosines = (np.concatenate(parts) for parts in zip(*best, strict=True))
    return rows


def block(path: Path, name: str) -> int:
    """Return how many global descriptors like that of an image in a file are read at once."""
    return max(1, min(MAX_BLOCK_ROWS, MAX_BLOCK_BYTES // read_global(path, [name]).nbytes))


def read_global(path: Path, names: list[str]) -> np.ndarray:
    """Read the global descriptors of images (N, G) float32.

    Raises:
        InputError: when an image has none, or they differ in size.
    """
    with open_h5(path) as file:
        rows = [get_array(file, name, "global_descriptor", (1,)) for name in names]
    if len({row.shape for row in rows}) > 1:
        raise InputError(f"The global descriptors in {path} differ in size.")
    return np.stack(rows).astype(np.float32)
