"""How descriptors of COLMAP's SIFT are normalized, and how to make them those of `colmap_sift`."""

from collections.abc import Callable
from typing import Annotated

import numpy as np

from ..utils.cli import InputError, choose
from ..utils.options import Option

# measured in photos of ten places, dark and blurred ones too: the share of zeros is 4 to 21 %
# except in hloc's descriptors, whose numbers are at least 0.001 before the last rounding; mean
# sums are 5.7 to 7.1 for L2, 7.6 to 9.1 for L1_ROOT
FEW_ZEROS = 1e-3
SUMS = 7.2, 7.5  # below the first one L2, above the second one L1_ROOT


def _root(descriptors: np.ndarray) -> np.ndarray:
    return np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12))


# COLMAP's names, and hloc's for what its extractor `dog` makes of L1_ROOT, which takes roots again;
# each with what turns descriptors (N, 128) into those of L1_ROOT, up to their norms
NORMALIZATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "L1_ROOT": lambda descriptors: descriptors,
    "L2": _root,
    "rootsift": np.square,
}
Normalization = Annotated[
    str, Option("normalization", NORMALIZATIONS, "COLMAP's names, and rootsift for hloc's")
]


def detect(descriptors: np.ndarray) -> str:
    """Tell by which of `NORMALIZATIONS` descriptors of COLMAP's SIFT are normalized.

    Args:
        descriptors: (N, 128) float32 of several images, of unit norm.

    Raises:
        InputError: when they are not descriptors of SIFT, or may be of either.
    """
    number, dim = descriptors.shape
    if dim != 128 or not number or (descriptors < 0).any():
        found = "numbers below 0" if dim == 128 else f"{dim} numbers"
        given = f"these have {found}" if number else "there are none"
        raise InputError(f"SIFT descriptors are 128 numbers of at least 0; {given}.")
    if (descriptors == 0).mean() < FEW_ZEROS:
        return "rootsift"
    mean = descriptors.sum(axis=1).mean()
    if SUMS[0] < mean < SUMS[1]:
        raise InputError("They may be L2 or L1_ROOT descriptors: say which by --normalization.")
    return "L2" if mean < SUMS[1] else "L1_ROOT"


def to_colmap_sift(descriptors: np.ndarray, normalization: str) -> np.ndarray:
    """Turn descriptors of COLMAP's SIFT into those of `colmap_sift`: L1_ROOT, of unit norm.

    Args:
        descriptors: (N, 128) float32.
        normalization: theirs, a key of `NORMALIZATIONS`.

    Raises:
        InputError: for an unknown normalization.
    """
    convert = NORMALIZATIONS[choose("normalization", normalization, NORMALIZATIONS)]
    found = convert(descriptors)
    norm = np.linalg.norm(found, axis=1, keepdims=True)
    return (found / np.maximum(norm, 1e-12)).astype(np.float32)
