"""XFeat's keypoints and descriptors."""

import torch

from ..networks import NETWORKS
from ..networks.keypoints import limit
from ..networks.loading import load_weights
from ..networks.noise import reduce_noise
from . import Extractor


class XFeat(Extractor):
    """The sparse features of XFeat (Potje et al., CVPR 2024), by kornia.

    Keypoints are those with the `max_keypoints` highest scores, in whole pixels of the resized
    image; -1 keeps all. With `denoise`, noisy images are blurred first.
    """

    default_conf = {"max_keypoints": 4096, "detection_threshold": 0.05, "denoise": True}
    dim = NETWORKS["xfeat"].dim

    def _init(self, conf: dict) -> None:
        from kornia.feature import XFeat as KorniaXFeat

        self.model = KorniaXFeat(limit(conf["max_keypoints"]), conf["detection_threshold"])
        load_weights(self.model.net, "xfeat")
        self.model.eval()

    def _forward(self, data: dict) -> dict:
        image = reduce_noise(data["image"]) if self.conf["denoise"] else data["image"]
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
