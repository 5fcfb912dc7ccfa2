"""The layouts of data sets, and which of them a folder has."""

from pathlib import Path

from ..utils.cli import InputError, no_folder
from . import ModelPlace, Place
from .aachen import Aachen
from .aachen_v1 import AachenV1
from .cambridge import Cambridge
from .cambridge_nvm import NVM, CambridgeNvm
from .cmu import CMU
from .inloc import InLoc
from .scenes import Scene
from .sevenscenes import SevenScenes

# the first one that recognizes a folder reads it
MODEL_LAYOUTS: tuple[type[ModelPlace], ...] = (
    *(AachenV1, Aachen),
    *(Cambridge, CambridgeNvm, SevenScenes),
    CMU,
)
LAYOUTS: tuple[type[Place], ...] = (*MODEL_LAYOUTS, InLoc)


def layout_of(root: Path) -> type[Place]:
    """Return the layout of a data set.

    Raises:
        InputError: if there is no such folder, or no layout recognizes it.
    """
    if not root.is_dir():
        raise no_folder(root)
    for layout in LAYOUTS:
        if layout.recognizes(root):
            return layout
    scenes = [layout for layout in MODEL_LAYOUTS if issubclass(layout, Scene)]
    models = dict.fromkeys(layout.models for layout in scenes)
    raise InputError(
        f"{root} has neither of the folders 3D-models and database, of Aachen and InLoc, and is no "
        f"scene with {NVM} or beside the folder of its COLMAP model, {' or '.join(models)}: see "
        "docs/aachen.md."
    )


def open_model_place(root: Path) -> ModelPlace:
    """Open a data set with a COLMAP model, in the layout of Aachen if none recognizes the folder.

    Raises:
        InputError: naming what it lacks.
    """
    recognized = (layout for layout in MODEL_LAYOUTS if layout.recognizes(root))
    return next(recognized, Aachen)(root)
