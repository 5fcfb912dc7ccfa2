"""The installed hloc, github.com/cvg/Hierarchical-Localization."""

import importlib
import pkgutil
from collections.abc import Callable
from importlib.util import find_spec
from types import ModuleType
from typing import Any

from packaging.version import InvalidVersion, Version

from .cli import InputError, choose

PIP_URL = "git+https://github.com/cvg/Hierarchical-Localization"
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
        raise InputError(f"hloc is not installed: pip install {PIP_URL}")
    hloc = import_module("")
    version = getattr(hloc, "__version__", "0")
    wanted = str(getattr(hloc, "min_version", "0"))  # of pycolmap
    if parse_version(version) <= LAST_OLD and parse_version(wanted) < MIN_PYCOLMAP:
        raise InputError(
            f"The installed hloc {version} is too old, it was written for a pycolmap before "
            f"{MIN_PYCOLMAP}: pip install --upgrade {PIP_URL}"
        )
    return import_module("extractors"), import_module("utils.base_model").dynamic_load


def make_extractor(conf: dict) -> Any:
    """Make an extractor of hloc.

    Args:
        conf: hloc's configuration of its model: `name`, with or without the prefix `hloc.`, and the
            options of that extractor.

    Raises:
        InputError: when hloc is missing or too old, or the extractor is unknown or cannot be made,
            for example as its weights cannot be downloaded.
    """
    package, load = extractors_package()
    if "name" not in conf:
        raise InputError("The extractor hloc needs the name of one of hloc's: conf: {name: ...}.")
    name = str(conf["name"]).removeprefix("hloc.")
    known = [module.name for module in pkgutil.iter_modules(package.__path__)]
    model = choose("extractor", name, known)
    try:
        return load(package, model)({**conf, "name": name})
    except Exception as error:  # whatever hloc and its third parties raise
        raise InputError(f"hloc's extractor {name} cannot be made ({reason(error)}).") from None


def reason(error: Exception) -> str:
    """Return the type of an error and the first line of its message."""
    return f"{type(error).__name__}: {str(error).strip().splitlines()[0] if str(error) else ''}"


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
