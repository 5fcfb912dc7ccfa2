"""Which photos of a map are matched with each other."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, NamedTuple

import pycolmap

from .. import (
    logger,
    pairs_from_covisibility,
    pairs_from_exhaustive,
    pairs_from_retrieval,
    pairs_from_sequence,
)
from ..utils import cli
from ..utils.options import Option
from ..utils.parsers import parse_retrieval, write_pairs

MAX_EXHAUSTIVE = 100  # photos without covisibility that are all paired with each other
ROUNDS = 3  # of additional pairs, in which larger sets of photos get connected


class Pairs(NamedTuple):
    """How photos without covisibility are paired.

    Args:
        write: writes the pairs into a file, given the names of the photos, the h5 file of their
            global descriptors and `num_covis`.
        rounds: rounds of additional pairs, where verified matches leave photos unconnected.
        widens: the first round also pairs well connected photos with neighbours of neighbours.
    """

    write: Callable[[Path, list[str], Path, int], object]
    rounds: int = ROUNDS
    widens: bool = False


def _exhaustive(pairs: Path, names: list[str], descriptors: Path, num_covis: int) -> None:
    pairs_from_exhaustive.main(pairs, names)


def _retrieval(pairs: Path, names: list[str], descriptors: Path, num_covis: int) -> None:
    pairs_from_retrieval.main(descriptors, pairs, num_covis)


def _sequential(pairs: Path, names: list[str], descriptors: Path, num_covis: int) -> None:
    pairs_from_sequence.main(descriptors, pairs, image_list=names)


PAIRS = {
    "exhaustive": Pairs(_exhaustive, rounds=0),
    "retrieval": Pairs(_retrieval, widens=True),
    "sequential": Pairs(_sequential),
}
PairsOption = Annotated[
    str,
    Option(
        "kind of pairs",
        PAIRS,
        "exhaustive pairs each photo with all others; retrieval with the --num_covis most similar "
        "ones; sequential with those before and after it by name or time stamp, and with similar "
        "ones of other times",
    ),
]


def default(number: int) -> str:
    """Return how a number of photos without covisibility are paired."""
    return "exhaustive" if number <= MAX_EXHAUSTIVE else "retrieval"


def provenance(pairs: str) -> dict[str, object]:
    """Return what the provenance of a map of photos alone says of its pairs, a key of `PAIRS`."""
    if not PAIRS[pairs].rounds:
        return {"num_covis": None, "pairs": pairs}
    return {"pairs": f"{pairs}, {PAIRS[pairs].rounds} rounds of verification"}


def of_photos(
    folder: Path, names: list[str], descriptors: Path, pairs: str, num_covis: int
) -> Path:
    """Write the pairs of photos without covisibility.

    Args:
        folder: of the map.
        names: the photos.
        descriptors: h5 file of their global descriptors.
        pairs: a key of `PAIRS`.
        num_covis: number of the most similar photos that each is paired with by retrieval.

    Returns:
        The file.
    """
    path = folder / f"pairs-db-{num_covis if pairs == 'retrieval' else pairs}.txt"
    PAIRS[pairs].write(path, names, descriptors, num_covis)
    return path


def of_model(
    folder: Path,
    reference: pycolmap.Reconstruction,
    names: list[str],
    descriptors: Path,
    pairs: str,
    num_covis: int,
) -> Path:
    """Write the pairs of covisible images, and of those without any as if there were no points.

    Args:
        folder: of the map.
        reference: model of the photos.
        names: the photos.
        descriptors: h5 file of their global descriptors.
        pairs: how photos without covisible ones are paired, "exhaustive" or "retrieval".
        num_covis: number of the most covisible photos that each is paired with.

    Returns:
        The file.
    """
    others = dict(pairs_from_covisibility.covisible(reference, num_covis))
    alone = [name for name, seen in others.items() if not seen]
    if len(alone) == len(others):
        return of_photos(folder, names, descriptors, pairs, num_covis)
    path, exhaustive = folder / f"pairs-db-{num_covis}.txt", pairs == "exhaustive"
    if alone:
        logger.info(
            "%d of %d photos share no point of the model with others, so they are paired "
            "with %s: %s.",
            len(alone),
            len(others),
            "all others" if exhaustive else "the most similar ones",
            cli.some(alone),
        )
    if exhaustive:
        others |= {name: [other for other in others if other != name] for name in alone}
    elif alone:
        pairs_from_retrieval.main(descriptors, path, num_covis, query_list=alone, db_list=[*others])
        others |= parse_retrieval(path)
    number = write_pairs(((a, b) for a in others for b in others[a]), path)
    logger.info("Found %d pairs of %d images.", number, len(others))
    return path
