"""Keypoints and descriptors of this project's own network."""

from ..networks import MINI, NETWORKS, fetch_weights
from ..networks.edgepoint2 import EdgePoint2 as Network
from ..networks.loading import load_file
from ..utils.cli import choose
from .edgepoint2 import EdgePoint2

SIZE = "M"  # of EdgePoint2's architecture


class Mini(EdgePoint2):
    """A small network with EdgePoint2's architecture, trained for darkness, noise and codes.

    `weights` is a file of `hloc_reduce.training.mini`, for a network of one's own. Its other
    options are those of `edgepoint2`.
    """

    default_conf = {**EdgePoint2.default_conf, "model_name": MINI[0], "weights": None}

    def _init(self, conf: dict) -> None:
        name = choose("model_name", conf["model_name"], MINI)
        self.dim = NETWORKS[name].dim
        weights = fetch_weights(name, conf["weights"])
        self.network = load_file(Network(SIZE, self.dim), weights, f"The weights of {name}")

    @property
    def descriptor(self) -> str:
        """The name of these descriptors in the metadata of projections."""
        return str(self.conf["model_name"])
