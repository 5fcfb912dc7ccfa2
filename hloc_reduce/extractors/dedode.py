"""DeDoDe's keypoints and descriptors."""

import torch
from torch.nn.functional import normalize

from ..utils.cli import InputError
from . import Extractor


class DeDoDe(Extractor):
    """The features of DeDoDe (Edstedt et al., 3DV 2024), by kornia, which downloads the weights.

    `detector` and `weights` name the weights of the detector and of the descriptor, see
    `kornia.feature.DeDoDe.from_pretrained`. Keypoints are the `max_keypoints` likeliest ones.
    """

    default_conf = {"detector": "L-C4-v2", "weights": "B-upright", "max_keypoints": 4096}
    dim = 256

    def _init(self, conf: dict) -> None:
        from kornia.feature import DeDoDe as KorniaDeDoDe

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
        height, width = data["image"].shape[2:]
        number = min(self.conf["max_keypoints"], height * width)
        keypoints, scores, descriptors = self.model(data["image"], n=number)
        # whole pixels; kornia counts from the corner of the first one
        return {
            "keypoints": (keypoints - 0.5).round(),
            "scores": scores,
            "descriptors": normalize(descriptors, dim=2).mT,
        }
