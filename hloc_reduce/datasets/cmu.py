"""Slices of the Extended CMU Seasons data set."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pycolmap

from ..utils import colmap
from ..utils.cli import InputError
from ..utils.parsers import parse_image_list, parse_query_list
from . import DAY_THRESHOLDS, SOURCE, Queries, check_folders, refuse

MAP, QUERY, MODEL = "database", "query", "sparse"
CMU_SOURCE = f"{SOURCE} (Extended CMU Seasons)."


@dataclass(frozen=True)
class CMU:
    """A slice such as cmu_extended/slice2, beside cmu_extended/intrinsics.txt.

    Names of images begin with the folder that they are in, database or query.

    Args:
        root: the folder with database, query, sparse and test-images-slice2.txt.

    Raises:
        InputError: naming every missing part.
    """

    root: Path
    whole_map: ClassVar[bool] = True
    results: ClassVar[str] = "CMU"
    full_names: ClassVar[bool] = False  # as the benchmark wants them
    ground_truth: ClassVar[Path | None] = None

    def __post_init__(self) -> None:
        needed = self.root / MAP, self.root / QUERY, self.query_list, self.intrinsics
        refuse(self.root, [path for path in needed if not path.exists()], CMU_SOURCE)

    @classmethod
    def recognizes(cls, root: Path) -> bool:
        """Tell whether a folder has a model and queries."""
        return (root / MODEL).is_dir() and (root / QUERY).is_dir()

    @property
    def images(self) -> Path:
        """The folder that image names are relative to."""
        return self.root

    @property
    def query_list(self) -> Path:
        """The list of queries, by their names in their folder."""
        return self.root / f"test-images-{self.root.resolve().name}.txt"

    @property
    def intrinsics(self) -> Path:
        """The intrinsics of the cameras of all slices, in a list as that of queries."""
        return self.root.resolve().parent / "intrinsics.txt"

    def map_names(self) -> list[str]:
        """Read the names of the map images."""
        return sorted(image.name for image in self._model().images.values())

    def query_names(self) -> list[str]:
        """Read the names of the queries."""
        return [f"{QUERY}/{name}" for name in parse_image_list(self.query_list)]

    def check(self, map_names: list[str]) -> None:
        """Check before any work that the folders of map images and of all queries exist.

        Raises:
            InputError: naming every missing folder.
        """
        check_folders(self.root, self.images, [*map_names, *self.query_names()], CMU_SOURCE)

    @property
    def queries(self) -> Queries:
        """The queries with the intrinsics of the cameras in their names, as img_00122_c1_...

        Raises:
            InputError: for a name with another camera.
        """
        cameras, found = dict(parse_query_list(self.intrinsics)), []
        for name in self.query_names():
            camera = next((word for word in name.split("_") if word in cameras), None)
            if camera is None:
                raise InputError(f"{self.query_list}: {name} names no camera of {self.intrinsics}.")
            found.append((name, cameras[camera]))
        return found

    def query_lists(self) -> dict[str, Queries]:
        """Return the queries, by the name of the slice."""
        return {self.root.resolve().name: self.queries}

    def true_poses(self) -> dict[str, pycolmap.Rigid3d]:
        """Return no pose: those of the queries are not public."""
        return {}

    def reference(self, folder: Path) -> Path:
        """Write the model of the map images, with their names here, into `folder`; return it."""
        return colmap.write_model(self._model(), folder)

    def thresholds(self, query_list: str) -> tuple[tuple[float, float], ...]:
        """Return the thresholds of outdoor places."""
        return DAY_THRESHOLDS

    def _model(self) -> pycolmap.Reconstruction:
        model = colmap.read_model(self.root / MODEL)
        for image in model.images.values():
            image.name = f"{MAP}/{image.name}"
        return model
