"""Mirrored photos."""

from collections.abc import Iterable

import numpy as np
import pycolmap

from ...utils.colmap import point3D_ids, visibility
from ..findings import Finding
from ..registration import MIN_VIEWPOINTS
from .inputs import Inputs, Localize

CERTAIN = 0.9, 250.0  # least agreement and confidence of the mirror image of a mirrored photo


def find(inputs: Inputs) -> list[Finding]:
    """Find the mirrored photos among those of a map, with a pose or without.

    Mirrored photos match others only where the place is symmetric, so a mapper places them anywhere
    or not at all. They share few points with the others, though many among themselves. So photos
    that share few points with most others, and those without a pose, are localized by the others,
    as they are and mirrored. If the mirror image fits beyond doubt, with a higher confidence, they
    were mirrored before, or all others were. If there are any, all other photos are tried, too.
    This takes up to as long as the extraction of the photos that are tried, and their matching.
    """
    if inputs.localize is None:
        return []
    placed, sound = {*inputs.names}, largest_group(inputs.images)
    names = placed | {*(inputs.registration.missing if inputs.registration else ())}
    found = mirrored(inputs.localize, names - sound, sound)
    if found:
        found |= mirrored(inputs.localize, names - found, placed - found)
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


def largest_group(images: list[pycolmap.Image]) -> set[str]:
    """Return the names of the largest group of photos that share many points.

    Photos show the same part of a place if they share half as many points as the median number
    that a photo of the map has.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    shows = visibility(map(point3D_ids, images)).sign()
    shared = (shows @ shows.T).tocoo()
    many = 2 * shared.data >= np.median(shared.diagonal())
    pairs = shared.row[many], shared.col[many]
    _, group = connected_components(coo_array((shared.data[many], pairs), shared.shape))
    largest = np.bincount(group).argmax()
    return {image.name for image, its in zip(images, group, strict=True) if its == largest}
