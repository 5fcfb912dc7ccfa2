"""Keypoints and descriptors of this project's own network."""

import torch

from ..networks import MINI, MINI_SIZE, fetch_weights
from ..networks.edgepoint2 import EdgePoint2 as Network
from ..networks.keypoints import refined
from ..networks.loading import load_file, output_size
from ..utils.cli import choose
from .edgepoint2 import EdgePoint2


class Mini(EdgePoint2):
    """A small network with EdgePoint2's architecture, trained for darkness, noise and codes.

    Keypoints are maxima between the pixels of the score map; their descriptors are those of whole
    pixels. `weights` is a file from `hloc_reduce.training.mini`; default: the weights that ship.
    The other options are those of `edgepoint2`.
    """

    default_conf = {**EdgePoint2.default_conf, "model_name": MINI[0], "weights": None}

    def _init(self, conf: dict) -> None:
        name = choose("model_name", conf["model_name"], MINI)
        weights, what = fetch_weights(name, conf["weights"]), f"The weights of {name}"
        self.dim = output_size(weights, Network.last, what)
        self.network = load_file(Network(MINI_SIZE, self.dim), weights, what)

    @property
    def descriptor(self) -> str:
        """The name of these descriptors in the metadata of projections."""
        return str(self.conf["model_name"])

    def _refined(self, keypoints: torch.Tensor, score_map: torch.Tensor) -> torch.Tensor:
        """Return keypoints (N, 2) moved to the maxima of a score map (H, W) between its pixels."""
        return refined(keypoints, score_map)
