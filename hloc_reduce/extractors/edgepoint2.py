"""EdgePoint2's keypoints and descriptors."""

from collections.abc import Callable
from functools import partial

import torch
from torch.nn.functional import grid_sample, interpolate, normalize

from ..networks import EDGEPOINT2, NETWORKS
from ..networks.edgepoint2 import EdgePoint2 as Network
from ..networks.keypoints import Keypoints, strongest, strongest_fixed
from ..networks.loading import load_weights
from ..utils.cli import choose
from . import NetworkExtractor

RADIUS = 2  # pixels between maxima of the scores
MIN_SCORE = -5.0  # logit
BORDER = 4  # pixels without keypoints


class EdgePoint2(NetworkExtractor):
    """The features of EdgePoint2 (github.com/HITCSC/EdgePoint2).

    `model_name` is a size of the network, T to E, and the dimension of its descriptors: M32, for
    example. Keypoints are the maxima of its score map, in whole pixels of the resized image, the
    `max_keypoints` highest ones; -1 keeps all. With `denoise`, noise is reduced first.
    """

    stride = Network.stride
    cpu_images = 8  # 0.3 GB each
    default_conf = {"model_name": "M32", "max_keypoints": 4096, "denoise": True}

    def _init(self, conf: dict) -> None:
        name = choose("model_name", conf["model_name"], EDGEPOINT2)
        self.dim = NETWORKS[name].dim
        self.network = load_weights(Network(name[0], self.dim), name)

    @property
    def descriptor(self) -> str:
        """The name of these descriptors in the metadata of projections."""
        return f"edgepoint2_{self.conf['model_name'].lower()}"

    def _extract(self, image: torch.Tensor, mask: torch.Tensor | None) -> dict:
        given = image.shape[:1:-1]
        width, height = (max(1, side // Network.stride) * Network.stride for side in given)
        if (width, height) != tuple(given):
            image = interpolate(image, (height, width), mode="bilinear", align_corners=True)
        found = self._compute(image, partial(strongest, mask=mask))
        ratio = found["keypoints"].new_tensor(given) / image.new_tensor([width, height])
        return {**found, "keypoints": found["keypoints"] * ratio}

    def fixed(self, image: torch.Tensor) -> dict:
        """Return the features of an image in tensors of fixed length, see `Extractor.fixed`."""
        return self._compute(image, strongest_fixed)

    def _refined(self, keypoints: torch.Tensor, score_map: torch.Tensor) -> torch.Tensor:
        """Return keypoints (N, 2) in whole pixels of a score map (H, W), as they are."""
        return keypoints

    def _compute(self, image: torch.Tensor, select: Callable[..., Keypoints]) -> dict:
        """Return the features of an image whose sides are multiples of `stride`."""
        dense, score_map = self.network(image)
        keypoints, scores = select(
            score_map[0, 0], RADIUS, MIN_SCORE, BORDER, self.conf["max_keypoints"]
        )
        size = torch.tensor(image.shape[:1:-1], dtype=image.dtype, device=image.device)
        grid = (keypoints + 0.5) / size * 2 - 1
        descriptors = grid_sample(dense, grid[None, None], align_corners=False)[0, :, 0]
        return {
            "keypoints": self._refined(keypoints, score_map[0, 0])[None],
            "scores": scores[None],
            "descriptors": normalize(descriptors, dim=0)[None],
        }
