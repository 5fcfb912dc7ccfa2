"""Which images a small map keeps: those that show most of what the others show."""

from dataclasses import replace
from math import sqrt

import numpy as np

from .points import Points
from .selection import Sights

FEW = 0.1  # share of the photos that may learn less than what counts


def thinned(sights: Sights, ranking: np.ndarray, parts: dict[str, int], limit: float) -> Points:
    """Keep as many images of a map as is best for photos like all of them, in a limited file.

    With fewer images there is room for more points, but a photo may be unlike any. Each photo is
    supposed to be matched with the image that shows most of its points; what counts is how much
    nearly all of them learn about their poses.

    Args:
        sights: what the points tell.
        ranking: the points (P,), those that are needed most first.
        parts: the bytes of each part of the file with all points and images.
        limit: of its bytes.

    Returns:
        The same points, of which some may be in no image.
    """
    points = sights.points
    shares = shares_of(points)
    order = ordered(shares)
    per_point = (parts["coordinates"] + parts["descriptors"]) / len(points)
    per_image = (parts["poses"] + parts["retrieval"] + parts["names"]) / len(order)
    per_sight = parts["visible"] / sum(map(len, points.visible))
    others = (
        sum(parts.values()) - parts["visible"] - per_point * len(points) - per_image * len(order)
    )
    best, most, number = points, -np.inf, len(order)
    while number:
        chosen = np.sort(order[:number])
        kept = _only(points, chosen)
        shown = np.bincount(np.concatenate(kept.visible), minlength=len(points))
        seen = ranking[shown[ranking] > 0]
        sizes = others + per_image * number + np.cumsum(per_point + per_sight * shown[seen])
        fitting = seen[: np.searchsorted(sizes, limit)]
        nearest = np.asarray(shares[:, chosen].argmax(axis=1)).ravel()  # (I, 1) before SciPy 1.14
        learned = np.quantile(sights.learned(fitting, chosen[nearest]), FEW)
        if learned >= most:  # with as few images as will do
            best, most = kept, learned
        number = int(number / sqrt(2))
    return best


def _only(points: Points, images: np.ndarray) -> Points:
    """Keep some images (K,), ascending."""
    return replace(
        points,
        names=[points.names[i] for i in images],
        visible=[points.visible[i] for i in images],
        keypoints=[points.keypoints[i] for i in images],
    )


def ordered(shares) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Order images such that each of all shares many of its points with one of the first ones.

    The next one is the one by which the sum of the largest shares grows most (facility location;
    the greedy choice is at least 63 % as good as the best, Nemhauser et al. 1978).

    Args:
        shares: see `shares_of`.

    Returns:
        All images (I,).
    """
    shares = shares.tocsc()
    total = shares.shape[0]
    largest, chosen, gains = np.zeros(total), list[int](), shares.sum(axis=0)
    while len(chosen) < total:
        best = int(gains.argmax())
        begin, end = shares.indptr[best : best + 2]
        others, share = shares.indices[begin:end], shares.data[begin:end]
        gains[best] = np.maximum(share - largest[others], 0).sum()
        if gains.argmax() == best:  # gains only shrink: those that are not computed anew, too
            largest[others] = np.maximum(share, largest[others])
            chosen.append(best)
            gains[best] = -1
    return np.array(chosen)


def shares_of(points: Points):  # type: ignore[no-untyped-def]
    """Return of each image (rows) the share of its points that each image (columns) shows."""
    from scipy.sparse import csr_array

    sizes = np.array([len(part) for part in points.visible])
    shape = len(sizes), len(points)
    ends = np.concatenate([[0], np.cumsum(sizes)])
    shows = csr_array((np.ones(ends[-1]), np.concatenate(points.visible), ends), shape=shape)
    return (shows.multiply(1 / np.maximum(sizes, 1)[:, None]).tocsr() @ shows.T).tocsr()
