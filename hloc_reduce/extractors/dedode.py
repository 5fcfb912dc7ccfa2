"""DeDoDe's keypoints and descriptors."""

import torch
from torch.nn.functional import normalize

from ..utils.cli import InputError
from . import Extractor


class DeDoDe(Extractor):
    """The features of DeDoDe (Edstedt et al., 3DV 2024), by kornia, which downloads the weights.

    `detector` and `weights` name the weights of the detector and of the descriptor, see
    `kornia.feature.DeDoDe.from_pretrained`. Keypoints are the `max_keypoints` likeliest pixels;
    masked ones are dropped afterwards, as kornia takes no mask.
    """

    default_conf = {"detector": "L-C4-v2", "weights": "B-upright", "max_keypoints": 4096}
    dim = 256

    def _init(self, conf: dict) -> None:
        from kornia.feature import DeDoDe as KorniaDeDoDe

        if conf["max_keypoints"] < 1:
            raise InputError(f"max_keypoints of DeDoDe is {conf['max_keypoints']}: at least 1.")
        names = conf["detector"], conf["weights"]
        try:
            self.model = KorniaDeDoDe.from_pretrained(*names, amp_dtype=torch.float32)
        except (OSError, RuntimeError, ValueError, KeyError) as error:
            raise InputError(
                f"The weights {' and '.join(names)} of DeDoDe cannot be loaded: {error}"
            ) from None

    @property
    def descriptor(self) -> str:
        """The name of these descriptors in the metadata of projections."""
        return f"dedode.{self.conf['weights']}"

    def _forward(self, data: dict) -> dict:
        image = data["image"].expand(-1, 3, -1, -1)  # of gray photos, too
        number = min(self.conf["max_keypoints"], image[0, 0].numel())
        keypoints, scores, descriptors = self.model(image, n=number)
        # whole pixels; kornia counts from the corner of the first one
        return {
            "keypoints": (keypoints - 0.5).round(),
            "scores": scores,
            "descriptors": normalize(descriptors, dim=2).mT,
        }
