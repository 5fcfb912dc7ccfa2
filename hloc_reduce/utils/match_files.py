"""Match files in hloc's format."""

from collections.abc import Iterable
from pathlib import Path

import h5py
import numpy as np

from .cli import InputError
from .h5 import get_array, get_conf, iterate_h5_names, open_h5, reading


def get_matcher(match_file: h5py.File) -> dict:
    """Return the model configuration of the matcher of a match file, {} if the file has none."""
    model = get_conf(match_file).get("model")
    return model if isinstance(model, dict) else {}


def name_in_pair(name: str) -> str:
    """Return how a match file names an image."""
    return name.replace("/", "-")


def check_distinct(names: Iterable[str]) -> None:
    """Raise an InputError for two images that have one name in match files, as in hloc's."""
    known: dict[str, str] = {}
    for name in names:
        other = known.setdefault(name_in_pair(name), name)
        if other != name:
            raise InputError(
                f"{other} and {name} have the same name in match files, which replace / by -: "
                "rename one of them."
            )


def names_to_pair(name0: str, name1: str, separator: str = "/") -> str:
    """Return the name of a pair's group in a match file."""
    return separator.join((name_in_pair(name0), name_in_pair(name1)))


def find_pair(file: h5py.File, name0: str, name1: str) -> tuple[str | None, bool]:
    """Return the group of a pair in an open match file, or None, and whether it is reversed."""
    for separator in "/_":  # the second is hloc's old format
        for reverse in (False, True):
            names = (name1, name0) if reverse else (name0, name1)
            pair = names_to_pair(*names, separator)
            with reading(file.filename):
                found = pair in file
            if found:
                return pair, reverse
    return None, False


def list_pairs(path: Path, names: Iterable[str]) -> list[tuple[str, str]]:
    """List the pairs of some images in a match file.

    Raises:
        InputError: when the file is missing or broken, or it names two of the images alike.
    """
    known: dict[str, str] = {}
    for name in names:
        if known.setdefault(name_in_pair(name), name) != name:
            raise InputError(f"{path} cannot tell {known[name_in_pair(name)]} and {name} apart.")
    pairs = []
    with open_h5(path) as file:
        for group in iterate_h5_names(file.id):
            ends = [i for i, letter in enumerate(group) if letter == ("/" if "/" in group else "_")]
            both = ((group[:i], group[i + 1 :]) for i in ends)
            pairs += [(known[a], known[b]) for a, b in both if a in known and b in known]
    return pairs


def get_matches(
    file: h5py.File, name0: str, name1: str, sizes: tuple[int, int] | None = None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Read the matches of a pair, stored in either order.

    Args:
        file: the match file.
        name0: name of an image.
        name1: name of another.
        sizes: their numbers of keypoints, to check the matches.

    Returns:
        matches (M, 2) int64, indices of the keypoints of name0 and name1, and scores (M,), or None
        if the file has none.

    Raises:
        InputError: when the pair was not matched, or was matched with other keypoints.
    """
    pair, reverse = find_pair(file, name0, name1)
    if pair is None:
        raise InputError(f"The pair {name0}, {name1} is not in the match file {file.filename}.")
    matches0 = get_array(file, pair, "matches0", (0,))
    matched = np.flatnonzero(matches0 != -1)
    matches = np.stack([matched, matches0[matched].astype(np.int64)], -1)
    matches = matches[:, ::-1] if reverse else matches
    if sizes is not None:
        _check_matches(file, matches, (name0, name1), sizes)
    with reading(file.filename):
        scored = "matching_scores0" in file[pair]
    if not scored:
        return matches, None
    return matches, get_array(file, pair, "matching_scores0", matches0.shape)[matched]


def most_similar_first(matches: np.ndarray, scores: np.ndarray | None) -> np.ndarray:
    """Sort matches (M, 2) by their scores (M,), the highest first; without scores they stay."""
    return matches if scores is None else matches[np.argsort(-scores, kind="stable")]


def _check_matches(
    file: h5py.File, matches: np.ndarray, names: tuple[str, str], sizes: tuple[int, int]
) -> None:
    """Raise an InputError if matches (M, 2) refer to keypoints that images do not have."""
    said = f"{file.filename}: the matches of {names[0]}, {names[1]}"
    if len(matches) and matches.min() < 0:
        raise InputError(
            f"{said} are negative, as happens to hloc with more than 32,767 keypoints: match them "
            "again."
        )
    for column, (name, size) in enumerate(zip(names, sizes, strict=True)):
        if len(matches) and matches[:, column].max() >= size:
            raise InputError(f"{said} belong to other features: {name} has only {size} keypoints.")
