"""Photos whose poses contradict their matches."""

import numpy as np

from ..epipolar import MIN_VERIFIED_MATCHES, agreeing
from ..findings import Finding
from . import groups
from .inputs import Inputs


def find(inputs: Inputs) -> list[Finding]:
    """Find the images most of whose verified matches are far from their epipolar lines.

    A mapper may place an image, or a group of images, by a few wrong matches, in spite of all the
    other ones. Those are then far from their epipolar lines. The image that contradicts its matches
    most is taken away, or, if none does, the smaller one of two groups whose matches with each
    other do; and so on with the others. Photos that a rig took at one moment count as one.
    """
    if inputs.verified is None:
        return []
    images, frames = inputs.images, inputs.frames
    row = {image.name: frame for image, frame in zip(images, frames, strict=True)}
    agree, number = np.zeros((2, *[frames.max(initial=-1) + 1] * 2))
    evidence = {
        pair: rows for pair, rows in inputs.verified.items() if len(rows) >= MIN_VERIFIED_MATCHES
    }
    for (name0, name1), valid in agreeing(images, inputs.keypoints, evidence).items():
        i, j = row[name0], row[name1]
        if i != j:
            agree[[i, j], [j, i]] += valid.sum()
            number[[i, j], [j, i]] += len(valid)
    left = np.arange(len(agree))
    while len(left) and (found := _worst(agree[np.ix_(left, left)], number[np.ix_(left, left)])):
        left = np.delete(left, found)
    names = sorted(name for name, frame in row.items() if frame not in left)
    if not names:
        return []
    text = (
        "Most matches of these photos contradict the poses that COLMAP found: {names}. Add photos "
        "between those in the map and these."
    )
    doubt = "photos whose matches contradict their poses"
    return [Finding("misplaced", text, tuple(names), {}, "drop", doubt)]


def _worst(agree: np.ndarray, number: np.ndarray) -> list[int]:
    """Return the image, or else the group, of (N, N) matches of which fewer than half agree."""
    of_each = number.sum(axis=1)
    shares = np.divide(agree.sum(axis=1), of_each, out=np.ones(len(agree)), where=of_each > 0)
    if shares.min() < 0.5:
        return [int(shares.argmin())]
    return groups.contradicting(
        agree, number, 0.5, lambda wanted, *_: wanted >= MIN_VERIFIED_MATCHES
    )
