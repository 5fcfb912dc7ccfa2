"""The data sets that pipelines know, in their own layouts."""

from dataclasses import dataclass
from pathlib import Path

import pycolmap

from . import colmap, logger
from .cli import InputError
from .parsers import parse_poses, parse_query_lists

# position and rotation thresholds (metres, degrees), as in the paper's tables
DAY_THRESHOLDS = ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
NIGHT_THRESHOLDS = ((0.5, 2.0), (1.0, 5.0), (5.0, 10.0))
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
        folders = (self.images, self.reference_model, self.queries.parent)
        missing = [path for path in folders if not path.is_dir()]
        for folder, patterns in (
            (self.reference_model, ("cameras.*", "images.*", "points3D.*")),
            (self.queries.parent, (self.queries.name,)),
        ):
            absent = [name for name in patterns if not any(folder.glob(name))]
            missing += [folder / name for name in absent if folder.is_dir()]
        self._refuse(missing)

    def _refuse(self, missing: list[Path]) -> None:
        if missing:
            raise InputError(
                f"The data set {self.root} lacks {', '.join(map(str, missing))}. "
                f"It comes from {AACHEN_SOURCE}; --demo makes a small town in its layout."
            )

    def check_images(self, names: list[str]) -> None:
        """Check that the folders of all images are there, before any work is done.

        Raises:
            InputError: naming every folder that is missing.
        """
        folders = sorted({(self.images / name).parent for name in names})
        self._refuse([folder for folder in folders if not folder.is_dir()])

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

    def true_poses(self, names: list[str], path: Path | None = None) -> dict[str, pycolmap.Rigid3d]:
        """Read the true poses of queries, camera from world; the original has no such file.

        Args:
            names: the queries.
            path: the file, with full names; default: queries/ground_truth_poses.txt, if any.

        Raises:
            InputError: for a file that has none of the queries.
        """
        default = self.root / "queries/ground_truth_poses.txt"
        if path is None and not default.is_file():
            return {}
        path = path or default
        poses = parse_poses(path)
        known = [name for name in names if name in poses]
        if not known:
            raise InputError(f"{path} has the pose of no query: are its names full ones?")
        if len(known) < len(names):
            logger.warning("%s lacks %d of %d queries.", path, len(names) - len(known), len(names))
        return {name: poses[name] for name in known}

    def query_lists(self) -> dict[str, list[tuple[str, pycolmap.Camera]]]:
        """Read the queries of each list."""
        return parse_query_lists(self.queries)

    def map_names(self) -> list[str]:
        """Read the names of the map images."""
        images = colmap.read_model(self.reference_model).images.values()
        if not images:
            raise InputError(f"The model {self.reference_model} has no images.")
        return sorted(image.name for image in images)


def thresholds(query_list: str) -> tuple[tuple[float, float], ...]:
    """Return the thresholds for a query list by its name: those of night, or else of day."""
    return NIGHT_THRESHOLDS if query_list.startswith("night") else DAY_THRESHOLDS
