"""Pair each frame of a sequence with those around it, and with similar ones of other times."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from . import logger
from .retrieval.ranking import rank, read_global, similarity
from .utils import cli, options
from .utils.cli import InputError
from .utils.h5 import list_h5_names
from .utils.parsers import check_names, image_names, write_pairs
from .utils.paths import strings_as_paths
from .utils.time_stamps import in_order

OVERLAP, NUM_MATCHED = 10, 5  # COLMAP's overlap of sequential pairs; loop closures of a frame
FRAMES_PER_BLOCK = 256  # whose similarity to all others is in memory at once


@strings_as_paths
def main(
    descriptors: Path,
    output: Path,
    num_matched: int = NUM_MATCHED,
    overlap: int = OVERLAP,
    image_list: Path | str | Iterable[str] | None = None,
) -> Path:
    """Write the pairs of a sequence, each once.

    Frames are in the order of their names, or of their time stamps if all names are numbers. As in
    COLMAP's sequential matching with quadratic overlap, a frame is paired with the next `overlap`
    ones, and with those that follow after 16, 32, 64, ... frames, up to 2^(overlap - 1). For loop
    closures it is also paired with the most similar ones that are farther than `overlap` away.

    Args:
        descriptors: h5 file with a global_descriptor (G,) of every frame.
        output: text file of pairs.
        num_matched: maximum number of loop closures of a frame.
        overlap: number of frames that follow it.
        image_list: text file of the frames' names; in Python, also the names; default: all.

    Returns:
        `output`.

    Raises:
        InputError: for a frame without a global descriptor, or fewer than two frames.
    """
    for name, value, least in (("num_matched", num_matched, 0), ("overlap", overlap, 1)):
        if value < least:
            raise InputError(f"{name} is {value}: at least {least}.")
    listed = list_h5_names(descriptors) if image_list is None else image_names(image_list)
    names = in_order(dict.fromkeys(check_names(listed, descriptors)))
    if len(names) < 2:
        raise InputError(f"{descriptors}: a sequence has two frames or more, not {len(names)}.")
    near = {(i, j) for i in range(len(names)) for j in _following(i, overlap, len(names))}
    loops = {*_loops(read_global(descriptors, names), num_matched, overlap)} - near
    write_pairs(((names[i], names[j]) for i, j in sorted(near | loops)), output)
    logger.info(
        "Found %d pairs of %d frames: %d by their order, %d by their similarity.",
        len(near) + len(loops),
        len(names),
        len(near),
        len(loops),
    )
    return output


def _following(i: int, overlap: int, number: int) -> list[int]:
    """Return the rows of the frames that a frame is paired with by order."""
    powers = min(overlap, number.bit_length())  # larger ones lead beyond the end
    steps = {*range(1, min(overlap, number) + 1), *(2**power for power in range(powers))}
    return [i + step for step in steps if i + step < number]


def _loops(
    global_descriptors: np.ndarray, num_matched: int, overlap: int
) -> Iterator[tuple[int, int]]:
    """Yield each frame with the most similar ones that are not near it, as sorted rows."""
    rows = np.arange(len(global_descriptors))
    for start in range(0, len(rows), FRAMES_PER_BLOCK):
        block = rows[start : start + FRAMES_PER_BLOCK]
        found = similarity(global_descriptors[block], global_descriptors)
        found[abs(block[:, None] - rows) <= overlap] = -np.inf
        found[~global_descriptors[block].any(axis=1)] = -np.inf  # frames without features
        for i, values, best in zip(block, found, rank(found, num_matched), strict=True):
            yield from ((min(i, j), max(i, j)) for j in best[np.isfinite(values[best])].tolist())


def _main() -> None:
    example = "--descriptors global-feats-vlad.h5 --output pairs.txt"
    options.call(main, __doc__, example)


if __name__ == "__main__":
    cli.run(_main)
