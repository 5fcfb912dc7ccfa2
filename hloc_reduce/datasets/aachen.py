"""Aachen Day-Night v1.1, and other places in its layout."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pycolmap

from ..utils import colmap
from ..utils.cli import InputError
from ..utils.parsers import parse_query_lists
from . import SOURCE, refuse

MODEL = "3D-models/aachen_v_1_1"
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
    whole_map: ClassVar[bool] = True  # all map images are needed, not only the retrieved ones

    def __post_init__(self) -> None:
        model = self.root / MODEL
        folders = (self.images, model, self.queries.parent)
        missing = [path for path in folders if not path.is_dir()]
        for part in ("cameras", "images", "points3D"):
            inside = (any(model.glob(f"{folder}{part}.*")) for folder in ("", "*/"))
            if model.is_dir() and not any(inside):
                missing.append(model / f"{part}.*")
        if self.queries.parent.is_dir() and not any(self.queries.parent.glob(self.queries.name)):
            missing.append(self.queries)
        refuse(self.root, missing, AACHEN_SOURCE)

    def check(self, map_names: list[str]) -> None:
        """Check before any work that the folders of map images and of all queries exist.

        Raises:
            InputError: naming every missing folder.
        """
        names = [*map_names, *self.query_names()]
        folders = sorted({(self.images / name).parent for name in names})
        refuse(self.root, [path for path in folders if not path.is_dir()], AACHEN_SOURCE)

    @property
    def images(self) -> Path:
        """The folder that image names are relative to."""
        return self.root / "images_upright"

    @property
    def reference_model(self) -> Path:
        """The COLMAP model with the poses of the map images, in its folder or one in that."""
        return colmap.find_model(self.root / MODEL)

    @property
    def queries(self) -> Path:
        """The glob of the query lists."""
        return self.root / "queries/*_time_queries_with_intrinsics.txt"

    @property
    def ground_truth(self) -> Path:
        """The true poses of the queries, which the original does not have."""
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
