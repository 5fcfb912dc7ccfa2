"""Groups of photos of a map that contradict each other."""

from collections.abc import Callable

import numpy as np

MAX_GROUPED_PHOTOS = 300  # any two groups of as many photos are compared


def contradicting(
    common: np.ndarray,
    expected: np.ndarray,
    share: float,
    enough: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
    apart: float = 0.0,
    compared: np.ndarray | None = None,
) -> list[int]:
    """Return the smaller one of the two groups of photos that contradict each other most.

    Groups are built by what their photos have in common, as by average linkage, and compared where
    two of them are joined: they contradict each other if they have less in common than `share` of
    what is expected. If none do, any other two groups do that have less than `apart`, in sets of up
    to `MAX_GROUPED_PHOTOS`.

    Args:
        common: (N, N) what each pair of photos has in common, symmetric.
        expected: (N, N) what it is expected to have, symmetric.
        share: two groups contradict each other if they have less in common than this share of what
            is expected.
        enough: whether sums of what is expected of two groups are evidence, given also the number
            of compared pairs of photos between them, and the size of the smaller one: of arrays.
        apart: the same for groups that are not joined to each other, in sets of up to
            `MAX_GROUPED_PHOTOS`.
        compared: (N, N) bool, symmetric, the pairs of photos that are evidence; default: all.

    Returns:
        Indices of the group; none if no groups contradict each other.
    """
    from scipy.cluster.hierarchy import average
    from scipy.spatial.distance import squareform

    number = len(common)
    if number < 2:
        return []
    compared = np.ones((number, number)) if compared is None else compared.astype(float)
    distance = common.max() - common
    np.fill_diagonal(distance, 0)
    linkage = average(squareform(distance, checks=False))
    joined = linkage[:, :2].astype(int)
    sizes = np.concatenate([np.ones(number), linkage[:, 3]])

    def shares_of(
        pairs: np.ndarray, sums: np.ndarray, wanted: np.ndarray, between: np.ndarray
    ) -> np.ndarray:
        """Return what pairs of groups (P, 2) share of what is expected, inf without evidence."""
        evident = (wanted > 0) & enough(wanted, between, sizes[pairs].min(axis=1))
        return np.divide(sums, wanted, out=np.full_like(sums, np.inf), where=evident)

    # not what others have in common
    counted = common * compared, expected * compared, compared
    pairs, totals = joined, [_sums(values, joined) for values in counted]
    shares = shares_of(pairs, *totals)
    worst = shares.argmin()
    if shares[worst] >= share and apart > 0 and number <= MAX_GROUPED_PHOTOS:
        belongs = np.zeros((len(sizes), number))  # photos to groups
        for group in range(len(sizes)):
            belongs[group, _members(group, joined)] = 1
        pairs = np.argwhere(np.triu(belongs @ belongs.T == 0))
        totals = [(belongs @ values @ belongs.T)[tuple(pairs.T)] for values in counted]
        shares = shares_of(pairs, *totals)
        share, worst = apart, np.where(shares < apart, totals[1], 0).argmax()
    if shares[worst] >= share:
        return []
    return sorted(_members(min(pairs[worst][::-1], key=sizes.__getitem__), joined))


def _sums(values: np.ndarray, joined: np.ndarray) -> np.ndarray:
    """Return the sums (N - 1,) of values (N, N), symmetric, between the groups that are joined."""
    number = len(values)
    between, row = values.copy(), np.arange(2 * number - 1)  # of each group its row in `between`
    sums = np.empty(len(joined))
    for new, (first, second) in enumerate(joined):
        i, j = row[first], row[second]
        sums[new] = between[i, j]
        between[i] += between[j]
        between[:, i] = between[i]
        row[number + new] = i
    return sums


def _members(group: int, joined: np.ndarray) -> list[int]:
    """Return the photos of a group: of one photo, or of two groups that are joined (N - 1, 2)."""
    number, members, groups = len(joined) + 1, [], [group]
    while groups:
        if (other := int(groups.pop())) < number:
            members.append(other)
        else:
            groups += joined[other - number].tolist()
    return members
