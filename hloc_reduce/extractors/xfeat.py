"""XFeat's keypoints and descriptors."""

import torch
from torch.nn.functional import grid_sample, normalize, pixel_shuffle

from ..networks import NETWORKS
from ..networks.keypoints import limit, strongest_fixed
from ..networks.loading import load_weights
from . import NetworkExtractor

RADIUS = 2  # pixels between maxima of the scores


class XFeat(NetworkExtractor):
    """The sparse features of XFeat (Potje et al., CVPR 2024), by kornia.

    Keypoints are those with the `max_keypoints` highest scores, in whole pixels of the resized
    image; -1 keeps all. With `denoise`, the noise of noisy images is reduced first.
    """

    default_conf = {"max_keypoints": 4096, "detection_threshold": 0.05, "denoise": True}
    dim = NETWORKS["xfeat"].dim
    stride = 32

    def _init(self, conf: dict) -> None:
        from kornia.feature import XFeat as KorniaXFeat

        self.model = KorniaXFeat(limit(conf["max_keypoints"]), conf["detection_threshold"])
        load_weights(self.model.net, "xfeat")
        self.model.eval()

    def _extract(self, image: torch.Tensor) -> dict:
        (found,) = self.model.detectAndCompute(image)
        size = torch.tensor(image.shape[:1:-1])
        resized = (size // 32 * 32).clamp(min=32)
        # kornia scales keypoints about the corner of the first pixel, not about its centre
        shift = (size / resized - 1) / 2
        return {
            "keypoints": (found["keypoints"] + shift.to(image.device))[None],
            "scores": found["scores"][None],
            "descriptors": found["descriptors"].T[None],
        }

    def fixed(self, image: torch.Tensor) -> dict:
        """Return the features of an image in tensors of fixed length, see `Extractor.fixed`."""
        height, width = image.shape[2:]
        dense, logits, reliability = self.model.net(image)
        x, y = (torch.arange(side, device=image.device) for side in (width, height))
        pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
        weights = grid_sample(reliability, self._grid(pixels[None], image), align_corners=False)
        keypoints, scores = strongest_fixed(
            pixel_shuffle(logits.softmax(dim=1)[:, :-1], 8)[0, 0],
            RADIUS,
            self.conf["detection_threshold"],
            RADIUS,
            self.conf["max_keypoints"],
            weights[0, 0],
        )
        descriptors = grid_sample(
            normalize(dense, dim=1),
            self._grid(keypoints[None, None], image),
            mode="bicubic",
            align_corners=False,
        )
        return {
            "keypoints": keypoints[None],
            "scores": scores[None],
            "descriptors": normalize(descriptors[:, :, 0], dim=1),
        }

    def _grid(self, pixels: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
        """Return where kornia samples maps at pixels (..., 2) x, y of an image."""
        return self.model.interpolator.normgrid(pixels.to(image.dtype), *image.shape[2:])
