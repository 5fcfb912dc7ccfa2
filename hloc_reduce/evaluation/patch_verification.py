"""Patch verification on PhotoTour."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from ..datasets.phototour import SHEET, read_pairs, read_points, read_sheet, sheets
from ..descriptors.model import Descriptor
from ..runtime import parallel
from ..runtime.group_writer import GroupWriter
from ..utils.cli import InputError
from ..utils.h5 import get_dataset, open_h5
from ..utils.paths import strings_as_paths
from ..utils.progress import progress


def fpr95(distances: np.ndarray, matches: np.ndarray) -> float:
    """Compute the false positive rate at 95 % recall.

    Args:
        distances: (P,) of the pairs.
        matches: (P,) bool, which of them show the same point.

    Returns:
        The share in [0, 1] of the pairs that do not match but are at most as far as the distance
        within which 95 % of the matching ones are.

    Raises:
        ValueError: when there are no matching pairs or no others.
    """
    if matches.all() or not matches.any():
        raise ValueError("Both matching and other pairs are needed.")
    positive = np.sort(distances[matches])
    threshold = positive[int(np.ceil(0.95 * len(positive))) - 1]
    return float((distances[~matches] <= threshold).mean())


@strings_as_paths
def main(
    folder: Path, outputs: Path, descriptor: str, projects: Mapping[str, torch.nn.Module]
) -> dict[str, float]:
    """Verify the listed pairs of a sequence by the distance of their projected descriptors.

    Args:
        folder: the sequence.
        outputs: folder for the descriptors of its patches.
        descriptor: the base descriptor.
        projects: by name, what maps (N, 128) to (N, D).

    Returns:
        The `fpr95` of each.

    Raises:
        InputError: when the sequence is not there or broken.
    """
    pairs, matches = read_pairs(folder)
    number = len(read_points(folder))
    if pairs.min() < 0 or pairs.max() >= number:
        raise InputError(f"{folder}: the pairs name patches that info.txt does not have.")
    listed, rows = np.unique(pairs, return_inverse=True)
    described = torch.from_numpy(
        _describe(folder, outputs / f"descriptors_{descriptor}.h5", descriptor, listed)
    )
    first, second = rows.reshape(pairs.shape).T
    found = {}
    for name, project in projects.items():
        with torch.no_grad():
            projected = torch.cat([project(part) for part in described.split(2**16)])
        found[name] = fpr95((projected[first] - projected[second]).norm(dim=1).numpy(), matches)
    return found


def _describe(folder: Path, path: Path, descriptor: str, patches: np.ndarray) -> np.ndarray:
    """Return the descriptors (N, 128) float32 of numbered patches, kept by sheets in a file."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    describe = Descriptor(descriptor).to(device)
    files = {file.stem: file for file in sheets(folder)}
    names = list(files)

    def describe_sheet(name: str) -> tuple[str, np.ndarray]:
        batch = torch.from_numpy(read_sheet(files[name]))[:, None].to(device)
        return name, describe(batch).cpu().numpy()

    conf = {"descriptor": descriptor, "folder": str(folder.resolve())}
    with GroupWriter(path, conf) as writer:
        todo = [names[i] for i in np.unique(patches // SHEET**2) if names[i] not in writer]
        done = parallel.ordered(
            "describe", describe_sheet, todo, workers=None if device == "cpu" else 1
        )
        shown = progress(done, f"Describing by {descriptor}", "sheet", len(todo))
        for name, rows in shown:
            writer.add(name, {"descriptors": rows})
    sheet, row = np.divmod(patches, SHEET**2)
    with open_h5(path) as file:
        return np.concatenate(
            [
                get_dataset(file, names[i], "descriptors")[()][row[sheet == i]]
                for i in np.unique(sheet)
            ]
        )
