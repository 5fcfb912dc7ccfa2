"""DoG keypoints by COLMAP's SIFT and a base descriptor of the patches around them."""

import numpy as np
import torch
from kornia.feature.laf import extract_patches_from_pyramid, laf_from_center_scale_ori

from .. import colmap
from ..base_model import BaseModel
from ..cli import InputError
from ..descriptors import PATCH_SIZE, Descriptor


def extract_patches(
    image: torch.Tensor, keypoints: np.ndarray, mr_size: float = 12.0
) -> torch.Tensor:
    """Cut the oriented patches around keypoints out of an image pyramid.

    Args:
        image: (1, 1, H, W) float in [0, 1].
        keypoints: (N, 4) x, y (pixels, centres at integers), scale (pixels), orientation
            (degrees, from x towards y).
        mr_size: the side of a patch in units of the keypoint's scale.

    Returns:
        (N, 1, 32, 32) float32 in [0, 1].
    """
    x_y, scale, orientation = torch.from_numpy(keypoints.astype(np.float32)).split([2, 1, 1], 1)
    lafs = laf_from_center_scale_ori(
        x_y[None], scale[None, ..., None] * mr_size / 2, -orientation[None]
    )
    return extract_patches_from_pyramid(image, lafs.to(image.device), PS=PATCH_SIZE)[0]


class DoG(BaseModel):
    """hloc's `dog`: DoG keypoints of COLMAP and descriptors of 32x32 patches.

    Unlike hloc's it stores keypoints with pixel centres at integers whatever pycolmap says, gives
    each keypoint a score, its scale (COLMAP's own ranking), and honours `max_keypoints`.
    """

    default_conf = {
        "options": {"first_octave": 0, "peak_threshold": 0.01},
        "descriptor": "sift",
        "max_keypoints": -1,
        "mr_size": 12,
    }
    required_inputs = ("image",)
    detection_noise = 1.0

    def _init(self, conf: dict) -> None:
        self.describe = Descriptor(conf["descriptor"])
        colmap.dog_detector(conf["options"])  # refuses wrong options
        self.detect = None  # made for the first image, so that the model can be copied before

    @property
    def descriptor(self) -> str:
        """The name that a projection of these descriptors is kept under."""
        return self.conf["descriptor"]

    def _forward(self, data: dict) -> dict:
        image = data["image"]
        if image.shape[1] != 1:
            raise InputError("DoG needs grey images: preprocessing: {grayscale: true}.")
        if self.detect is None:
            self.detect = colmap.dog_detector(self.conf["options"])
        keypoints = self.detect(image[0, 0].cpu().numpy())
        if self.conf["max_keypoints"] >= 0:
            order = np.argsort(-keypoints[:, 2], kind="stable")
            keypoints = keypoints[order[: self.conf["max_keypoints"]]]
        descriptors = self.describe(extract_patches(image, keypoints, self.conf["mr_size"]))
        x_y, scales, oris = np.split(keypoints, [2, 3], axis=1)
        return {
            "keypoints": torch.from_numpy(x_y)[None],
            "scales": torch.from_numpy(scales[:, 0])[None],
            "oris": torch.from_numpy(oris[:, 0])[None],
            "scores": torch.from_numpy(scales[:, 0])[None],
            "descriptors": descriptors.T[None],
        }
