"""LightGlue: a network that matches by descriptors and positions, by kornia, as in hloc."""

import re
from typing import Any

import torch
from torch.nn.functional import pad

from ..networks import download
from ..networks import lightglue as weights_of
from ..networks.lightglue import LIGHTGLUE
from ..networks.loading import read_weights
from ..utils.cli import InputError
from .base import Matcher

CONSTANT = "confidence_thresholds"  # a buffer that published weights lack
PREFIX = "matcher."  # of the names of XFeat's weights
# tensors of published weights that matching does not use: XFeat's extractor, scalars of DISK's
UNUSED = re.compile(r"extractor\..*|log_assignment\.\d+\.r")
OPTIONS = ("depth_confidence", "width_confidence", "filter_threshold")  # of kornia


class LightGlue(Matcher):
    """The matches of hloc's `lightglue` (Lindenberger et al., ICCV 2023), with its options.

    `features` names what it matches, see `networks.lightglue`: features with published weights, or
    with a file that has an adapter, a first layer for projected descriptors, or a whole network.
    Only the first `max_keypoints` of an image are matched, the best ones of a network; None for
    all. Other options that are None are kornia's.
    """

    required_inputs = tuple(
        f"{key}{i}" for i in (0, 1) for key in ("keypoints", "descriptors", "image_size")
    )
    default_conf = {"features": None, "max_keypoints": None, **dict.fromkeys(OPTIONS)}

    def _init(self, conf: dict) -> None:
        from kornia.feature import LightGlue as KorniaLightGlue

        features = conf["features"]
        if not features:
            raise InputError("lightglue needs `features`, whose weights it takes.")
        what = weights_of.what(features)
        network = features if features in LIGHTGLUE else weights_of.metadata_of(features)["network"]
        own = {} if features in LIGHTGLUE else read_weights(weights_of.file_of(features), what)
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
            raise InputError(f"{what} are those of another network.")
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


class Graph(torch.nn.Module):
    """LightGlue in a traced graph: all layers, all keypoints.

    Attributes:
        dim: of the descriptors.
    """

    def __init__(self, matcher: LightGlue):
        super().__init__()
        self.net = matcher.net
        layer = self.net.input_proj
        self.dim: int = getattr(layer, "in_features", self.net.conf.descriptor_dim)

    def forward(
        self,
        keypoints0: torch.Tensor,
        descriptors0: torch.Tensor,
        image_size0: torch.Tensor,
        keypoints1: torch.Tensor,
        descriptors1: torch.Tensor,
        image_size1: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Match two images.

        Args:
            keypoints0: (N, 2) x, y in pixels, centres at integers.
            descriptors0: (N, D) of unit norm.
            image_size0: (2,) width, height.
            keypoints1: (M, 2).
            descriptors1: (M, D).
            image_size1: (2,).

        Returns:
            matches0 (N,) int64, the index in 1 or -1, and matching_scores0 (N,).
        """
        from kornia.feature.lightglue import filter_matches, normalize_keypoints

        tokens, encodings = [], []
        for keypoints, descriptors, size in (
            (keypoints0, descriptors0, image_size0),
            (keypoints1, descriptors1, image_size1),
        ):
            inside = torch.minimum(keypoints.clamp(min=0), size)
            encodings.append(self.net.posenc(normalize_keypoints(inside[None], size[None])))
            tokens.append(self.net.input_proj(descriptors[None]))
        for layer in self.net.transformers:
            tokens = layer(*tokens, *encodings)
        assignment, _ = self.net.log_assignment[-1](*tokens)
        matches, _, scores, _ = filter_matches(assignment, self.net.conf.filter_threshold)
        return matches[0], scores[0]


def published(network: str) -> dict[str, torch.Tensor]:
    """Return the published weights of a key of `LIGHTGLUE`, by kornia's names.

    Raises:
        InputError: when they cannot be downloaded, or are broken.
    """
    what = weights_of.what(network)
    weights = read_weights(download(LIGHTGLUE[network], what), what)
    return {_renamed(key): value for key, value in weights.items() if not UNUSED.fullmatch(key)}


def _renamed(name: str) -> str:
    """Return kornia's name of a tensor."""
    name = name.removeprefix(PREFIX)
    block, _, rest = name.partition(".")
    if block not in ("self_attn", "cross_attn"):
        return name
    number, _, rest = rest.partition(".")
    return f"transformers.{number}.{block}.{rest}"
