"""Groups of photos of a map that contradict each other."""

from collections.abc import Callable

import numpy as np


def contradicting(
    common: np.ndarray,
    expected: np.ndarray,
    share: float,
    enough: Callable[[float, int, int], bool],
) -> list[int]:
    """Return the smaller one of the two groups of photos that contradict each other most.

    Groups are built by what their photos have in common, as by average linkage, and compared where
    two of them are joined: they contradict each other if they have less in common than `share` of
    what is expected.

    Args:
        common: (N, N) what each pair of photos has in common, symmetric.
        expected: (N, N) what it is expected to have, symmetric.
        share: see above.
        enough: whether the sum of what is expected of two groups, of these sizes, is evidence.

    Returns:
        Indices of the group; none if no groups contradict each other.
    """
    from scipy.cluster.hierarchy import average
    from scipy.spatial.distance import squareform

    number = len(common)
    if number < 2:
        return []
    distance = common.max() - common
    np.fill_diagonal(distance, 0)
    groups = {i: [i] for i in range(number)}
    sums = np.zeros((2, 2 * number, 2 * number))
    sums[:, :number, :number] = common, expected
    worst, found = share, list[int]()
    joined = average(squareform(distance, checks=False))[:, :2].astype(int)
    for new, (a, b) in enumerate(joined.tolist(), number):
        first, second = groups.pop(a), groups.pop(b)
        shared, wanted = sums[:, a, b].tolist()
        if enough(wanted, len(first), len(second)) and shared < worst * wanted:
            worst, found = shared / wanted, min(second, first, key=len)
        groups[new] = first + second
        sums[:, new] = sums[:, a] + sums[:, b]
        sums[:, :, new] = sums[:, :, a] + sums[:, :, b]
    return found
