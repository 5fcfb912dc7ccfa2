"""A toy extractor, as CONTRIBUTING.md says: one file, one class, `_forward`."""

import torch

from hloc_reduce.extractors import Extractor


class Corners(Extractor):
    """Four keypoints at the corners of an image, described by its mean grey value and a number."""

    default_conf = {"margin": 2}

    def _forward(self, data: dict) -> dict:
        image, margin = data["image"], self.conf["margin"]
        height, width = image.shape[-2:]
        corners = [
            (x, y) for y in (margin, height - 1 - margin) for x in (margin, width - 1 - margin)
        ]
        descriptors = torch.eye(4, device=image.device) + image.mean()
        return {
            "keypoints": torch.tensor([corners], dtype=torch.float32, device=image.device),
            "descriptors": torch.nn.functional.normalize(descriptors, dim=0)[None],
        }
