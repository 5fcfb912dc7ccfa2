"""Scenes of Cambridge Landmarks as they are downloaded, with a model in an NVM file."""

from functools import cached_property
from itertools import dropwhile
from pathlib import Path, PurePath
from typing import ClassVar

import pycolmap

from .. import logger
from ..utils.cli import InputError, some
from ..utils.images import stored_size
from ..utils.parsers import check_names
from . import nvm, refuse
from .cambridge import Cambridge
from .scenes import Posed

NVM = "reconstruction.nvm"
MAP_LIST, QUERY_LIST = "dataset_train.txt", "dataset_test.txt"
LINE = "name x y z qw qx qy qz"
WORDS = len(LINE.split())
SIZE = 1920, 1080  # of all photos, unless they were resized


class CambridgeNvm(Cambridge):
    """A scene such as cambridge/ShopFacade, with seq1/frame00001.png and so on.

    The model is reconstruction.nvm, where names end in .jpg; dataset_train.txt and dataset_test.txt
    list the map images and the queries.
    """

    source: ClassVar[str] = "It comes from http://mi.eng.cam.ac.uk/projects/relocalisation."

    def __post_init__(self) -> None:
        refuse(self.root, [path for path in self._files if not path.is_file()], self.source)

    @classmethod
    def recognizes(cls, root: Path) -> bool:
        """Tell whether a folder has the NVM file."""
        return (root / NVM).is_file()

    @property
    def _files(self) -> list[Path]:
        return [self.root / name for name in (NVM, MAP_LIST, QUERY_LIST)]

    @cached_property
    def _views(self) -> dict[PurePath, nvm.View]:
        """The images of the model by their names without a suffix."""
        return {PurePath(view.name).with_suffix(""): view for view in nvm.views(self.root / NVM)}

    @cached_property
    def posed(self) -> Posed:
        """The cameras and poses, camera from world, of map images and queries."""
        names = (*self.map_names(), *self.query_names())
        return {name: (self._intrinsics(name), self._view(name).cam_from_world) for name in names}

    @cached_property
    def _map_names(self) -> list[str]:
        path = self.root / MAP_LIST
        names, absent = self._listed(path)
        if not names:
            raise InputError(f"{path} has no image of {NVM}.")
        if absent:
            logger.warning("%s are not in %s: they are left out.", some(absent), self.root / NVM)
        return sorted(names)

    def map_names(self) -> list[str]:
        """Read the names of the map images. Those that are not in the model are left out.

        Raises:
            InputError: when all are.
        """
        return [*self._map_names]

    def query_names(self) -> list[str]:
        """Read the names of the queries.

        Raises:
            InputError: for queries without a pose.
        """
        path = self.root / QUERY_LIST
        names, absent = self._listed(path)
        if absent:
            raise InputError(f"{path}: {some(absent)} are not in {NVM}.")
        return names

    def reference(self, folder: Path) -> Path:
        """Convert the model of the map images, unless it is in `folder`; return the folder."""
        names = {PurePath(name).with_suffix(""): name for name in self.map_names()}

        def choose(view: nvm.View) -> tuple[str, pycolmap.Camera] | None:
            name = names.get(PurePath(view.name).with_suffix(""))
            return (name, self._intrinsics(name)) if name else None

        return nvm.converted(self.root / NVM, choose, self._files, folder)

    def _listed(self, path: Path) -> tuple[list[str], list[str]]:
        """Return the names of a list that are in the model, and those that are not."""
        known: list[str] = []
        absent: list[str] = []
        for name in _names(path):
            (known if PurePath(name).with_suffix("") in self._views else absent).append(name)
        return known, absent

    def _view(self, name: str) -> nvm.View:
        return self._views[PurePath(name).with_suffix("")]

    def _intrinsics(self, name: str) -> pycolmap.Camera:
        view = self._view(name)
        width, height = stored_size(self.images / name) or SIZE
        focal_length = view.focal_length * width / SIZE[0]
        # COLMAP's distortion is that of undistorted positions
        params = focal_length, width / 2, height / 2, -view.distortion
        return pycolmap.Camera(model="SIMPLE_RADIAL", width=width, height=height, params=params)


def _names(path: Path) -> list[str]:
    """Read the names of a list. What comes before the first line of an image is the header."""
    lines = map(str.split, path.read_text(encoding="utf-8", errors="replace").splitlines())
    found = [words for words in dropwhile(lambda words: len(words) != WORDS, lines) if words]
    if not found:
        raise InputError(f"{path} has no line `{LINE}`.")
    if wrong := [words for words in found if len(words) != WORDS]:
        raise InputError(f"{path}: '{' '.join(wrong[0])}' is not a line `{LINE}`.")
    return check_names([*dict.fromkeys(words[0] for words in found)], path)
