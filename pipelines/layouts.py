"""The pipeline for each data set."""

from pathlib import Path
from types import ModuleType

from hloc_reduce.datasets.inloc import InLoc
from hloc_reduce.datasets.layouts import layout_of

from . import aachen, inloc


def pipeline_of(dataset: Path) -> ModuleType:
    """Return the pipeline for a data set.

    Raises:
        InputError: when its layout is unknown.
    """
    return inloc if layout_of(dataset) is InLoc else aachen
