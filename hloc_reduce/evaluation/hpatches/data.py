"""HPatches' sequences of patches in their published layout, and descriptors of them."""

import json
from pathlib import Path

import cv2
import numpy as np
import torch

from ...descriptors import PATCH_SIZE
from ...descriptors.model import Descriptor
from ...runtime import parallel
from ...runtime.group_writer import GroupWriter
from ...utils import cli
from ...utils.cli import InputError
from ...utils.h5 import get_dataset, open_h5
from ...utils.images import read_image
from ...utils.progress import progress

SIDE = 65
NOISE = {"e": "easy", "h": "hard", "t": "tough"}
IMAGES = range(1, 6)
TYPES = ("ref", *(f"{noise}{image}" for noise in NOISE for image in IMAGES))
WHOLE = {"full": ("i_", "v_"), "illum": ("i_",), "view": ("v_",)}  # splits known by their names
SPLITS = ("a", "b", "c", *WHOLE)
SOURCE = "https://github.com/hpatches/hpatches-benchmark"


def test_sequences(root: Path, tasks: Path, split: str) -> list[str]:
    """List the sequences that a split tests on.

    Args:
        root: the folder of the sequences.
        tasks: the folder of the benchmark's lists, which has splits.json; without it only the
            splits of all sequences, and of those with changes of illumination or viewpoint.
        split: one of `SPLITS`.

    Raises:
        InputError: when splits.json is needed and missing or broken, or sequences are missing.
    """
    cli.choose("split", split, SPLITS)
    places = (tasks / "splits.json", tasks / "splits/splits.json", root / "splits.json")
    file = next((path for path in places if path.is_file()), None)
    there = {path.parent.name for path in root.glob("*/ref.png")}
    if not there:
        raise InputError(f"{root} has no sequence: <sequence>/ref.png (HPatches, {SOURCE}).")
    if file is not None:
        try:
            names = list(map(str, json.loads(file.read_text())[split]["test"]))
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            raise InputError(f"{file} is broken or has no split {split}.") from None
    elif split in WHOLE:
        names = sorted(name for name in there if name.startswith(WHOLE[split]))
    else:
        raise InputError(f"There is no {places[0]}: give the tasks folder of {SOURCE}.")
    missing = [name for name in names if name not in there]
    if missing or not names:
        raise InputError(
            f"{root} lacks {len(missing)} of the {len(names)} sequences of split {split}: "
            f"{cli.some(missing)}."
        )
    return names


def read_patches(path: Path) -> np.ndarray:
    """Read the patches (N, 65, 65) uint8 of an image.

    Raises:
        InputError: when it is none.
    """
    image = read_image(path, grayscale=True)
    if image.shape[1] != SIDE or len(image) % SIDE:
        raise InputError(f"{path} is not a column of patches of {SIDE} x {SIDE} pixels.")
    return image.reshape(-1, SIDE, SIDE)


def describe(root: Path, sequences: list[str], descriptor: str, path: Path) -> None:
    """Describe the patches of sequences, resized to 32 x 32 pixels as the paper's authors do.

    Args:
        root: the folder of the sequences.
        sequences: names; those that the file has are skipped.
        descriptor: the base descriptor.
        path: the h5 file, a group for each sequence with (N, 128) float32 of each of `TYPES`.

    Raises:
        InputError: for a broken sequence.
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    describe_patches = Descriptor(descriptor).to(device)

    def describe_sequence(name: str) -> tuple[str, dict[str, np.ndarray]]:
        described = {}
        for kind in TYPES:
            patches = read_patches(root / name / f"{kind}.png")
            small = np.stack([cv2.resize(patch, (PATCH_SIZE, PATCH_SIZE)) for patch in patches])
            batch = torch.from_numpy(small.astype(np.float32) / 255)[:, None]
            described[kind] = describe_patches(batch.to(device)).cpu().numpy()
        if len({len(rows) for rows in described.values()}) > 1:
            raise InputError(f"{root / name}: its images have different numbers of patches.")
        return name, described

    with GroupWriter(path, {"descriptor": descriptor, "root": str(root.resolve())}) as writer:
        todo = [name for name in sequences if name not in writer]
        workers = None if device == "cpu" else 1
        done = parallel.ordered("describe", describe_sequence, todo, workers)
        for name, described in progress(done, f"Describing by {descriptor}", "sequence", len(todo)):
            writer.add(name, described)


class Descriptors:
    """The descriptors of a split, projected.

    Patches are numbered through, sequence by sequence.

    Args:
        path: file of `describe`.
        sequences: those of the split.
        project: maps (N, 128) to (N, D).

    Attributes:
        first: from sequence to the number of its first patch.
        sizes: how many patches each sequence has.
        sequence: (T,) of each patch the number of its sequence.
    """

    def __init__(self, path: Path, sequences: list[str], project: torch.nn.Module):
        parts = {kind: [] for kind in TYPES}
        with open_h5(path) as file, torch.no_grad():
            for name in progress(sequences, "Projecting", "sequence"):
                for kind in TYPES:
                    rows = torch.from_numpy(get_dataset(file, name, kind)[()])
                    parts[kind].append(project(rows).numpy())
        self._of = {kind: np.concatenate(part) for kind, part in parts.items()}
        self.sizes = {name: len(rows) for name, rows in zip(sequences, parts["ref"], strict=True)}
        sizes = np.array(list(self.sizes.values()))
        self.first = dict(zip(sequences, (np.cumsum(sizes) - sizes).tolist(), strict=True))
        self.sequence = np.repeat(np.arange(len(sizes)), sizes)

    def of(self, sequence: str, kind: str) -> np.ndarray:
        """Return the descriptors (N, D) float32 of an image, one of `TYPES`, of a sequence."""
        first = self.first[sequence]
        return self._of[kind][first : first + self.sizes[sequence]]

    def rows(self, patches: np.ndarray, kind: str) -> np.ndarray:
        """Return the descriptors (N, D) of numbered patches in the images of one of `TYPES`."""
        return self._of[kind][patches]

    def rows_of_images(self, patches: np.ndarray, images: np.ndarray, noise: str) -> np.ndarray:
        """Return the descriptors (N, D) of numbered patches in images 0 (reference) to 5."""
        rows = np.empty((len(patches), self._of["ref"].shape[1]), np.float32)
        for image in np.unique(images):
            chosen = images == image
            kind = f"{noise}{image}" if image else "ref"
            rows[chosen] = self.rows(patches[chosen], kind)
        return rows
