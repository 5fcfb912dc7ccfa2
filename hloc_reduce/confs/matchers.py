"""Matchers, by hloc's names."""

from collections import ChainMap
from pathlib import Path

from .. import projections
from ..networks import lightglue as weights_of
from ..networks.lightglue import LIGHTGLUE
from ..utils.cli import InputError
from ..utils.files import file_sha256
from .features import base_of, matcher_of, network_of


def fast_of(matcher: str, feature: dict) -> str:
    """Return the first matcher of NN+lightglue in a map.

    Args:
        matcher: of the map.
        feature: the configuration of its feature.
    """
    is_lightglue = confs[matcher]["model"]["name"] == "lightglue"
    return matcher_of(feature) if is_lightglue else matcher


def steps_of(matcher: str, fast: str) -> tuple[str, ...]:
    """Return the matchers that queries are tried with, one after the other, keys of `confs`.

    Args:
        matcher: one of `names`.
        fast: the first matcher of NN+lightglue.
    """
    return (fast, "lightglue") if matcher == NN_LIGHTGLUE else (matcher,)


def steps_in(of_map: str, feature: dict, matcher: str | None = None) -> tuple[str, ...]:
    """Return the matchers that queries are tried with in a map, keys of `confs`.

    Args:
        of_map: the matcher of the map.
        feature: the configuration of its feature.
        matcher: one of `names`; default: that of the map.
    """
    return steps_of(matcher or of_map, fast_of(of_map, feature))


def all_of(feature: dict) -> list[str]:
    """Return the matchers that suit the configuration of a feature, the default first."""
    has_weights = features_of(feature["model"]) in weights_of.known()
    return [matcher_of(feature), *(["lightglue", NN_LIGHTGLUE] if has_weights else [])]


def lightglue(features: str) -> dict:
    """Return the configuration of LightGlue for one kind of features."""
    return {
        "output": f"matches-{features}-lightglue",
        "model": {"name": "lightglue", "features": features},
    }


def features_of(model: dict) -> str | None:
    """Return what LightGlue calls the features of a model's configuration, None for {}."""
    if projection := model.get("projection"):
        file, prefix = projections.split_prefix(projection)
        return Path(file).name.removesuffix(".safetensors") + (prefix and f"@{prefix}")
    if not model:
        return None
    base = base_of(model)
    name = network_of(model) or base.get("descriptor") or str(base.get("name"))
    return name.removeprefix("hloc.").removesuffix("-n16")


def for_features(model: dict, made_from: dict) -> dict:
    """Return the configuration of a matcher for some features: LightGlue's weights depend on them.

    Args:
        model: of the matcher, as in `confs`.
        made_from: what the features are made from, see `extract_features.provenance`; {} if that is
            unknown.

    Raises:
        InputError: for features that LightGlue has no weights for.
    """
    if model["name"] != "lightglue":
        return model
    name, given = features_of(made_from.get("model", {})), model.get("features")
    if given and name not in (None, given):
        raise InputError(f"The matcher {given}+lightglue is not for {name}: choose lightglue.")
    if given:
        return model
    if name not in weights_of.known():
        raise weights_of.unknown(name or "features of unknown origin")
    trained_for = {} if name in LIGHTGLUE else weights_of.metadata_of(name)["made_from"]
    if any(made_from.get(key) != value for key, value in trained_for.items()):
        file = weights_of.file_of(name)
        if file.parent == weights_of.own():
            raise InputError(
                f"{file} was fitted to another {name}: fit it again with "
                "python -m hloc_reduce.training.adapters."
            )
        raise InputError(
            f"The weights of lightglue for {name} are for the {name} that ships with this package, "
            "not for this one."
        )
    return {**model, "features": name}


def provenance(model: dict, made_from: dict) -> dict:
    """Return what determines the matches of some features beside the configuration of a matcher.

    Args:
        model: as in `for_features`.
        made_from: as in `for_features`.

    Returns:
        `weights_sha256` of an adapter or a network for a mini, else {}.

    Raises:
        InputError: for features that LightGlue has no weights for.
    """
    features = for_features(model, made_from).get("features")
    if model["name"] != "lightglue" or features not in weights_of.fitted():
        return {}
    return {"weights_sha256": file_sha256(weights_of.file_of(features))}


def _ratio(threshold: float) -> dict:
    return {
        "output": f"matches-NN-mutual-ratio{threshold:g}".replace("0.", "."),
        "model": {"name": "nearest_neighbor", "ratio_threshold": threshold},
    }


confs: dict[str, dict] = {
    "NN-ratio": _ratio(0.8),
    "NN-ratio85": _ratio(0.85),
    "NN-ratio90": _ratio(0.9),
    "NN-ratio95": _ratio(0.95),
    "NN-mutual": {
        "output": "matches-NN-mutual",
        "model": {"name": "nearest_neighbor"},
    },
    "adalam": {"output": "matches-adalam", "model": {"name": "adalam"}},
    # for the features of the file, and hloc's for one kind of features
    "lightglue": {
        "output": "matches-lightglue",
        "model": {"name": "lightglue", "max_keypoints": 2048},
    },
    **{f"{name}+lightglue": lightglue(name) for name in LIGHTGLUE},
}

# the matcher of the map, or the feature's own, and lightglue for queries that it does not localize
NN_LIGHTGLUE = "NN+lightglue"
names = ChainMap(confs, {NN_LIGHTGLUE: {}})  # that pipelines take; others may be added to confs

# the models of other matches of hloc, by what it calls their files
OF_HLOC = {
    "matches-superglue": {"name": "superglue"},
    "matches-superglue-it5": {"name": "superglue"},
    "matches-NN-mutual-dist.7": {"name": "nearest_neighbor", "distance_threshold": 0.7},
}
