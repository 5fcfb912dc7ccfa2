"""The layouts of data sets."""

from pathlib import Path

import pycolmap

from .. import logger
from ..utils.cli import InputError
from ..utils.parsers import parse_poses

# position and rotation thresholds (metres, degrees), as in the paper's tables
DAY_THRESHOLDS = ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
NIGHT_THRESHOLDS = ((0.5, 2.0), (1.0, 5.0), (5.0, 10.0))
INLOC_THRESHOLDS = ((0.25, 10.0), (0.5, 10.0), (1.0, 10.0))
SOURCE = "It comes from https://www.visuallocalization.net/datasets"


def true_poses(names: list[str], path: Path, required: bool) -> dict[str, pycolmap.Rigid3d]:
    """Read the true poses of queries, camera from world.

    Args:
        names: the queries.
        path: the file, with full names.
        required: refuse a missing file, instead of returning no pose.

    Raises:
        InputError: if the file has none of the queries.
    """
    if not required and not path.is_file():
        return {}
    poses = parse_poses(path)
    known = [name for name in names if name in poses]
    if not known:
        raise InputError(f"{path} has the pose of no query: are its names full ones?")
    if len(known) < len(names):
        logger.warning("%s lacks %d of %d queries.", path, len(names) - len(known), len(names))
    return {name: poses[name] for name in known}


def refuse(root: Path, missing: list[Path], source: str) -> None:
    """Raise an InputError with the missing parts of a data set, if any, and its source."""
    if missing:
        raise InputError(f"The data set {root} lacks {', '.join(map(str, missing))}. {source}")


def thresholds(query_list: str) -> tuple[tuple[float, float], ...]:
    """Return the thresholds for the name of a query list: those of night or, if not, of day."""
    return NIGHT_THRESHOLDS if query_list.startswith("night") else DAY_THRESHOLDS
