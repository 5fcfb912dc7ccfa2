"""Tracks of UBC PhotoTour patches."""

from pathlib import Path

import numpy as np
import torch

from ..datasets.phototour import PATCHES_PER_SIDE, read_points, read_sheet, sheets
from ..descriptors import DIM
from ..descriptors.model import Descriptor
from ..runtime.group_writer import resume_or_replace
from ..utils.paths import strings_as_paths
from ..utils.progress import progress
from .describers import VARIANTS, describe_mirrored, photometric_variant
from .loop import device
from .tracks import is_current, parts_of, provenance_of, save


@strings_as_paths
def main(folder: Path, output: Path, descriptor: str = "sift", seed: int = 0) -> Path:
    """Describe the patches of a sequence, labelled by point.

    Args:
        folder: the sequence.
        output: folder for the file, which is used again unless it is stale.
        descriptor: the base descriptor.
        seed: of the photometric variants.

    Returns:
        The file for `tracks.load`; every patch counts as an image of its own.

    Raises:
        InputError: when the folder is not a sequence.
    """
    path = output / f"tracks_{descriptor}.safetensors"
    points = read_points(folder)
    made_from = provenance_of(descriptor, seed, [folder / "info.txt", *sheets(folder)])
    if is_current(path, made_from):
        return path
    describe = Descriptor(descriptor).to(device())
    files = sheets(folder)[: -(-len(points) // PATCHES_PER_SIDE**2)]  # those with listed patches
    with resume_or_replace(parts_of(path), made_from) as writer:
        todo = [number for number, sheet in enumerate(files) if sheet.stem not in writer]
        done = len(files) - len(todo)
        for number in progress(todo, "Describing patches", "sheet", len(files), done):
            rows = np.arange(len(points))[
                number * PATCHES_PER_SIDE**2 : (number + 1) * PATCHES_PER_SIDE**2
            ]
            patches = views = read_sheet(files[number])[: len(rows)]
            generator = np.random.default_rng([seed, number])
            described = np.empty((len(rows), 2, VARIANTS, DIM), np.float16)
            for variant in range(VARIANTS):
                if variant:
                    views = np.stack([photometric_variant(patch, generator) for patch in patches])
                described[:, :, variant] = describe_mirrored(
                    torch.from_numpy(views)[:, None], describe
                )
            arrays = {
                "descriptors": described,
                "points": points[rows],
                "image": rows,
                "xy": np.zeros((len(rows), 2), np.float32),
                "matched": np.ones(len(rows), bool),
            }
            writer.add(files[number].stem, arrays)
    return save(path, made_from, [sheet.stem for sheet in files])
