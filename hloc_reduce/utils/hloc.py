"""The installed hloc, github.com/cvg/Hierarchical-Localization."""

import importlib
from collections.abc import Callable
from importlib.util import find_spec
from types import ModuleType

from packaging.version import InvalidVersion, Version

from .cli import InputError

SOURCE = "git+https://github.com/cvg/Hierarchical-Localization"
# hloc has been 1.5 since 2023; its `min_version` tells whether its pycolmap is new enough
LAST_OLD = Version("1.5")
MIN_PYCOLMAP = Version("3.13.0")


def is_installed() -> bool:
    """Tell whether hloc is installed."""
    spec = find_spec("hloc")
    return spec is not None and spec.origin is not None  # a mere folder of that name has no origin


def extractors_package() -> tuple[ModuleType, Callable]:
    """Return hloc's package of extractors and its `dynamic_load`.

    Raises:
        InputError: when hloc is missing, too old or cannot be imported.
    """
    if not is_installed():
        raise InputError(f"hloc is not installed: pip install {SOURCE}")
    hloc = import_module("")
    version = getattr(hloc, "__version__", "0")
    wanted = str(getattr(hloc, "min_version", "0"))  # of pycolmap
    if parse_version(version) <= LAST_OLD and parse_version(wanted) < MIN_PYCOLMAP:
        raise InputError(
            f"The installed hloc {version} is too old, it was written for a pycolmap before "
            f"{MIN_PYCOLMAP}: pip install --upgrade {SOURCE}"
        )
    return import_module("extractors"), import_module("utils.base_model").dynamic_load


def parse_version(version: str) -> Version:
    """Parse a version; a development build, such as `dev`, counts as the newest."""
    try:
        return Version(version)
    except InvalidVersion:
        return Version("9999")


def import_module(name: str) -> ModuleType:
    """Import a module of hloc by its name there, or hloc itself by "".

    Raises:
        InputError: when it cannot be imported.
    """
    path = f"hloc.{name}".strip(".")
    try:
        return importlib.import_module(path)
    except Exception as error:  # torchvision, which hloc imports, raises RuntimeError
        raise InputError(f"{path} cannot be imported ({error}).") from None
