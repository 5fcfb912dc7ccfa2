"""Mutual nearest neighbours of descriptors that are rounded to integers."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from ..runtime import parallel
from ..runtime.trace import span
from ..utils import best_two
from ..utils.arrays import distinct
from ..utils.codes import INTEGER_SCALE

Item = TypeVar("Item")
Result = TypeVar("Result")
TILE_PRODUCTS = 2**19  # at once
PRODUCTS_PER_TASK = 2**23  # of a thread; fewer take less time than threads do to start


def is_worthwhile(coded: bool) -> bool:
    """Tell whether descriptors are matched as integers on a CPU.

    Codes are: they are rounded much more than integers. Floats are where the code of `best_two` was
    compiled, which is up to three times as fast as their products.
    """
    return coded or bool(best_two.instructions())


def nearest(
    descriptors0: np.ndarray,
    descriptors1: np.ndarray,
    ratio_threshold: float | None,
    distance_threshold: float | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the nearest descriptor1 of every descriptor0 that passes the tests.

    Args:
        descriptors0: (N, D) int16 from `utils.codes.to_integers`.
        descriptors1: (M, D) like these, M > 0, and M > 1 for a ratio test.
        ratio_threshold: maximum ratio of the distances to the nearest and the second nearest; None
            for no ratio test.
        distance_threshold: maximum distance to the nearest; None for any.

    Returns:
        Its index (N,) int64, -1 where it does not pass, and its cosine (N,) float32.
    """
    index, cosine, runner_up = two_nearest(descriptors0, descriptors1)
    accepted = _is_near(cosine, distance_threshold)
    if ratio_threshold is not None:
        accepted &= 1 - cosine <= np.float32(ratio_threshold**2) * (1 - runner_up)
    return np.where(accepted, index, -1).astype(np.int64), cosine


