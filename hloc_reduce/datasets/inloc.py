"""InLoc, and other RGB-D places in its layout."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pycolmap

from .. import logger
from ..utils.cli import InputError, some
from ..utils.feature_files import get_image_size
from ..utils.h5 import open_h5
from ..utils.images import list_images
from ..utils.parsers import parse_query_list
from . import SOURCE, refuse, scans, true_poses

INLOC_SOURCE = f"{SOURCE} (InLoc)."
RANSAC_SIZE = 4032  # the longer side of an iPhone 7's photo, for which thresholds are
RANSAC_THRESH = 48.0  # pixels, with the intrinsics of the benchmark, as in hloc
CALIBRATED_THRESH = 30.0  # pixels, with calibrated intrinsics: 12 at 1600, as for Aachen


@dataclass(frozen=True)
class InLoc:
    """InLoc, or any RGB-D place in its layout.

    Args:
        root: the folder with query, database/cutouts and database/alignments, which image names
            are relative to.

    Raises:
        InputError: naming every missing part.
    """

    root: Path
    whole_map: ClassVar[bool] = False

    def __post_init__(self) -> None:
        folders = (self.root / "query", self.cutouts, self.alignments)
        refuse(self.root, [path for path in folders if not path.is_dir()], INLOC_SOURCE)

    @classmethod
    def recognizes(cls, root: Path) -> bool:
        """Tell whether a folder has this layout."""
        return (root / "database").is_dir()

    def true_poses(self) -> dict[str, pycolmap.Rigid3d]:
        """Read the true poses of queries, camera from world; none if there is no such file."""
        return true_poses(self.query_names(), self.ground_truth, False)

    @property
    def images(self) -> Path:
        """The folder that image names are relative to."""
        return self.root

    @property
    def cutouts(self) -> Path:
        """The folder of the database images and their scans."""
        return self.root / "database/cutouts"

    @property
    def alignments(self) -> Path:
        """The folder of the poses of the scans."""
        return self.root / "database/alignments"

    @property
    def query_list(self) -> Path:
        """The query list with intrinsics, which the original does not have."""
        return self.root / "queries_with_intrinsics.txt"

    @property
    def ground_truth(self) -> Path:
        """The true poses of the queries, which the original does not have."""
        return self.root / "ground_truth_poses.txt"

    def map_names(self) -> list[str]:
        """List the cutouts.

        Raises:
            InputError: if there is none.
        """
        paths = sorted(self.cutouts.glob("*/*/*_cutout_*.jpg"))
        if not paths:
            raise InputError(f"{self.cutouts} has no <floor>/<scan>/<building>_cutout_*.jpg.")
        return [path.relative_to(self.root).as_posix() for path in paths]

    def check(self, map_names: list[str]) -> None:
        """Check before any work that the scans of cutouts exist.

        Raises:
            InputError: naming a missing file.
        """
        files = {self.root / f"{name}.mat" for name in map_names}
        files |= {scans.transformation_file(self.root, name) for name in map_names}
        missing = sorted(file for file in files if not file.is_file())
        if missing:
            raise InputError(
                f"{self.root} lacks {len(missing)} files of scans: {some(map(str, missing), 2)}"
            )

    def query_names(self) -> list[str]:
        """List the queries: those of `query_list` if it exists, else all photos."""
        if self.query_list.is_file():
            return [name for name, _ in parse_query_list(self.query_list)]
        return list_images(self.root, folder="query")

    def queries(self, features: Path) -> list[tuple[str, pycolmap.Camera]]:
        """Return the queries with the intrinsics of `query_list`, or without it those of InLoc."""
        if not self.query_list.is_file():
            logger.info("There is no %s: assuming queries by an iPhone 7.", self.query_list)
            return by_iphone7(features, self.query_names())
        return parse_query_list(self.query_list)

    @property
    def ransac_thresh(self) -> float:
        """The inlier threshold that suits the intrinsics of the queries."""
        return CALIBRATED_THRESH if self.query_list.is_file() else RANSAC_THRESH

    def buildings(
        self, names: list[str], truth: Mapping[str, pycolmap.Rigid3d], map_names: list[str]
    ) -> dict[str, list[str]]:
        """Group queries by floor, such as DUC1.

        Args:
            names: the queries.
            truth: their true poses. A query belongs to the floor of the scan nearest to its true
                position. Without a true pose it belongs to the only floor, or to "query".
            map_names: cutouts.
        """
        floors = sorted({scans.floor_of(name) for name in map_names})
        if len(floors) == 1 or not truth:
            return {floors[0] if len(floors) == 1 else "query": names}
        near = {scans.transformation_file(self.root, n): scans.floor_of(n) for n in map_names}
        positions = np.array([scans.read_transformation(path)[:3, 3] for path in near])
        groups: dict[str, list[str]] = {floor: [] for floor in [*floors, "query"]}
        for name in names:
            floor = "query"
            if name in truth:
                centre = truth[name].inverse().translation
                floor = list(near.values())[np.linalg.norm(positions - centre, axis=1).argmin()]
            groups[floor].append(name)
        return {floor: group for floor, group in groups.items() if group}


def by_iphone7(features: Path, names: Iterable[str]) -> list[tuple[str, pycolmap.Camera]]:
    """Return queries in a feature file with the intrinsics of InLoc's: 28 mm on 35 mm film."""
    queries = []
    with open_h5(features) as file:
        for name in names:
            width, height = get_image_size(file, name)
            params = [max(width, height) * 28 / 36, width / 2, height / 2]
            camera = pycolmap.Camera(
                model="SIMPLE_PINHOLE", width=width, height=height, params=params
            )
            queries.append((name, camera))
    return queries
