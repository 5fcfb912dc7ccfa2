"""The lists of HPatches' tasks: read from the benchmark's CSV files, or drawn by its rule.

Drawing repeats the benchmark's calls of NumPy's legacy generator in their order, so that the
sequences in their published order give the published lists.
"""

import csv
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from ...utils.cli import InputError
from ...utils.files import replacing
from ...utils.progress import progress
from .data import IMAGE_NUMBERS, first_patches

SEED = 42
NUM_PAIRS, NUM_QUERIES, NUM_DISTRACTORS = 10**6, 10**4, 2 * 10**4
MIN_CONTRAST = 10  # standard deviation of the grey values of a query or distractor
VERIFICATION = ("pos", "neg_inter", "neg_intra")
RETRIEVAL = ("queries", "distractors")
PAIR_COLUMNS = ("s1", "t1", "idx1", "s2", "t2", "idx2")
PATCH_COLUMNS = ("s", "idx")


@dataclass(frozen=True)
class TaskLists:
    """The lists of a split; lists that are missing are drawn and written.

    Args:
        tasks: folder of the benchmark's lists.
        drawn: folder for drawn lists.
        split: name of the split.
        sizes: number of patches of each of its sequences, in the order that numbers all patches.
    """

    tasks: Path
    drawn: Path
    split: str
    sizes: Mapping[str, int]

    def pairs(self) -> dict[str, np.ndarray]:
        """Return the pairs of the verification task.

        Returns:
            "pos", "neg_inter" and "neg_intra": (P, 2, 2) int64, the image, 0 to 5, and the number
            of each patch.
        """
        draw = partial(draw_pairs, self.sizes, NUM_PAIRS)
        found = self._read("verif", VERIFICATION, PAIR_COLUMNS, draw)
        first = first_patches(self.sizes)
        return {
            kind: np.array([[(i, first[a] + m), (j, first[b] + n)] for a, i, m, b, j, n in rows])
            for kind, rows in found.items()
        }

    def pools(self, contrast: Callable[[str], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return the queries and distractors of the retrieval task.

        Args:
            contrast: returns the standard deviations (N,) of the reference patches of a sequence.

        Returns:
            Numbers of patches: queries (Q,) and distractors (N,) int64.
        """
        draw = partial(draw_pools, self.sizes, contrast, NUM_QUERIES, NUM_DISTRACTORS)
        found = self._read("retr", RETRIEVAL, PATCH_COLUMNS, draw)
        first = first_patches(self.sizes)
        queries, distractors = (
            np.array([first[name] + patch for name, patch in found[kind]]) for kind in RETRIEVAL
        )
        return queries, distractors

    def _read(
        self, task: str, kinds: tuple[str, ...], columns: tuple[str, ...], draw: Callable[[], dict]
    ) -> dict[str, list[tuple]]:
        """Read the lists of a task from the first folder that has all of them, or draw them."""
        names = {kind: f"{task}_{kind}_split-{self.split}.csv" for kind in kinds}
        folder = self.tasks
        if not all((folder / name).is_file() for name in names.values()):
            folder = self.drawn
        if not all((folder / name).is_file() for name in names.values()):
            for kind, rows in draw().items():
                _write(rows, columns, folder / names[kind])
        return {kind: _read(folder / name, columns, self.sizes) for kind, name in names.items()}


def draw_pairs(sizes: Mapping[str, int], number: int) -> dict[str, list[tuple]]:
    """Draw pairs: a patch in two images, or two patches, of any sequences or of the same one."""
    random, names = np.random.RandomState(SEED), list(sizes)
    sequences = [names[i] for i in random.choice(len(names), number)]
    shown = progress(sequences, "Drawing pairs", "pair")
    patches = [random.permutation(sizes[name])[:2].tolist() for name in shown]
    # from the first five images only, as in the published lists
    images = [random.permutation(5)[:2].tolist() for _ in range(number)]
    others = [names[i] for i in random.choice(len(names), number)]
    other_patches = [random.randint(sizes[name]) for name in others]
    drawn: dict[str, list[tuple]] = {kind: [] for kind in VERIFICATION}
    for i, name in enumerate(sequences):
        (patch, second), (image, second_image) = patches[i], images[i]
        one = (name, image, patch)
        drawn["pos"].append((*one, name, second_image, patch))
        drawn["neg_inter"].append((*one, others[i], second_image, other_patches[i]))
        drawn["neg_intra"].append((*one, name, second_image, second))
    return drawn


def draw_pools(
    sizes: Mapping[str, int],
    contrast: Callable[[str], np.ndarray],
    num_queries: int,
    num_distractors: int,
) -> dict[str, list[tuple]]:
    """Draw queries and distractors: different patches of enough contrast."""
    random, names = np.random.RandomState(SEED), list(sizes)
    enough = {name: contrast(name) > MIN_CONTRAST for name in names}

    def draw(number: int) -> list[tuple[str, int]]:
        sequences = [names[i] for i in random.choice(len(names), number)]
        patches = [(name, random.randint(sizes[name])) for name in sequences]
        return list(dict.fromkeys(p for p in patches if enough[p[0]][p[1]]))

    # the benchmark draws both before it drops any
    queries, distractors = draw(4 * num_queries), draw(10 * num_distractors)
    queries = queries[:num_queries]
    taken = set(queries)
    distractors = [patch for patch in distractors if patch not in taken][:num_distractors]
    return {"queries": queries, "distractors": distractors}


def _write(rows: list[tuple], columns: tuple[str, ...], path: Path) -> None:
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)


def _read(path: Path, columns: tuple[str, ...], sizes: Mapping[str, int]) -> list[tuple]:
    """Read a list.

    Raises:
        InputError: for a broken or empty list, or one of other sequences.
    """
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        reader = csv.reader(file)
        try:
            header = tuple(next(reader, ()))
            rows = [_parse(cells, columns, sizes) for cells in reader] if header == columns else []
        except (ValueError, csv.Error) as error:
            raise InputError(f"{path}, line {reader.line_num}: {error}.") from None
    if header != columns:
        raise InputError(f"{path} does not begin with {','.join(columns)}.")
    if not rows:
        raise InputError(f"{path} is empty.")
    return rows


def _parse(cells: list[str], columns: tuple[str, ...], sizes: Mapping[str, int]) -> tuple:
    """Return a row with numbers as int, or raise a ValueError if it is wrong."""
    row: list = [
        cell if column.startswith("s") else int(cell)
        for column, cell in zip(columns, cells, strict=True)
    ]
    for name, *images, patch in (row[i : i + 3] for i in range(0, len(row), 3)):
        if name not in sizes:
            raise ValueError(f"the sequence {name!r} is not of this split")
        if not 0 <= patch < sizes[name]:
            raise ValueError(f"{name} has {sizes[name]} patches")
        if not all(0 <= image <= len(IMAGE_NUMBERS) for image in images):
            raise ValueError(f"there is no image {images[0]}")
    return tuple(row)