def two_nearest(
    descriptors0: np.ndarray, descriptors1: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the nearest descriptor1 of every descriptor0, and how near the second nearest is.

    Args:
        descriptors0: (N, D) int16 from `utils.codes.to_integers`.
        descriptors1: (M, D) like these, M > 1.

    Returns:
        The index of the nearest (N,), its cosine and that of the second nearest, (N,) float32.
    """
    search = best_two.best_two if best_two.instructions() else best_two_of_blocks
    index, best, second = search(descriptors0, descriptors1)
    return index, _cosine(best), _cosine(second)


def _cosine(product: np.ndarray) -> np.ndarray:
    """Return the cosines (N,) float32 of products of descriptors as integers (N,)."""
    return product.astype(np.float32) / np.float32(INTEGER_SCALE**2)


def _is_near(cosine: np.ndarray, distance_threshold: float | None) -> np.ndarray:
    """Return which cosines (N,) are of distances up to a threshold, if there is one."""
    if distance_threshold is None:
        return np.ones(len(cosine), bool)
    # squared distances of unit vectors are 2 - 2 * cosine
    return 2 * (1 - cosine) <= distance_threshold**2


def best_two_of_blocks(
    descriptors0: np.ndarray, descriptors1: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the best two products as `best_two.best_two` does, where nothing was compiled.

    The products are whole numbers that float64 represents exactly, but not float32.
    """
    number = len(descriptors0)
    index = np.empty(number, np.int32)
    best, second = np.empty((2, number))
    others = descriptors1.astype(np.float64).T
    rows = max(1, TILE_PRODUCTS // len(descriptors1))
    for start in range(0, number, rows):
        chosen = slice(start, start + rows)
        products = descriptors0[chosen].astype(np.float64) @ others
        of_block = np.arange(len(products))
        index[chosen] = winner = products.argmax(axis=1)
        best[chosen] = products[of_block, winner]
        products[of_block, winner] = -np.inf
        second[chosen] = products.max(axis=1)
    return index, best, second


def most_similar_first(rows0: np.ndarray, rows1: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Order matches as those of a match file are: by their scores as float16, then by `rows0`.

    Args:
        rows0: (M,) descriptors of the query.
        rows1: (M,) their matches.
        cosine: (M,) float32 of the matches.

    Returns:
        (M, 2) int64, the most similar first.
    """
    score = ((np.minimum(cosine, 1) + 1) / 2).astype(np.float16)
    order = np.lexsort((rows0, -score))
    return np.stack([rows0[order], rows1[order]], axis=1)


def mutual_nearest(
    descriptors0: np.ndarray,
    descriptors1: np.ndarray,
    ratio_threshold: float | None,
    rows: np.ndarray | None = None,
    distance_threshold: float | None = None,
    mutual: bool = True,
) -> tuple[np.ndarray, np.ndarray]:
    """Match descriptors that are each other's nearest and pass the tests of `nearest` both ways.

    Args:
        descriptors0: (N, D) int16, see `nearest`.
        descriptors1: (M, D) int16, see `nearest`.
        ratio_threshold: maximum ratio of the distances to the nearest and the second nearest; None
            for no ratio test.
        rows: (K,) rows of descriptors0 to match; default: all.
        distance_threshold: maximum distance to the nearest; None for any.
        mutual: if False, match each row with its nearest only one way.

    Returns:
        For each of the rows the index of its match (K,) int64, or -1, and its cosine (K,) float32.
    """
    chosen = descriptors0 if rows is None else descriptors0[rows]
    if min(len(chosen), len(descriptors1)) == 0:
        return np.full(len(chosen), -1), np.zeros(len(chosen), np.float32)
    # as in hloc, a lone descriptor on either side has no second nearest and skips the test
    if min(len(descriptors0), len(descriptors1)) == 1:
        ratio_threshold = None
    limits = ratio_threshold, distance_threshold
    if mutual and rows is None and ratio_threshold is None and best_two.instructions():
        index, product, back = best_two.best_both(descriptors0, descriptors1)
        cosine, found = _cosine(product), back[index] == np.arange(len(index))
        matched = found & _is_near(cosine, distance_threshold)
        return np.where(matched, index, -1).astype(np.int64), cosine
    forward, cosine = nearest(chosen, descriptors1, *limits)
    if not mutual:
        return forward, cosine
    own = np.arange(len(descriptors0)) if rows is None else rows
    return _confirmed(forward, own, descriptors0, descriptors1, limits), cosine


def _confirmed(
    forward: np.ndarray,
    rows: np.ndarray,
    descriptors0: np.ndarray,
    descriptors1: np.ndarray,
    limits: tuple[float | None, float | None],
) -> np.ndarray:
    """Replace the nearest descriptors1 (K,) of some descriptors0 by -1 unless these are theirs."""
    wanted = distinct(forward[forward >= 0])
    backward = np.full(len(descriptors1), -1)
    if len(wanted):
        backward[wanted], _ = nearest(descriptors1[wanted], descriptors0, *limits)
    return np.where((backward[forward] == rows) & (forward >= 0), forward, -1)


def match_images_of_points(
    points: np.ndarray,
    query: np.ndarray,
    images: list[np.ndarray],
    ratio_threshold: float | None,
    distance_threshold: float | None = None,
) -> list[np.ndarray]:
    """Match a photo with images that share descriptors, those of the points that they show.

    The matches of each image are those of `mutual_nearest`. The nearest descriptor of the photo to
    a point is searched for only once, for all images that show it.

    Args:
        points: (P, D) int16, see `nearest`.
        query: (N, D) int16, see `nearest`.
        images: of each image the rows of its points (K,) int64, ascending.
        ratio_threshold: maximum ratio of the distances to the nearest and the second nearest; None
            for no ratio test.
        distance_threshold: maximum distance to the nearest; None for any.

    Returns:
        For each image (M, 2) int64, the rows of the photo's descriptors and of `images[i]`, the
        most similar first.
    """
    limits = ratio_threshold, distance_threshold
    forward, cosine = np.empty(len(points), np.int64), np.empty(len(points), np.float32)
    size = max(1, PRODUCTS_PER_TASK // max(1, len(query)))
    blocks = [slice(start, start + size) for start in range(0, len(points), size)]

    def search(block: slice) -> None:
        forward[block], cosine[block] = nearest(points[block], query, *limits)

    def match(rows: np.ndarray) -> np.ndarray:
        own = np.arange(len(rows))
        if min(len(query), len(rows)) > 1:
            similar = cosine[rows]
            matches = _confirmed(forward[rows], own, points[rows], query, limits)
        else:  # no ratio test
            matches, similar = mutual_nearest(
                points[rows], query, ratio_threshold, distance_threshold=distance_threshold
            )
        matched = matches >= 0
        return most_similar_first(matches[matched], own[matched], similar[matched])

    if len(query) > 1:
        _apply(search, blocks, len(points) * len(query))
    return _apply(match, images, sum(len(rows) * min(len(rows), len(query)) for rows in images))


def _apply(function: Callable[[Item], Result], items: list[Item], products: int) -> list[Result]:
    """Apply a function to items, in threads if it computes more products than they are worth."""
    if products > PRODUCTS_PER_TASK:
        return list(parallel.ordered("match", function, items))
    with parallel.one_thread(), span("match"):
        return [function(item) for item in items]
