"""A copy of what a package is built from, because a build leaves files in its folder."""

import shutil
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = "confs", "hloc_reduce", "pipelines"


def copy_package(target: Path) -> Path:
    """Copy the source of the package to a new folder, and return that."""
    for folder in FOLDERS:
        ignored = shutil.ignore_patterns("__pycache__", "*.so", "*.pyd")
        shutil.copytree(ROOT / folder, target / folder, ignore=ignored)
    for file in ("pyproject.toml", "setup.py", "README.md", "LICENSE", "NOTICE"):
        shutil.copy(ROOT / file, target)
    return target
