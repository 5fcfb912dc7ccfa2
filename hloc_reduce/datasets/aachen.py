"""Aachen Day-Night v1.1, and places in its layout."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pycolmap

from ..utils import colmap
from ..utils.cli import InputError
from ..utils.parsers import parse_query_lists
from . import SOURCE, refuse

AACHEN_SOURCE = f"{SOURCE} (Aachen Day-Night v1.1); --demo makes a small town in its layout."


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
        refuse(self.root, missing, AACHEN_SOURCE)

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
        refuse(self.root, missing, AACHEN_SOURCE)

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
