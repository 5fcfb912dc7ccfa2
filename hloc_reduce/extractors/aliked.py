"""ALIKED's keypoints and descriptors."""

import torch
from torch.nn.functional import grid_sample, max_pool2d
from torch.nn.utils import convert_conv2d_weight_memory_format

from ..networks import ALIKED as MODELS
from ..networks import NETWORKS
from ..networks.keypoints import limit, strongest_fixed
from ..networks.loading import load_weights
from ..utils.cli import choose
from . import NetworkExtractor


class ALIKED(NetworkExtractor):
    """The features of ALIKED (Zhao et al., IEEE TIM 2023), by kornia.

    `model_name` is one of hloc's. Keypoints are those with the `max_keypoints` highest scores; -1
    keeps all. With `denoise`, the noise of noisy images is reduced first.
    """

    stride = 32
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

    def _extract(self, image: torch.Tensor, mask: torch.Tensor | None) -> dict:
        image = image.expand(-1, 3, -1, -1).contiguous(memory_format=torch.channels_last)
        dense, score_map = self.model.extract_dense_map(image)
        if mask is not None:
            # scores around each pixel that is kept stay: they tell where its keypoint is
            around, radius = mask[None, None].float(), self.model.dkd.radius
            around = max_pool2d(around, 2 * radius + 1, stride=1, padding=radius)
            score_map = score_map * around
        found, scores, *_ = self.model.dkd(score_map)
        descriptors, _ = self.model.desc_head(dense, found)
        size = image.new_tensor(image.shape[:1:-1]) - 1
        return {
            "keypoints": size * (found[0] + 1)[None] / 2,
            "scores": scores[0][None],
            "descriptors": descriptors[0].T[None],
        }

    def fixed(self, image: torch.Tensor) -> dict:
        """Return the features of an image in tensors of fixed length, see `Extractor.fixed`."""
        height, width = image.shape[2:]
        dense, score_map = self.model.extract_dense_map(image)
        detector = self.model.dkd
        radius, number = detector.radius, self.conf["max_keypoints"]
        maxima, found = strongest_fixed(score_map[0, 0], radius, 0.0, radius, number)
        # the mean position in the window around a maximum, weighted by the scores
        steps = torch.arange(-radius, radius + 1, device=image.device)
        columns, rows = (maxima.long()[:, :, None] + steps).unbind(dim=1)
        window = score_map[0, 0][rows[:, :, None], columns[:, None]].flatten(1)
        weights = (window / detector.temperature).softmax(dim=1)
        keypoints = maxima + weights @ detector.get_buffer("hw_grid")
        size = torch.tensor([width - 1, height - 1], dtype=image.dtype, device=image.device)
        grid = keypoints / size * 2 - 1
        scores = grid_sample(score_map, grid[None, None], align_corners=True)[0, 0, 0]
        (descriptors,), _ = self.model.desc_head(dense, [grid])
        return {
            "keypoints": keypoints[None],
            "scores": torch.where(found > -torch.inf, scores, found)[None],
            "descriptors": descriptors.T[None],
        }
