"""A plugin for hloc, github.com/cvg/Hierarchical-Localization, of November 2025 or later."""

import copy
from collections.abc import Iterable
from pathlib import Path

import pycolmap
from packaging.version import Version

from .. import logger
from ..confs import features as features_confs
from ..confs import matchers as matchers_confs
from ..utils.cli import InputError
from ..utils.hloc import MIN_PYCOLMAP, extractors_package, import_module, parse_version

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


def warn() -> None:
    """Warn of a pycolmap with which hloc triangulates no point and does not say so."""
    if parse_version(pycolmap.__version__) >= NO_POINTS:
        logger.warning(
            "With pycolmap %s hloc's triangulation gives no points, and says nothing: use "
            "hloc_reduce.triangulation and hloc_reduce.localize_sfm, or pip install pycolmap==%s.",
            pycolmap.__version__,
            MIN_PYCOLMAP,
        )
