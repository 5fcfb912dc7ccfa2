"""The versions of what determines the numbers."""

import platform
from importlib import metadata

import cv2
import kornia
import numpy as np
import pycolmap
import safetensors
import sklearn
import torch

from . import __version__

MODULES = {
    "kornia": kornia,
    "numpy": np,
    "opencv": cv2,
    "pycolmap": pycolmap,
    "safetensors": safetensors,
    "scikit-learn": sklearn,
    "torch": torch,
}


def versions() -> dict[str, str]:
    """Return the versions of this project, Python and the libraries, by name."""
    return _faiss() | {
        "hloc_reduce": __version__,
        "python": platform.python_version(),
        **{name: str(module.__version__) for name, module in MODULES.items()},
    }


def _faiss() -> dict[str, str]:
    """Return that of faiss, which is optional."""
    try:
        return {"faiss": metadata.version("faiss-cpu")}
    except metadata.PackageNotFoundError:
        return {}
