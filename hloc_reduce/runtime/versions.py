"""Versions of the libraries that results depend on."""

import platform
from importlib import metadata

import cv2
import numpy as np
import pycolmap

from .. import __version__

MODULES = {"numpy": np, "opencv": cv2, "pycolmap": pycolmap}
# these take long to import, or may be missing
DISTRIBUTIONS = {
    "faiss": "faiss-cpu",
    "kornia": "kornia",
    "safetensors": "safetensors",
    "scikit-learn": "scikit-learn",
    "torch": "torch",
}


def versions() -> dict[str, str]:
    """Return the versions of this project, Python and the libraries, by name."""
    return {
        "hloc_reduce": __version__,
        "python": platform.python_version(),
        **{name: str(module.__version__) for name, module in MODULES.items()},
        **{name: metadata.version(key) for name, key in DISTRIBUTIONS.items() if _installed(key)},
    }


def _installed(distribution: str) -> bool:
    return any(metadata.distributions(name=distribution))
