"""The lists of HPatches' tasks: read from the benchmark's CSV files, or drawn by its rule.

A list is drawn with the calls of NumPy's legacy generator, in their order, that the benchmark made,
so that the sequences in their published order give the published lists.
"""

import csv
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from ...utils.cli import InputError
from ...utils.files import replacing
from ...utils.progress import progress
from .data import IMAGES

SEED = 42
NUM_PAIRS, NUM_QUERIES, NUM_DISTRACTORS = 10**6, 10**4, 2 * 10**4
MIN_CONTRAST = 10  # standard deviation of the grey values of a query or distractor
VERIFICATION = ("pos", "neg_inter", "neg_intra")
PAIR_COLUMNS = ("s1", "t1", "idx1", "s2", "t2", "idx2")
PATCH_COLUMNS = ("s", "idx")


def pairs(tasks: Path, drawn: Path, split: str, sizes: Mapping[str, int]) -> dict[str, np.ndarray]:
    """Read the pairs of the verification task, or draw and keep them.

    Args:
        tasks: folder of the benchmark's lists.
        drawn: folder for those that are drawn.
        split: its name.
        sizes: patches of each of its sequences.

    Returns:
        "pos", "neg_inter" and "neg_intra": (P, 2, 2) int64, of each pair of patches the image,
        0 to 5, and the number of the patch, through all sequences.
    """
    names = {kind: f"verif_{kind}_split-{split}.csv" for kind in VERIFICATION}
    found = _read_all(
        names, PAIR_COLUMNS, tasks, drawn, lambda: draw_pairs(sizes, NUM_PAIRS), sizes
    )
    first = _first(sizes)
    listed = {}
    for kind, rows in found.items():
        images = np.array([(row[1], row[4]) for row in rows])
        patches = np.array([(first[row[0]] + row[2], first[row[3]] + row[5]) for row in rows])
        listed[kind] = np.stack([images, patches], axis=-1)
    return listed


def pools(
    tasks: Path,
    drawn: Path,
    split: str,
    sizes: Mapping[str, int],
    contrast: Callable[[str], np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Read the queries and distractors of the retrieval task, or draw and keep them.

    Args:
        tasks: folder of the benchmark's lists.
        drawn: folder for those that are drawn.
        split: its name.
        sizes: patches of each of its sequences.
        contrast: gives the standard deviations (N,) of the reference patches of a sequence.

    Returns:
        Numbers of patches, through all sequences: of queries (Q,) and of distractors (N,) int64.
    """
    names = {kind: f"retr_{kind}_split-{split}.csv" for kind in ("queries", "distractors")}
    found = _read_all(
        names,
        PATCH_COLUMNS,
        tasks,
        drawn,
        lambda: draw_pools(sizes, contrast, NUM_QUERIES, NUM_DISTRACTORS),
        sizes,
    )
    first = _first(sizes)
    queries, distractors = (
        np.array([first[name] + patch for name, patch in rows]) for rows in found.values()
    )
    return queries, distractors


def _first(sizes: Mapping[str, int]) -> dict[str, int]:
    ends = np.cumsum(list(sizes.values())).tolist()
    return {name: end - sizes[name] for name, end in zip(sizes, ends, strict=True)}


def _read_all(
    names: dict[str, str],
    columns: tuple[str, ...],
    tasks: Path,
    drawn: Path,
    draw: Callable[[], dict[str, list[tuple]]],
    sizes: Mapping[str, int],
) -> dict[str, list[tuple]]:
    """Read lists that belong together from a folder that has them all, or draw and write them."""
    folder = next(
        (f for f in (tasks, drawn) if all((f / n).is_file() for n in names.values())), None
    )
    if folder is None:
        folder = drawn
        for kind, rows in draw().items():
            _write(rows, columns, folder / names[kind])
    return {kind: _read(folder / name, columns, sizes) for kind, name in names.items()}


def _write(rows: list[tuple], columns: tuple[str, ...], path: Path) -> None:
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)


def _read(path: Path, columns: tuple[str, ...], sizes: Mapping[str, int]) -> list[tuple]:
    """Read a list, checked.

    Raises:
        InputError: for a broken one, or one of other sequences.
    """
    rows = []
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        reader = csv.reader(file)
        if tuple(next(reader, ())) != columns:
            raise InputError(f"{path} does not begin with {','.join(columns)}.")
        while True:
            try:
                if (cells := next(reader, None)) is None:
                    break
                row = tuple(
                    cell if column.startswith("s") else int(cell)
                    for column, cell in zip(columns, cells, strict=True)
                )
                for side in range(0, len(row), 3):
                    name, patch = row[side], row[min(side + 2, len(row) - 1)]
                    if not 0 <= patch < sizes[name]:
                        raise ValueError(f"{name} has {sizes[name]} patches")
                    if len(row) > 2 and not 0 <= row[side + 1] <= len(IMAGES):
                        raise ValueError(f"there is no image {row[side + 1]}")
            except KeyError as error:
                reason = f"the sequence {error} is not of this split"
            except (ValueError, csv.Error) as error:
                reason = error
            else:
                rows.append(row)
                continue
            raise InputError(f"{path}, line {reader.line_num}: {reason}.")
    if not rows:
        raise InputError(f"{path} is empty.")
    return rows


def draw_pairs(sizes: Mapping[str, int], number: int) -> dict[str, list[tuple]]:
    """Draw pairs of patches: the same in two images, or others of the same or any sequence."""
    random, names = np.random.RandomState(SEED), list(sizes)
    sequences = [names[i] for i in random.choice(len(names), number)]
    shown = progress(sequences, "Drawing pairs", "pair")
    patches = [random.permutation(sizes[name])[:2].tolist() for name in shown]
    # of the first five images only, as in the published lists
    images = [random.permutation(5)[:2].tolist() for _ in range(number)]
    others = [names[i] for i in random.choice(len(names), number)]
    other_patches = [random.randint(sizes[name]) for name in others]
    drawn = {kind: [] for kind in VERIFICATION}
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
    """Draw queries and distractors: different patches that are not flat."""
    random, names = np.random.RandomState(SEED), list(sizes)
    enough = {name: contrast(name) > MIN_CONTRAST for name in names}

    def draw(number: int) -> list[tuple[str, int]]:
        sequences = [names[i] for i in random.choice(len(names), number)]
        patches = [(name, random.randint(sizes[name])) for name in sequences]
        return list(dict.fromkeys(p for p in patches if enough[p[0]][p[1]]))

    # both are drawn before any is left out
    queries, distractors = draw(4 * num_queries), draw(10 * num_distractors)
    queries = queries[:num_queries]
    taken = set(queries)
    distractors = [patch for patch in distractors if patch not in taken][:num_distractors]
    return {"queries": queries, "distractors": distractors}
