"""ALIKED's keypoints and descriptors."""

import torch
from torch.nn.utils import convert_conv2d_weight_memory_format

from ..networks import ALIKED as MODELS
from ..networks import NETWORKS
from ..networks.keypoints import limit
from ..networks.loading import load_weights
from ..networks.noise import reduce_noise
from ..utils.cli import choose
from . import Extractor


class ALIKED(Extractor):
    """The features of ALIKED (Zhao et al., IEEE TIM 2023), by kornia.

    `model_name` is one of hloc's. Keypoints are those with the `max_keypoints` highest scores; -1
    keeps all. With `denoise`, noisy images are blurred first.
    """

    default_conf = {"model_name": "aliked-n16", "max_keypoints": 4096, "denoise": True}

    def _init(self, conf: dict) -> None:
        from kornia.feature import ALIKED as KorniaALIKED

        name = choose("model_name", conf["model_name"], MODELS)
        self.dim = NETWORKS[name].dim
        # a threshold of 0 keeps the highest scores, whatever they are
        model = KorniaALIKED(name, limit(conf["max_keypoints"]), detection_threshold=0.0)
        load_weights(model, name, model.extract_dense_map)
        # nearly twice as fast on a CPU
        self.model = convert_conv2d_weight_memory_format(model, torch.channels_last)

    @property
    def descriptor(self) -> str:
        """The name of these descriptors in the metadata of projections."""
        return self.conf["model_name"].removesuffix("-n16").replace("-", "_")

    def _forward(self, data: dict) -> dict:
        image = reduce_noise(data["image"]) if self.conf["denoise"] else data["image"]
        (found,) = self.model(image.contiguous(memory_format=torch.channels_last))
        return {
            "keypoints": found.keypoints[None],
            "scores": found.keypoint_scores[None],
            "descriptors": found.descriptors.T[None],
        }
