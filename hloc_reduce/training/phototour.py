"""UBC PhotoTour patches as training data."""

from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from .. import stamps
from ..descriptors import DIM, Descriptor
from ..phototour import SHEET, read_points, read_sheet, sheets
from .loop import device
from .tracks import VARIANTS, describe_mirrored, photometric_variant, save, stamp


def main(folder: Path, output: Path, descriptor: str = "sift", seed: int = 0) -> Path:
    """Describe the patches of a sequence, labelled by point.

    Args:
        folder: the sequence.
        output: folder for the file; one that is there already, made from the same, is used.
        descriptor: the base descriptor.
        seed: of the photometric variants.

    Returns:
        The file of `tracks.load`; every patch counts as an image of its own.

    Raises:
        InputError: when the folder is not a sequence.
    """
    path = output / f"tracks_{descriptor}.safetensors"
    points = read_points(folder)
    made_from = stamp(descriptor, seed, [folder / "info.txt", *sheets(folder)])
    if path.exists() and stamps.is_current(path.with_suffix(".json"), made_from):
        return path
    output.mkdir(parents=True, exist_ok=True)
    describe = Descriptor(descriptor).to(device())
    described = np.empty((len(points), 2, VARIANTS, DIM), np.float16)
    for number, sheet in enumerate(tqdm(sheets(folder), desc="Describing patches", unit="sheet")):
        first = number * SHEET**2
        patches = read_sheet(sheet)[: len(points) - first]
        generator = np.random.default_rng([seed, number])
        rows = slice(first, first + len(patches))
        for variant in range(VARIANTS):
            views = patches
            if variant:
                views = np.stack([photometric_variant(patch, generator) for patch in patches])
            views = torch.from_numpy(views)[:, None]
            described[rows, :, variant] = describe_mirrored(views, describe)
    no_places = np.zeros((len(points), 2), np.float32)
    return save(
        path,
        made_from,
        described,
        points,
        image=np.arange(len(points)),
        xy=no_places,
        matched=np.ones(len(points), bool),
    )
