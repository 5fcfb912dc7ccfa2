"""XFeat's keypoints and descriptors."""

from collections.abc import Callable
from functools import partial

import torch
from torch.nn.functional import grid_sample, interpolate, normalize, pixel_shuffle

from ..networks import NETWORKS
from ..networks.keypoints import Keypoints, limit, refined, strongest, strongest_fixed
from ..networks.loading import load_weights
from . import NetworkExtractor

RADIUS = 2  # pixels between maxima of the scores


class XFeat(NetworkExtractor):
    """The sparse features of XFeat (Potje et al., CVPR 2024), whose network is kornia's.

    Keypoints are those with the `max_keypoints` highest scores; -1 keeps all. They are maxima
    between the pixels of the heatmap or, without `subpixel`, whole pixels of the resized image, as
    published; descriptors are those of whole pixels. With `denoise`, the noise of noisy images is
    reduced first.
    """

    default_conf = {
        "max_keypoints": 4096,
        "detection_threshold": 0.05,
        "subpixel": True,
        "denoise": True,
    }
    dim = NETWORKS["xfeat"].dim
    stride = 32
    cpu_images = 8  # 0.3 GB each

    def _init(self, conf: dict) -> None:
        from kornia.feature import XFeat as KorniaXFeat

        self.model = KorniaXFeat()
        load_weights(self.model.net, "xfeat")
        self.model.eval()

    def _extract(self, image: torch.Tensor, mask: torch.Tensor | None) -> dict:
        height, width = (max(side // self.stride, 1) * self.stride for side in image.shape[2:])
        resized = interpolate(image, (height, width), mode="bilinear", align_corners=False)
        found = self._compute(resized, partial(self._strongest, mask=mask))
        size = image.new_tensor(image.shape[:1:-1])
        scale = size / size.new_tensor([width, height])
        return {**found, "keypoints": (found["keypoints"] + 0.5) * scale - 0.5}

    def fixed(self, image: torch.Tensor) -> dict:
        """Return the features of an image in tensors of fixed length, see `Extractor.fixed`."""
        return self._compute(image, self._strongest_fixed)

    def _compute(self, image: torch.Tensor, select: Callable[..., Keypoints]) -> dict:
        """Return the features of an image whose sides are multiples of `stride`."""
        dense, logits, reliability = self.model.net(image)
        heatmap = pixel_shuffle(logits.softmax(dim=1)[:, :-1], 8)[0, 0]
        keypoints, scores = select(heatmap, reliability)
        grid = self._grid(keypoints, heatmap)
        descriptors = grid_sample(
            normalize(dense, dim=1), grid, mode="bicubic", align_corners=False
        )
        if self.conf["subpixel"]:
            keypoints = refined(keypoints, heatmap)
        return {
            "keypoints": keypoints[None],
            "scores": scores[None],
            "descriptors": normalize(descriptors[:, :, 0], dim=1),
        }

    def _strongest(
        self, heatmap: torch.Tensor, reliability: torch.Tensor, mask: torch.Tensor | None
    ) -> Keypoints:
        """Return the maxima of a heatmap (H, W) with the highest products with the reliability."""
        threshold, number = self.conf["detection_threshold"], limit(self.conf["max_keypoints"])
        keypoints, scores = strongest(heatmap, RADIUS, threshold, RADIUS, -1, mask)
        grid = self._grid(keypoints, heatmap)
        scores = scores * grid_sample(reliability, grid, align_corners=False)[0, 0, 0]
        scores, order = scores.topk(min(number, len(scores)))
        return keypoints[order], scores

    def _strongest_fixed(self, heatmap: torch.Tensor, reliability: torch.Tensor) -> Keypoints:
        """Return the keypoints of `_strongest` in tensors of fixed length."""
        x, y = (torch.arange(side, device=heatmap.device) for side in heatmap.shape[::-1])
        pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
        weights = grid_sample(reliability, self._grid(pixels, heatmap)[0], align_corners=False)
        threshold, number = self.conf["detection_threshold"], self.conf["max_keypoints"]
        return strongest_fixed(heatmap, RADIUS, threshold, RADIUS, number, weights[0, 0])

    def _grid(self, pixels: torch.Tensor, heatmap: torch.Tensor) -> torch.Tensor:
        """Return where kornia samples maps at pixels (..., 2) x, y of an image."""
        grid = self.model.interpolator.normgrid(pixels.to(heatmap.dtype), *heatmap.shape)
        return grid[None, None]
