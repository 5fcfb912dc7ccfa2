"""HPatches' sequences of patches in their published layout, and descriptors of them."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
import torch

from ...descriptors import PATCH_SIZE
from ...utils import cli
from ...utils.cli import InputError
from ...utils.h5 import get_dataset, open_h5
from ...utils.images import read_image
from ...utils.progress import progress
from ..patches import describe_patches

PATCH_PIXELS = 65
NOISE_LEVELS = {"e": "easy", "h": "hard", "t": "tough"}
IMAGE_NUMBERS = range(1, 6)
PATCH_TYPES = ("ref", *(f"{noise}{image}" for noise in NOISE_LEVELS for image in IMAGE_NUMBERS))
# splits that need no splits.json -> how the names of their sequences begin
WHOLE_SPLITS = {"full": ("i_", "v_"), "illum": ("i_",), "view": ("v_",)}
SPLITS = ("a", "b", "c", *WHOLE_SPLITS)
REPOSITORY = "https://github.com/hpatches/hpatches-benchmark"


def test_sequences(root: Path, tasks: Path, split: str) -> list[str]:
    """List the test sequences of a split.

    Args:
        root: the folder of the sequences.
        tasks: the benchmark's folder of lists, which has splits.json; without it there are only
            the splits of `WHOLE_SPLITS`.
        split: one of `SPLITS`.

    Raises:
        InputError: when splits.json is needed and missing or broken, or sequences are missing.
    """
    cli.choose("split", split, SPLITS)
    places = (tasks / "splits.json", tasks / "splits/splits.json", root / "splits.json")
    file = next((path for path in places if path.is_file()), None)
    present = {path.parent.name for path in root.glob("*/ref.png")}
    if not present:
        raise InputError(f"{root} has no sequence: <sequence>/ref.png (HPatches, {REPOSITORY}).")
    if file is not None:
        try:
            names = list(map(str, json.loads(file.read_text())[split]["test"]))
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            raise InputError(f"{file} is broken or has no split {split}.") from None
    elif split in WHOLE_SPLITS:
        names = sorted(name for name in present if name.startswith(WHOLE_SPLITS[split]))
    else:
        raise InputError(f"There is no {places[0]}: give the tasks folder of {REPOSITORY}.")
    missing = [name for name in names if name not in present]
    if missing or not names:
        raise InputError(
            f"{root} lacks {len(missing)} of the {len(names)} sequences of split {split}: "
            f"{cli.some(missing)}."
        )
    return names


def read_patches(path: Path) -> np.ndarray:
    """Read the patches (N, 65, 65) uint8 of an image.

    Raises:
        InputError: when the image is not a column of such patches.
    """
    image = read_image(path, grayscale=True)
    if image.shape[1] != PATCH_PIXELS or len(image) % PATCH_PIXELS:
        raise InputError(
            f"{path} is not a column of patches of {PATCH_PIXELS} x {PATCH_PIXELS} pixels."
        )
    return image.reshape(-1, PATCH_PIXELS, PATCH_PIXELS)


def describe(root: Path, sequences: list[str], descriptor: str, path: Path) -> None:
    """Describe the patches of sequences, resized to 32 x 32 pixels as the paper's authors do.

    Args:
        root: the folder of the sequences.
        sequences: names; sequences that the file already has are skipped.
        descriptor: the base descriptor.
        path: the h5 file: for each sequence (N, 128) float32 of each of `PATCH_TYPES`.

    Raises:
        InputError: for a broken sequence.
    """

    def read(name: str) -> Iterator[tuple[str, np.ndarray]]:
        number = None
        for kind in PATCH_TYPES:
            large = read_patches(root / name / f"{kind}.png")
            if number not in (None, len(large)):
                raise InputError(f"{root / name}: its images have different numbers of patches.")
            number = len(large)
            small = np.stack([cv2.resize(patch, (PATCH_SIZE, PATCH_SIZE)) for patch in large])
            yield kind, small.astype(np.float32) / 255

    conf = {"root": str(root.resolve())}
    describe_patches(path, conf, descriptor, sequences, read, "sequence")


def first_patches(sizes: Mapping[str, int]) -> dict[str, int]:
    """Return the number of the first patch of each sequence, given how many patches each has."""
    ends = np.cumsum(list(sizes.values())).tolist()
    return {name: end - sizes[name] for name, end in zip(sizes, ends, strict=True)}


class Descriptors:
    """The projected descriptors of a split, whose patches are numbered across all sequences.

    Args:
        path: file of `describe`.
        sequences: the sequences of the split.
        project: maps (N, 128) to (N, D).

    Attributes:
        sizes: the number of patches of each sequence.
        sequence: (T,) the number of the sequence of each patch.
    """

    def __init__(self, path: Path, sequences: list[str], project: torch.nn.Module):
        parts: dict[str, list[np.ndarray]] = {kind: [] for kind in PATCH_TYPES}
        with open_h5(path) as file, torch.no_grad():
            for name in progress(sequences, "Projecting", "sequence"):
                for kind in PATCH_TYPES:
                    rows = torch.from_numpy(get_dataset(file, name, kind)[()])
                    parts[kind].append(project(rows).numpy())
        self._of_type = {kind: np.concatenate(part) for kind, part in parts.items()}
        self.sizes = {name: len(rows) for name, rows in zip(sequences, parts["ref"], strict=True)}
        self._first = first_patches(self.sizes)
        self.sequence = np.repeat(np.arange(len(sequences)), list(self.sizes.values()))

    def of(self, sequence: str, kind: str) -> np.ndarray:
        """Return the descriptors (N, D) float32 of an image of a sequence, one of `PATCH_TYPES`."""
        first = self._first[sequence]
        return self._of_type[kind][first : first + self.sizes[sequence]]

    def rows(self, patches: np.ndarray, kind: str) -> np.ndarray:
        """Return the descriptors (N, D) of numbered patches of one of `PATCH_TYPES`."""
        return self._of_type[kind][patches]

    def rows_of_images(self, patches: np.ndarray, images: np.ndarray, noise: str) -> np.ndarray:
        """Return the descriptors (N, D) of numbered patches in images 0 (reference) to 5."""
        rows = np.empty((len(patches), self._of_type["ref"].shape[1]), np.float32)
        for image in np.unique(images):
            chosen = images == image
            kind = f"{noise}{image}" if image else "ref"
            rows[chosen] = self.rows(patches[chosen], kind)
        return rows
