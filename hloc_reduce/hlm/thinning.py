"""Which images a small map keeps: those that show most of what the others show."""

from dataclasses import replace

import numpy as np

from .points import Points


def thinned(points: Points, number: int) -> Points:
    """Keep some images, such that each of the others shares many of its points with one of them.

    The next one is the one by which the sum of the largest shares grows most (facility location;
    the greedy choice is at least 63 % as good as the best, Nemhauser et al. 1978).

    Args:
        points: of a map.
        number: of images, at least 1.

    Returns:
        The same points, of which some may be in no image.
    """
    total = len(points.names)
    if number >= total:
        return points
    shares = _shares(points)
    largest, chosen, gains = np.zeros(total), list[int](), shares.sum(axis=0)
    while len(chosen) < number:
        best = int(gains.argmax())
        begin, end = shares.indptr[best : best + 2]
        others, share = shares.indices[begin:end], shares.data[begin:end]
        gains[best] = np.maximum(share - largest[others], 0).sum()
        if gains.argmax() == best:  # gains only shrink: those that are not computed anew, too
            largest[others] = np.maximum(share, largest[others])
            chosen.append(best)
            gains[best] = -1
    kept = sorted(chosen)
    return replace(
        points,
        names=[points.names[i] for i in kept],
        visible=[points.visible[i] for i in kept],
        keypoints=[points.keypoints[i] for i in kept],
    )


def _shares(points: Points):  # type: ignore[no-untyped-def]
    """Return of each image (rows) the share of its points that each image (columns) shows."""
    from scipy.sparse import csr_array

    sizes = np.array([len(part) for part in points.visible])
    shape = len(sizes), len(points)
    ends = np.concatenate([[0], np.cumsum(sizes)])
    shows = csr_array((np.ones(ends[-1]), np.concatenate(points.visible), ends), shape=shape)
    return (shows.multiply(1 / np.maximum(sizes, 1)[:, None]).tocsr() @ shows.T).tocsc()
