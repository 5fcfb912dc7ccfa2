"""Aachen Day-Night v1.0, whose model is an NVM file of VisualSFM."""

from pathlib import Path
from typing import ClassVar

import pycolmap

from ..utils.cli import InputError
from ..utils.parsers import parse_query_list
from . import SOURCE, nvm
from .aachen import MODEL_FOLDER, Aachen

NVM = "3D-models/aachen_cvpr2018_db.nvm"
INTRINSICS = "3D-models/database_intrinsics.txt"


class AachenV1(Aachen):
    """Aachen Day-Night v1.0, or any place in its layout: as v1.1, but for the model.

    The database of hloc's converter is not needed.
    """

    results: ClassVar[str] = "Aachen"
    source: ClassVar[str] = f"{SOURCE} (Aachen Day-Night)."

    def _missing_model(self) -> list[Path]:
        return [path for path in (self.nvm, self.intrinsics) if not path.is_file()]

    @classmethod
    def recognizes(cls, root: Path) -> bool:
        """Tell whether a folder has the NVM file, and not the model of v1.1, too."""
        return (root / NVM).is_file() and not (root / MODEL_FOLDER).exists()

    @property
    def nvm(self) -> Path:
        """The model of the map images."""
        return self.root / NVM

    @property
    def intrinsics(self) -> Path:
        """The intrinsics of the map images, in a list as that of queries."""
        return self.root / INTRINSICS

    def map_names(self) -> list[str]:
        """Read the names of the map images."""
        return sorted(view.name for view in nvm.views(self.nvm))

    def reference(self, folder: Path) -> Path:
        """Convert the model into a COLMAP model in `folder`, unless it is there; return the folder.

        Raises:
            InputError: for a broken file, or an image without intrinsics.
        """
        cameras = dict(parse_query_list(self.intrinsics))

        def choose(view: nvm.View) -> tuple[str, pycolmap.Camera]:
            if view.name not in cameras:
                raise InputError(
                    f"{self.intrinsics} lacks {view.name}, which is in {self.nvm.name}."
                )
            return view.name, cameras[view.name]

        return nvm.converted(self.nvm, choose, [self.nvm, self.intrinsics], folder)
