"""Aachen Day-Night v1.1, and other places in its layout."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pycolmap

from ..utils import colmap
from ..utils.cli import InputError
from ..utils.parsers import parse_query_lists
from . import SOURCE, Queries, check_folders, refuse, thresholds, true_poses

MODEL_FOLDER = "3D-models/aachen_v_1_1"
AACHEN_SOURCE = f"{SOURCE} (Aachen Day-Night v1.1); --demo makes a small town in its layout."


@dataclass(frozen=True)
class Aachen:
    """Aachen Day-Night v1.1, or any place in its layout.

    Args:
        root: the folder with images_upright, 3D-models/aachen_v_1_1 and queries.

    Raises:
        InputError: naming every missing part.
    """

    root: Path
    whole_map: ClassVar[bool] = True
    results: ClassVar[str] = "Aachen-v1.1"
    full_names: ClassVar[bool] = False  # as the benchmark wants them
    source: ClassVar[str] = AACHEN_SOURCE

    def __post_init__(self) -> None:
        missing = [path for path in (self.images, self.queries.parent) if not path.is_dir()]
        missing += self._missing_model()
        if self.queries.parent.is_dir() and not any(self.queries.parent.glob(self.queries.name)):
            missing.append(self.queries)
        refuse(self.root, missing, self.source)

    def _missing_model(self) -> list[Path]:
        """Return what is missing of the model."""
        model = self.root / MODEL_FOLDER
        if not model.is_dir():
            return [model]
        parts = ("cameras", "images", "points3D")
        return [
            model / f"{part}.*"
            for part in parts
            if not any(any(model.glob(f"{folder}{part}.*")) for folder in ("", "*/"))
        ]

    @classmethod
    def recognizes(cls, root: Path) -> bool:
        """Tell whether a folder has this layout."""
        return (root / "3D-models").is_dir()

    def check(self, map_names: list[str]) -> None:
        """Check before any work that the folders of map images and of all queries exist.

        Raises:
            InputError: naming every missing folder.
        """
        check_folders(self.root, self.images, [*map_names, *self.query_names()], self.source)

    @property
    def images(self) -> Path:
        """The folder that image names are relative to."""
        return self.root / "images_upright"

    @property
    def reference_model(self) -> Path:
        """The COLMAP model with the poses of the map images, in its folder or one in that."""
        return colmap.find_model(self.root / MODEL_FOLDER)

    @property
    def queries(self) -> Path:
        """The glob of the query lists."""
        return self.root / "queries/*_time_queries_with_intrinsics.txt"

    @property
    def ground_truth(self) -> Path:
        """The true poses of the queries, which the original does not have."""
        return self.root / "queries/ground_truth_poses.txt"

    def reference(self, folder: Path) -> Path:
        """Return `reference_model`; nothing is written."""
        return self.reference_model

    def true_poses(self) -> dict[str, pycolmap.Rigid3d]:
        """Read the true poses of queries, camera from world; none if there is no such file."""
        return true_poses(self.query_names(), self.ground_truth, False)

    def thresholds(self, query_list: str) -> tuple[tuple[float, float], ...]:
        """Return the thresholds of a list: those of night or, if not, of day."""
        return thresholds(query_list)

    def query_lists(self) -> dict[str, Queries]:
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
