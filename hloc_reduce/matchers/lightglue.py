"""LightGlue: a network that matches by descriptors and positions, by kornia, as in hloc."""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch.nn.functional import pad

from ..confs.matchers import WEIGHTS, features_of, lightglue_weights
from ..networks import LIGHTGLUE, download
from ..networks.loading import read_weights
from ..utils.cli import InputError
from .base import Matcher

CHECKSUMS = ("projection_sha256", "weights_sha256")  # in the provenance of features
CONSTANT = "confidence_thresholds"  # a buffer that published weights lack
# the names of XFeat's weights begin with the first; those of its extractor, with the second
PREFIX, OTHERS = "matcher.", "extractor."
OPTIONS = ("depth_confidence", "width_confidence", "filter_threshold")  # of kornia


class LightGlue(Matcher):
    """The matches of hloc's `lightglue` (Lindenberger et al., ICCV 2023), with its options.

    `features` names what it matches: features with published weights, a key of
    `networks.LIGHTGLUE`, or of a file in `weights`, which has an adapter, a first layer for
    projected descriptors, or a whole network. Default: those of the feature file. Only the first
    `max_keypoints` of an image are matched, the best ones of a network; None for all. Other options
    that are None are kornia's.
    """

    required_inputs = tuple(
        f"{key}{i}" for i in (0, 1) for key in ("keypoints", "descriptors", "image_size")
    )
    default_conf = {"features": None, "max_keypoints": None, **dict.fromkeys(OPTIONS)}

    @classmethod
    def for_features(cls, conf: dict, made_from: dict) -> dict:
        """Return the configuration for features, see `Matcher.for_features`."""
        if conf.get("features"):
            return conf
        name = features_of(made_from.get("model", {}))
        if name not in _known():
            raise _unknown(name or "features of unknown origin")
        trained_for = metadata_of(name)["made_from"] if name not in LIGHTGLUE else {}
        if any(made_from.get(key) != value for key, value in trained_for.items()):
            raise InputError(
                f"The weights of lightglue for {name} are for the {name} that ships with this "
                "package, not for this one."
            )
        return {**conf, "features": name}

    def _init(self, conf: dict) -> None:
        from kornia.feature import LightGlue as KorniaLightGlue

        features = conf["features"]
        if not features:
            raise InputError("lightglue needs `features`, whose weights it takes.")
        network = features if features in LIGHTGLUE else metadata_of(features)["network"]
        own = {} if features in LIGHTGLUE else read_weights(_file(features), _what(features))
        settings: dict[str, Any] = {**KorniaLightGlue.features[network], "weights": None}
        settings |= {key: conf[key] for key in OPTIONS if conf[key] is not None}
        if own:
            settings["input_dim"] = own["input_proj.weight"].shape[1]
        no_features: Any = None  # whose settings would win over these
        self.net = KorniaLightGlue(no_features, **settings)
        needed = set(self.net.state_dict()) - {CONSTANT}
        weights = own if own.keys() >= needed else {**published(network), **own}
        try:
            missing, unexpected = self.net.load_state_dict(
                {key: value.float() for key, value in weights.items()}, strict=False
            )
        except RuntimeError:
            missing, unexpected = [features], []
        if unexpected or set(missing) - {CONSTANT}:
            raise InputError(f"{_what(features)} are those of another network.")
        self.net.eval().requires_grad_(False)

    def _forward(self, data: dict) -> dict:
        number = self.conf["max_keypoints"]
        given = {
            f"image{i}": {
                "keypoints": data[f"keypoints{i}"][:, :number].clamp(
                    data[f"image_size{i}"].new_zeros(1), data[f"image_size{i}"][:, None]
                ),
                "descriptors": data[f"descriptors{i}"][..., :number].mT,
                "image_size": data[f"image_size{i}"],
            }
            for i in (0, 1)
        }
        found = self.net(given)
        others = data["keypoints0"].shape[1] - found["matches0"].shape[1]  # that are not matched
        return {
            "matches0": pad(found["matches0"], (0, others), value=-1),
            "matching_scores0": pad(found["matching_scores0"], (0, others)),
        }


def identity(made_from: dict) -> dict:
    """Return what of a provenance tells features of one name apart: checksums of weights."""
    return {key: value for key, value in made_from.items() if key in CHECKSUMS}


def metadata_of(features: str) -> dict:
    """Return the metadata of a file in `weights`.

    Returns:
        `network`, a key of `networks.LIGHTGLUE`, and `made_from`, the `identity` of its features.

    Raises:
        InputError: when there is no such file, or it is broken.
    """
    try:
        with safe_open(_file(features), "pt") as file:
            metadata = file.metadata() or {}
        return {"network": metadata["network"], "made_from": json.loads(metadata["made_from"])}
    except FileNotFoundError:
        raise _unknown(features) from None
    except (OSError, SafetensorError, KeyError, ValueError):
        raise InputError(f"{_what(features)} are broken.") from None


def published(network: str) -> dict[str, torch.Tensor]:
    """Return the published weights of a key of `networks.LIGHTGLUE`, by kornia's names.

    Raises:
        InputError: when they cannot be downloaded, or are broken.
    """
    what = f"The weights of lightglue for {network}"
    weights = read_weights(download(LIGHTGLUE[network], what), what)
    return {_renamed(key): value for key, value in weights.items() if not key.startswith(OTHERS)}


def _renamed(name: str) -> str:
    """Return kornia's name of a tensor."""
    name = name.removeprefix(PREFIX)
    block, _, rest = name.partition(".")
    if block not in ("self_attn", "cross_attn"):
        return name
    number, _, rest = rest.partition(".")
    return f"transformers.{number}.{block}.{rest}"


def _known() -> list[str]:
    return sorted({*LIGHTGLUE, *lightglue_weights()})


def _unknown(features: str) -> InputError:
    return InputError(
        f"lightglue has no weights for {features}, only for {', '.join(_known())}: choose another "
        "matcher or feature."
    )


def _file(features: str) -> Path:
    return WEIGHTS / f"{Path(features).name}.safetensors"


def _what(features: str) -> str:
    return f"The weights of lightglue for {features}"
