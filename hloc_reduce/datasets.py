"""The data sets that pipelines know, in their own layouts."""

from dataclasses import dataclass
from pathlib import Path

import pycolmap

from . import colmap
from .cli import InputError
from .parsers import parse_query_lists

# query list -> position and rotation thresholds (metres, degrees), as in the paper's tables
AACHEN_THRESHOLDS = {
    "day_time_queries_with_intrinsics": ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0)),
    "night_time_queries_with_intrinsics": ((0.5, 2.0), (1.0, 5.0), (5.0, 10.0)),
}
AACHEN_SOURCE = "https://www.visuallocalization.net/datasets (Aachen Day-Night v1.1)"


@dataclass(frozen=True)
class Aachen:
    """Aachen Day-Night v1.1, or any place in its layout.

    Args:
        root: the folder with images_upright, 3D-models/aachen_v_1_1 and queries.

    Raises:
        InputError: naming every part that is missing.
    """

    root: Path

    def __post_init__(self) -> None:
        missing = [
            str(path)
            for path in (self.images, self.reference_model, self.queries.parent)
            if not path.is_dir()
        ]
        if self.queries.parent.is_dir() and not list(self.queries.parent.glob(self.queries.name)):
            missing.append(str(self.queries))
        if missing:
            raise InputError(
                f"The data set {self.root} lacks {', '.join(missing)}. "
                f"It comes from {AACHEN_SOURCE}; --demo makes a small town in its layout."
            )

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
        """The true poses of the queries, which the original keeps to itself."""
        return self.root / "queries/ground_truth_poses.txt"

    def query_lists(self) -> dict[str, list[tuple[str, pycolmap.Camera]]]:
        """Read the queries of each list."""
        return parse_query_lists(self.queries)

    def map_names(self) -> list[str]:
        """Read the names of the map images."""
        images = colmap.read_model(self.reference_model).images.values()
        if not images:
            raise InputError(f"The model {self.reference_model} has no images.")
        return sorted(image.name for image in images)
