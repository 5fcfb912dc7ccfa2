"""Mirrored photos."""

from collections import defaultdict
from collections.abc import Iterable

import numpy as np
import pycolmap

from ...utils.colmap import point3D_ids, visibility
from ..findings import Finding
from ..registration import MIN_VIEWPOINTS
from .inputs import Inputs, Localize

CERTAIN = 0.9, 250.0  # least agreement and confidence of the mirror image of a mirrored photo
TRIED = 3  # photos of a group, which are all mirrored or not


def find(inputs: Inputs) -> list[Finding]:
    """Find the mirrored photos among those of a map, with a pose or without.

    Mirrored photos match others only where the place is symmetric, so a mapper places them anywhere
    or not at all. They share few points with the others, though many among themselves. So a few
    photos of each group that shares few points with the largest one, and all without a pose, are
    localized by that one, as they are and mirrored. If the mirror image fits beyond doubt, with a
    higher confidence, they were mirrored before, or all others were. If there are any, all other
    photos are tried, too. This takes up to as long as the extraction of the photos that are tried,
    and their matching.
    """
    if inputs.localize is None:
        return []
    largest, *others = groups(inputs.images)
    missing = {*(inputs.registration.missing if inputs.registration else ())}
    some = {name for group in others for name in group[:TRIED]}
    found = mirrored(inputs.localize, some | missing, {*largest})
    if found:
        placed = {*inputs.names}
        found |= mirrored(inputs.localize, (placed | missing) - found, placed - found)
    return [finding(sorted(found))] if found else []


def finding(names: Iterable[str]) -> Finding:
    """Return the finding for mirrored photos."""
    text = (
        "Mirrored photos do not belong in the map: {names}. Their mirror images fit the other "
        "photos. Either these were mirrored, or all others: use photos as the camera took them."
    )
    return Finding("mirrored", text, tuple(names), {}, "drop", "mirrored photos")


def mirrored(localize: Localize, names: set[str], by: set[str]) -> set[str]:
    """Return the mirrored ones of some photos, each of which is localized by some others."""
    if len(by) < MIN_VIEWPOINTS or not names:
        return set()
    of_mirrored = localize(names, by, True)
    if not of_mirrored:
        return set()
    as_they_are = localize(names, by, False)
    agreement, confidence = CERTAIN
    return {
        name
        for name, one in of_mirrored.items()
        if one["confidence"] > as_they_are[name]["confidence"]
        and one["agreement"] >= agreement
        and one["confidence"] >= confidence
    }


def groups(images: list[pycolmap.Image]) -> list[list[str]]:
    """Return the names of photos in groups that share many points, the largest one first.

    Photos show the same part of a place if they share half as many points as the median number
    that a photo of the map has. In a group, those with the most points come first.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    shows = visibility(map(point3D_ids, images)).sign()
    shared = (shows @ shows.T).tocoo()
    numbers = shared.diagonal()
    many = 2 * shared.data >= np.median(numbers)
    pairs = shared.row[many], shared.col[many]
    _, group = connected_components(coo_array((shared.data[many], pairs), shared.shape))
    found = defaultdict[int, list[str]](list)
    for i in np.argsort(-numbers, kind="stable"):
        found[group[i]].append(images[i].name)
    return sorted(found.values(), key=len, reverse=True)
