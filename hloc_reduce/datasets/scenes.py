"""Scenes of which one COLMAP model has the poses of map images and queries, as hloc uses them."""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import pycolmap

from ..utils import colmap
from ..utils.cli import InputError, some
from ..utils.images import stored_size
from ..utils.parsers import parse_image_list
from . import Queries, check_folders, refuse

Posed = Mapping[str, tuple[pycolmap.Camera, pycolmap.Rigid3d]]


@dataclass(frozen=True)
class Scene:
    """A scene whose COLMAP models are in a folder of its name in the folder `models` beside it.

    Args:
        root: the folder of the scene, which image names are relative to.

    Raises:
        InputError: naming every missing part.
    """

    root: Path
    whole_map: ClassVar[bool] = True
    full_names: ClassVar[bool] = True  # sequences have images of the same names
    ground_truth: ClassVar[Path | None] = None
    results: ClassVar[str]
    models: ClassVar[str]
    all_images: ClassVar[str]  # in the folder in `models`: the model of map images and queries
    query_list: ClassVar[str]  # there, too: the names of the queries
    source: ClassVar[str]

    def __post_init__(self) -> None:
        folder = self.folder(self.root)
        needed = folder / self.all_images, folder / self.query_list
        refuse(self.root, [path for path in needed if not path.exists()], self.source)

    @classmethod
    def folder(cls, root: Path) -> Path:
        """Return the folder of the models of a scene."""
        root = root.resolve()
        return root.parent / cls.models / root.name

    @classmethod
    def recognizes(cls, root: Path) -> bool:
        """Tell whether a folder is a scene with models beside it."""
        return cls.folder(root).is_dir()

    @property
    def images(self) -> Path:
        """The folder that image names are relative to."""
        return self.root

    @cached_property
    def posed(self) -> Posed:
        """The cameras and poses, camera from world, of map images and queries."""
        images = colmap.read_model(self.folder(self.root) / self.all_images).images.values()
        return {image.name: (deepcopy(image.camera), image.cam_from_world()) for image in images}

    def query_names(self) -> list[str]:
        """Read the names of the queries.

        Raises:
            InputError: for queries without a pose.
        """
        path = self.folder(self.root) / self.query_list
        names = parse_image_list(path)
        if absent := [name for name in names if name not in self.posed]:
            raise InputError(f"{path}: {some(absent)} are not in the model {self.all_images}.")
        return names

    def map_names(self) -> list[str]:
        """Return the names of the map images: all but the queries."""
        return sorted(self.posed.keys() - {*self.query_names()})

    def check(self, map_names: list[str]) -> None:
        """Check before any work that the folders of map images and queries exist.

        Raises:
            InputError: naming every missing folder.
        """
        check_folders(self.root, self.images, [*map_names, *self.query_names()], self.source)

    @property
    def queries(self) -> Queries:
        """The queries with the intrinsics of the model, scaled to their photos."""
        return [(name, self._camera(name)) for name in self.query_names()]

    def _camera(self, name: str) -> pycolmap.Camera:
        camera = deepcopy(self.posed[name][0])
        width, height = stored_size(self.images / name) or (camera.width, camera.height)
        if abs(width * camera.height / (height * camera.width) - 1) < 0.01:  # of the same shape
            camera.rescale(width, height)
        return camera

    def query_lists(self) -> dict[str, Queries]:
        """Return the queries, by the name of the scene."""
        return {self.root.resolve().name: self.queries}

    def true_poses(self) -> dict[str, pycolmap.Rigid3d]:
        """Return the poses of the queries in the model, camera from world."""
        return {name: self.posed[name][1] for name in self.query_names()}

    def reference(self, folder: Path) -> Path:
        """Write the model of the map images into `folder`, and return it."""
        model = self.folder(self.root) / self.all_images
        return colmap.write_part(model, self.map_names(), folder)
