"""The data sets that pipelines know, in their own layouts."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pycolmap

from . import colmap, extract_features, localize_inloc, logger, scans
from .cli import InputError, some
from .parsers import parse_poses, parse_query_list, parse_query_lists

# position and rotation thresholds (metres, degrees), as in the paper's tables
DAY_THRESHOLDS = ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
NIGHT_THRESHOLDS = ((0.5, 2.0), (1.0, 5.0), (5.0, 10.0))
INLOC_THRESHOLDS = ((0.25, 10.0), (0.5, 10.0), (1.0, 10.0))
SOURCE = "It comes from https://www.visuallocalization.net/datasets"
AACHEN_SOURCE = f"{SOURCE} (Aachen Day-Night v1.1); --demo makes a small town in its layout."
INLOC_SOURCE = f"{SOURCE} (InLoc)."
# of calibrated photos of the longer side of 4032 pixels: 12 pixels at 1600, as for Aachen
CALIBRATED_THRESH = 30.0


@dataclass(frozen=True)
class Aachen:
    """Aachen Day-Night v1.1, or any place in its layout.

    Args:
        root: the folder with images_upright, 3D-models/aachen_v_1_1 and queries.

    Raises:
        InputError: naming every part that is missing.
    """

    root: Path
    whole_map: ClassVar[bool] = True  # is needed, not only the map images that are retrieved

    def __post_init__(self) -> None:
        folders = (self.images, self.reference_model, self.queries.parent)
        missing = [path for path in folders if not path.is_dir()]
        for folder, patterns in (
            (self.reference_model, ("cameras.*", "images.*", "points3D.*")),
            (self.queries.parent, (self.queries.name,)),
        ):
            absent = [name for name in patterns if not any(folder.glob(name))]
            missing += [folder / name for name in absent if folder.is_dir()]
        _refuse(self.root, missing, AACHEN_SOURCE)

    def check(self, map_names: list[str]) -> None:
        """Check that the folders of all images are there, before any work is done.

        Args:
            map_names: the map images that are needed.

        Raises:
            InputError: naming every folder that is missing.
        """
        names = [*map_names, *self.query_names()]
        folders = sorted({(self.images / name).parent for name in names})
        missing = [folder for folder in folders if not folder.is_dir()]
        _refuse(self.root, missing, AACHEN_SOURCE)

    @property
    def images(self) -> Path:
        """The folder that image names are relative to."""
        return self.root / "images_upright"

    @property
    def reference_model(self) -> Path:
        """The COLMAP model with the poses of the map images."""
        return self.root / "3D-models/aachen_v_1_1"

    @property
    def queries(self) -> Path:
        """The glob of the query lists."""
        return self.root / "queries/*_time_queries_with_intrinsics.txt"

    @property
    def ground_truth(self) -> Path:
        """The file with the true poses of the queries, which the original does not have."""
        return self.root / "queries/ground_truth_poses.txt"

    def query_lists(self) -> dict[str, list[tuple[str, pycolmap.Camera]]]:
        """Read the queries of each list."""
        return parse_query_lists(self.queries)

    def query_names(self) -> list[str]:
        """Read the names of the queries of all lists."""
        return [name for part in self.query_lists().values() for name, _ in part]

    def map_names(self) -> list[str]:
        """Read the names of the map images."""
        images = colmap.read_model(self.reference_model).images.values()
        if not images:
            raise InputError(f"The model {self.reference_model} has no images.")
        return sorted(image.name for image in images)


@dataclass(frozen=True)
class InLoc:
    """InLoc, or any RGB-D place in its layout.

    Args:
        root: the folder with query, database/cutouts and database/alignments, which image names
            are relative to.

    Raises:
        InputError: naming every part that is missing.
    """

    root: Path
    whole_map: ClassVar[bool] = False

    def __post_init__(self) -> None:
        folders = (self.root / "query", self.cutouts, self.alignments)
        _refuse(self.root, [path for path in folders if not path.is_dir()], INLOC_SOURCE)

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
        """The list of queries with intrinsics, which the original does not have."""
        return self.root / "queries_with_intrinsics.txt"

    @property
    def ground_truth(self) -> Path:
        """The file with the true poses of the queries, which the original does not have."""
        return self.root / "ground_truth_poses.txt"

    def map_names(self) -> list[str]:
        """List the cutouts.

        Raises:
            InputError: when there is none.
        """
        paths = sorted(self.cutouts.glob("*/*/*_cutout_*.jpg"))
        if not paths:
            raise InputError(f"{self.cutouts} has no <floor>/<scan>/<building>_cutout_*.jpg.")
        return [path.relative_to(self.root).as_posix() for path in paths]

    def check(self, map_names: list[str]) -> None:
        """Check that the scans of cutouts are there, before any work is done.

        Args:
            map_names: the cutouts that are needed.

        Raises:
            InputError: naming a file that is missing.
        """
        files = {self.root / f"{name}.mat" for name in map_names}
        files |= {scans.transformation_file(self.root, name) for name in map_names}
        missing = sorted(file for file in files if not file.is_file())
        if missing:
            raise InputError(
                f"{self.root} lacks {len(missing)} files of scans: {some(map(str, missing), 2)}"
            )

    def query_names(self) -> list[str]:
        """List the queries: those of `query_list` where there is one, else all photos."""
        if self.query_list.is_file():
            return [name for name, _ in parse_query_list(self.query_list)]
        return extract_features.list_images(self.root, folder="query")

    def queries(self, features: Path) -> list[tuple[str, pycolmap.Camera]]:
        """Return the queries with the intrinsics of `query_list`, or else of the benchmark."""
        if not self.query_list.is_file():
            logger.info("There is no %s: queries are taken for an iPhone 7's.", self.query_list)
            return localize_inloc.by_iphone7(features, self.query_names())
        return parse_query_list(self.query_list)

    @property
    def ransac_thresh(self) -> float:
        """The threshold of `localize_inloc.main` that goes with the intrinsics of the queries."""
        calibrated = self.query_list.is_file()
        return CALIBRATED_THRESH if calibrated else localize_inloc.RANSAC_THRESH

    def buildings(
        self, names: list[str], truth: Mapping[str, pycolmap.Rigid3d], map_names: list[str]
    ) -> dict[str, list[str]]:
        """Group queries by floor, such as DUC1, if there are several.

        Args:
            names: the queries.
            truth: their true poses. A query belongs to the floor of the scan that is nearest to
                its true position, or if that is not known, to the group "query".
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


def true_poses(names: list[str], path: Path, required: bool) -> dict[str, pycolmap.Rigid3d]:
    """Read the true poses of queries, camera from world.

    Args:
        names: the queries.
        path: the file, with full names.
        required: refuse that it is not there; else nothing is known then.

    Raises:
        InputError: for a file that has none of the queries.
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


def _refuse(root: Path, missing: list[Path], source: str) -> None:
    if missing:
        raise InputError(f"The data set {root} lacks {', '.join(map(str, missing))}. {source}")


def thresholds(query_list: str) -> tuple[tuple[float, float], ...]:
    """Return the thresholds for a query list by its name: those of night, or else of day."""
    return NIGHT_THRESHOLDS if query_list.startswith("night") else DAY_THRESHOLDS
