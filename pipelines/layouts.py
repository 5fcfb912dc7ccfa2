"""The pipeline for each data set layout."""

from pathlib import Path
from types import ModuleType

from hloc_reduce.utils.cli import InputError, no_folder

from . import aachen, inloc

PIPELINES = {"3D-models": aachen, "database": inloc}  # by a folder that a layout has


def pipeline_of(dataset: Path) -> ModuleType:
    """Return the pipeline for a data set.

    Raises:
        InputError: when its layout is unknown.
    """
    if not dataset.is_dir():
        raise no_folder(dataset)
    for folder, pipeline in PIPELINES.items():
        if (dataset / folder).is_dir():
            return pipeline
    raise InputError(f"{dataset} has neither of the folders {' and '.join(PIPELINES)}.")
