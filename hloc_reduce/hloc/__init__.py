"""A plugin for hloc, github.com/cvg/Hierarchical-Localization, of November 2025 or later."""

import copy
import importlib
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import pycolmap
from packaging.version import InvalidVersion, Version

from confs import features as features_confs
from confs import matchers as matchers_confs

from .. import logger
from ..cli import InputError

SOURCE = "git+https://github.com/cvg/Hierarchical-Localization"
# hloc is 1.5 since 2023; the first one with the pycolmap that this project needs says so itself
LAST_OLD = Version("1.5")
MIN_PYCOLMAP = Version("3.13.0")
# from this pycolmap on geometries whose configuration is undefined are skipped: hloc's all are
NO_POINTS = Version("4.2.1")
EXTRACTORS = Path(__file__).parent / "extractors"
VLAD = {
    "output": "global-feats-vlad",
    "model": {"name": "vlad"},
    "preprocessing": features_confs.PREPROCESSING,
}


def register(features: Iterable[Path] | Path = ()) -> list[str]:
    """Do what `hloc_reduce.register` says."""
    if isinstance(features, str | Path):
        features = [features]
    package, _ = extractors_package()
    if str(EXTRACTORS) not in package.__path__:
        package.__path__.append(str(EXTRACTORS))
        warn()
    offered = {name: for_hloc(conf) for name, conf in features_confs.confs.items()}
    offered["vlad"] = VLAD
    registered = import_module("extract_features").confs
    for file in features:
        name, conf = features_confs.get(str(file))
        conf = offered[name] = for_hloc(conf)
        if registered.get(name, conf) != conf:
            raise InputError(f"hloc has a feature {name} already: rename {file}.")
    return _add(offered, registered) + _add(
        matchers_confs.confs, import_module("match_features").confs
    )


def _add(offered: dict[str, dict], registered: dict[str, dict]) -> list[str]:
    """Add the confs whose names are new, and return these."""
    added = [name for name in offered if name not in registered]
    # copies, as hloc's users change their confs
    registered.update({name: copy.deepcopy(offered[name]) for name in added})
    return added


def for_hloc(conf: dict) -> dict:
    """Return the configuration of a feature with the extractor that hloc knows it by."""
    model = conf["model"]
    if model["name"] == "reduced":
        return conf
    return {**conf, "model": {"name": "reduced", "base": model}}


def is_installed() -> bool:
    """Tell whether there is an hloc to import."""
    spec = find_spec("hloc")
    return spec is not None and spec.origin is not None  # a folder of that name is none


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
    if _number(version) <= LAST_OLD and _number(wanted) < MIN_PYCOLMAP:
        raise InputError(
            f"The installed hloc {version} is too old, it was written for a pycolmap before "
            f"{MIN_PYCOLMAP}: pip install --upgrade {SOURCE}"
        )
    return import_module("extractors"), import_module("utils.base_model").dynamic_load


def warn() -> None:
    """Warn of a pycolmap with which hloc triangulates no point and does not say so."""
    if _number(pycolmap.__version__) >= NO_POINTS:
        logger.warning(
            "With pycolmap %s hloc's triangulation gives no points, and says nothing: use "
            "hloc_reduce.triangulation and hloc_reduce.localize_sfm, or pip install pycolmap==%s.",
            pycolmap.__version__,
            MIN_PYCOLMAP,
        )


def _number(version: str) -> Version:
    """Parse a version; one of a development build, such as `dev`, is the newest."""
    try:
        return Version(version)
    except InvalidVersion:
        return Version("9999")


def import_module(name: str) -> ModuleType:
    """Import a module of hloc's by its name there, or hloc itself by "".

    Raises:
        InputError: when it cannot be imported.
    """
    path = f"hloc.{name}".strip(".")
    try:
        return importlib.import_module(path)
    except Exception as error:  # also of what hloc imports: torchvision raises RuntimeError
        raise InputError(f"{path} cannot be imported ({error}).") from None
