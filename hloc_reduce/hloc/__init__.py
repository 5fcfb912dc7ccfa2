"""A plugin for hloc, github.com/cvg/Hierarchical-Localization, of December 2025 or later."""

import copy
from collections.abc import Iterable
from pathlib import Path

import pycolmap
from packaging.version import Version

from .. import logger
from ..confs import features as features_confs
from ..confs import matchers as matchers_confs
from ..networks import lightglue
from ..utils.cli import InputError
from ..utils.hloc import MIN_PYCOLMAP, extractors_package, import_module, parse_version

# this pycolmap and later ones skip geometries of undefined configuration, which all of hloc's have
NO_POINTS = Version("4.2.1")
EXTRACTORS, MATCHERS = (Path(__file__).parent / name for name in ("extractors", "matchers"))
VLAD_CONF = {
    "output": "global-feats-vlad",
    "model": {"name": "vlad"},
    "preprocessing": features_confs.PREPROCESSING,
}


def register(features: Iterable[Path] | Path = ()) -> list[str]:
    """Register this project with hloc, see `hloc_reduce.register`."""
    if isinstance(features, str | Path):
        features = [features]
    package, _ = extractors_package()
    if str(EXTRACTORS) not in package.__path__:
        package.__path__.append(str(EXTRACTORS))
        import_module("matchers").__path__.append(str(MATCHERS))
        warn()
    offered = {name: for_hloc(conf) for name, conf in features_confs.confs.items()}
    offered["vlad"] = VLAD_CONF
    registered = import_module("extract_features").confs
    for file in features:
        name, conf = features_confs.get(str(file))
        conf = offered[name] = for_hloc(conf)
        if registered.get(name, conf) != conf:
            raise InputError(f"hloc has a feature {name} already: rename {file}.")
    known = import_module("match_features").confs
    return _add(offered, registered) + _add(_matchers(), known)


def _matchers() -> dict[str, dict]:
    """Return the matchers for hloc: of LightGlue, one for each projection with an adapter."""
    confs = {key: conf for key, conf in matchers_confs.confs.items() if key != "lightglue"}
    for features in lightglue.fitted():
        conf = matchers_confs.lightglue(features)
        model = {**conf["model"], "name": "reduced_lightglue"}
        confs.setdefault(f"{features}+lightglue", {**conf, "model": model})
    return confs


def _add(offered: dict[str, dict], registered: dict[str, dict]) -> list[str]:
    """Add the confs with new names, and return these names."""
    added = [name for name in offered if name not in registered]
    # copies, because users of hloc change its confs
    registered.update({name: copy.deepcopy(offered[name]) for name in added})
    return added


def for_hloc(conf: dict) -> dict:
    """Return the configuration of a feature with the extractor's name in hloc."""
    model = conf["model"]
    if model["name"] == "reduced":
        return conf
    return {**conf, "model": {"name": "reduced", "base": model}}


def warn() -> None:
    """Warn about a pycolmap with which hloc silently triangulates no points."""
    if parse_version(pycolmap.__version__) >= NO_POINTS:
        logger.warning(
            "With pycolmap %s hloc's triangulation silently gives no points: use "
            "hloc_reduce.triangulation and hloc_reduce.localize_sfm, or pip install pycolmap==%s.",
            pycolmap.__version__,
            MIN_PYCOLMAP,
        )
