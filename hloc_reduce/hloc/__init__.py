"""A plugin for hloc, github.com/cvg/Hierarchical-Localization, of November 2025 or later."""

import importlib
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import pycolmap
from packaging.version import Version

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


def register(features: Iterable[Path] = ()) -> list[str]:
    """Do what `hloc_reduce.register` says."""
    package, _ = extractors_package()
    if str(EXTRACTORS) not in package.__path__:
        package.__path__.append(str(EXTRACTORS))
        warn()
    own = dict(features_confs.get(str(file)) for file in features)
    offered = {
        "extract_features": {**features_confs.confs, **VLAD, **own},
        "match_features": matchers_confs.confs,
    }
    added = []
    for name, confs in offered.items():
        registered = _import(name).confs
        for key, conf in confs.items():
            if key not in registered:
                registered[key] = for_hloc(conf) if name == "extract_features" else conf
                added.append(key)
    return added


# hloc gives an extractor images only, so that its words are those of a map that ships
VLAD = {
    "vlad": {
        "output": "global-feats-vlad",
        "model": {"name": "vlad"},
        "preprocessing": features_confs.PREPROCESSING,
    }
}


def for_hloc(conf: dict) -> dict:
    """Return the configuration of a feature with the extractor that hloc knows it by."""
    model = conf["model"]
    if model["name"] in ("reduced", "vlad"):
        return conf
    return {**conf, "model": {"name": "reduced", "base": model}}


def is_installed() -> bool:
    """Tell whether there is an hloc to import."""
    return find_spec("hloc") is not None


def extractors_package() -> tuple[ModuleType, Callable]:
    """Return hloc's package of extractors and its `dynamic_load`.

    Raises:
        InputError: when hloc is missing, too old or cannot be imported.
    """
    if not is_installed():
        raise InputError(f"hloc is not installed: pip install {SOURCE}")
    hloc = importlib.import_module("hloc")
    version = getattr(hloc, "__version__", "0")
    wanted = getattr(hloc, "min_version", Version("0"))  # of pycolmap
    if Version(version) <= LAST_OLD and Version(str(wanted)) < MIN_PYCOLMAP:
        raise InputError(
            f"The installed hloc {version} is too old, it was written for a pycolmap before "
            f"{MIN_PYCOLMAP}: pip install --upgrade {SOURCE}"
        )
    return _import("extractors"), _import("utils.base_model").dynamic_load


def warn() -> None:
    """Warn of a pycolmap with which hloc triangulates no point and does not say so."""
    if Version(pycolmap.__version__) >= NO_POINTS:
        logger.warning(
            "With pycolmap %s hloc's triangulation gives no points, and says nothing: use "
            "hloc_reduce.triangulation and hloc_reduce.localize_sfm, or pip install pycolmap==%s.",
            pycolmap.__version__,
            MIN_PYCOLMAP,
        )


def _import(name: str) -> ModuleType:
    try:
        return importlib.import_module(f"hloc.{name}")
    except ImportError as error:
        raise InputError(f"hloc.{name} cannot be imported ({error}).") from None
