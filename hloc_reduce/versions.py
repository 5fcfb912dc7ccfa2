"""The versions of what determines the numbers."""

import platform

import cv2
import kornia
import numpy as np
import pycolmap
import sklearn
import torch

from . import __version__

MODULES = {
    "kornia": kornia,
    "numpy": np,
    "opencv": cv2,
    "pycolmap": pycolmap,
    "scikit-learn": sklearn,
    "torch": torch,
}


def versions() -> dict[str, str]:
    """Return the versions of this project, Python and the libraries, by name."""
    return {
        "hloc_reduce": __version__,
        "python": platform.python_version(),
        **{name: str(module.__version__) for name, module in MODULES.items()},
    }
