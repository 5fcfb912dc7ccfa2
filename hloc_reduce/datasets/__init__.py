"""The layouts of data sets. `layouts.LAYOUTS` lists them; each is a `Place`."""

from pathlib import Path
from typing import ClassVar, Protocol

import pycolmap

from .. import logger
from ..utils.cli import InputError
from ..utils.parsers import parse_poses

# position and rotation thresholds (metres, degrees), as in the paper's tables
DAY_THRESHOLDS = ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
NIGHT_THRESHOLDS = ((0.5, 2.0), (1.0, 5.0), (5.0, 10.0))
INLOC_THRESHOLDS = ((0.25, 10.0), (0.5, 10.0), (1.0, 10.0))
SOURCE = "It comes from https://www.visuallocalization.net/datasets"

Queries = list[tuple[str, pycolmap.Camera]]  # names and intrinsics


class Place(Protocol):
    """What a pipeline needs to know about a data set, which it opens by its folder."""

    whole_map: ClassVar[bool]  # whether all map images are needed, not only the retrieved ones

    def __init__(self, root: Path): ...

    @classmethod
    def recognizes(cls, root: Path) -> bool:
        """Tell whether a folder has this layout, from one or two of its parts."""

    @property
    def root(self) -> Path:
        """The folder of the data set."""

    @property
    def images(self) -> Path:
        """The folder that image names are relative to."""

    def map_names(self) -> list[str]:
        """Return the names of the map images."""

    def query_names(self) -> list[str]:
        """Return the names of all queries."""

    def check(self, map_names: list[str]) -> None:
        """Raise an InputError that names what is missing for these map images and the queries."""

    @property
    def ground_truth(self) -> Path | None:
        """The file of the true poses of the queries, which may be missing, or None."""

    def true_poses(self) -> dict[str, pycolmap.Rigid3d]:
        """Return the true poses of queries, camera from world, as far as they are known."""


class ModelPlace(Place, Protocol):
    """A place whose map images have poses in a COLMAP model, or in one that can be converted.

    Attributes:
        results: begins the names of files of poses.
        full_names: whether these have the full names of queries, as the base names of some places
            are not unique.
    """

    results: ClassVar[str]
    full_names: ClassVar[bool]

    def reference(self, folder: Path) -> Path:
        """Return the COLMAP model of the map images; `folder` is for one that must be written."""

    @property
    def queries(self) -> Path | Queries:
        """The queries with intrinsics, or a glob of lists of them."""

    def query_lists(self) -> dict[str, Queries]:
        """Return the queries of each list by its name."""

    def thresholds(self, query_list: str) -> tuple[tuple[float, float], ...]:
        """Return the recall thresholds of a list, in metres and degrees."""


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


def check_folders(root: Path, images: Path, names: list[str], source: str) -> None:
    """Raise an InputError that names the missing folders of images of a data set."""
    folders = sorted({(images / name).parent for name in names})
    refuse(root, [path for path in folders if not path.is_dir()], source)


def thresholds(query_list: str) -> tuple[tuple[float, float], ...]:
    """Return the thresholds for the name of a query list: those of night or, if not, of day."""
    return NIGHT_THRESHOLDS if query_list.startswith("night") else DAY_THRESHOLDS
