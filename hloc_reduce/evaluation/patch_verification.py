"""Patch verification on PhotoTour."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import torch

from ..datasets.phototour import PATCHES_PER_SIDE, read_pairs, read_points, read_sheet, sheets
from ..utils.cli import InputError
from ..utils.h5 import get_dataset, open_h5
from ..utils.paths import strings_as_paths
from .patches import describe_patches


@strings_as_paths
def main(
    folder: Path, outputs: Path, descriptor: str, projects: Mapping[str, torch.nn.Module]
) -> dict[str, float]:
    """Verify the listed pairs of a sequence by the distances between their descriptors.

    Args:
        folder: the sequence.
        outputs: folder for the descriptors of its patches.
        descriptor: the base descriptor.
        projects: projections by name, modules that map (N, 128) to (N, D).

    Returns:
        From name to `fpr95`.

    Raises:
        InputError: when the sequence is missing or broken.
    """
    pairs, matches = read_pairs(folder)
    number = len(read_points(folder))
    if pairs.min() < 0 or pairs.max() >= number:
        raise InputError(f"{folder}: the pairs name patches that info.txt does not have.")
    listed, rows = np.unique(pairs, return_inverse=True)
    path = outputs / f"descriptors_{descriptor}.h5"
    described = torch.from_numpy(_describe(folder, path, descriptor, listed))
    first, second = rows.reshape(pairs.shape).T
    found = {}
    for name, project in projects.items():
        with torch.no_grad():
            projected = torch.cat([project(part) for part in described.split(2**16)])
        found[name] = fpr95((projected[first] - projected[second]).norm(dim=1).numpy(), matches)
    return found


def _describe(folder: Path, path: Path, descriptor: str, patches: np.ndarray) -> np.ndarray:
    """Return the descriptors (N, 128) float32 of numbered patches, ascending (N,)."""
    files = {file.stem: file for file in sheets(folder)}
    names = list(files)
    sheet, row = np.divmod(patches, PATCHES_PER_SIDE**2)
    used = np.unique(sheet)

    def read(name: str) -> Iterator[tuple[str, np.ndarray]]:
        yield "descriptors", read_sheet(files[name])

    conf = {"folder": str(folder.resolve())}
    describe_patches(path, conf, descriptor, [names[i] for i in used], read, "sheet")
    with open_h5(path) as file:
        parts = [get_dataset(file, names[i], "descriptors")[()][row[sheet == i]] for i in used]
    return np.concatenate(parts)


def fpr95(distances: np.ndarray, matches: np.ndarray) -> float:
    """Compute the false positive rate at 95 % recall.

    Args:
        distances: (P,) of pairs.
        matches: (P,) bool, whether the two patches show the same point.

    Returns:
        The share in [0, 1] of pairs that do not match within the smallest distance that accepts
        95 % of the matching pairs.

    Raises:
        ValueError: when there are only matching pairs, or none.
    """
    if matches.all() or not matches.any():
        raise ValueError("Both matching and other pairs are needed.")
    positive = np.sort(distances[matches])
    threshold = positive[int(np.ceil(0.95 * len(positive))) - 1]
    return float((distances[~matches] <= threshold).mean())
