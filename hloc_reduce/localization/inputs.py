"""What stages that localize have in common: their settings, and the files that they read."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
import pycolmap

from .. import logger
from ..confs.matchers import OF_HLOC, confs
from ..runtime.executors import SERIAL, Executor
from ..utils.cli import InputError
from ..utils.feature_files import dimension, get_colmap_keypoints
from ..utils.h5 import open_h5
from ..utils.match_files import find_pair, get_matcher, get_matches, most_similar_first
from .gate import MATCH_KINDS, Gate
from .references import Reference


class Settings(NamedTuple):
    """How queries are localized.

    Args:
        load_reference: returns the map; called in each process that localizes queries.
        config: returns the options of a query, as for `query.localize`, from its name and
            intrinsics.
        skip_matches: leave out retrieved images with fewer matches.
        gate: what a pose must have to be trusted.
        executor: does the work.
    """

    load_reference: Callable[[], Reference]
    config: Callable[[str, pycolmap.Camera], dict]
    skip_matches: int
    gate: Gate
    executor: Executor

    def of_files(self, features: Path, matches: Path) -> "Settings":
        """Return the settings for files, without the executor, which cannot be pickled."""
        gate = of_matches(self.gate, features, matches)
        return self._replace(gate=gate, executor=SERIAL)


def of_matches(gate: Gate, features: Path, matches: Path) -> Gate:
    """Return the gate for the matcher of a match file and descriptors like those of a file."""
    with open_h5(matches) as file:
        matcher = get_matcher(file) or _by_name(matches)
    if not matcher and gate.match_kind is None:
        raise InputError(
            f"{matches} does not say which matcher made it, nor does its name: give --match_kind, "
            f"{' or '.join(MATCH_KINDS)}."
        )
    return gate.of_matches(matcher, dimension(features))


def _by_name(matches: Path) -> dict:
    """Return the configuration of a matcher from the name that hloc gives its match files."""
    known = {conf["output"]: conf["model"] for conf in confs.values()} | OF_HLOC
    return next((model for name, model in known.items() if f"_{name}_" in matches.name), {})


def read_matches(
    feature_file: h5py.File,
    match_file: h5py.File,
    name: str,
    names: list[str],
    reference: Reference,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Read the keypoints of a query, and its matches, the most similar first."""
    keypoints, _ = get_colmap_keypoints(feature_file, name)
    present = [other for other in names if other in reference]
    if len(present) < len(names):
        absent = len(names) - len(present)
        logger.warning("%d images retrieved for %s are not in the map.", absent, name)
    if present and not any(find_pair(match_file, name, other)[0] for other in present):
        logger.warning("%s was not matched: %s has none of its pairs.", name, match_file.filename)
        return keypoints, {other: np.zeros((0, 2), np.int64) for other in present}
    sizes = {other: (len(keypoints), reference.num_keypoints(other)) for other in present}
    return keypoints, {
        other: most_similar_first(*get_matches(match_file, name, other, both))
        for other, both in sizes.items()
    }
