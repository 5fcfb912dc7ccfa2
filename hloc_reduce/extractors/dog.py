"""DoG keypoints of COLMAP or OpenCV, with their SIFT or a base descriptor of patches."""

import cv2
import numpy as np
import torch
from torch.nn.functional import grid_sample

from ..descriptors import BASE_DESCRIPTORS, COLMAP_SIFT, PATCH_SIZE
from ..descriptors.model import Descriptor
from ..detectors import dog
from ..utils.cli import InputError, choose
from . import Detect, Extractor


def extract_patches(
    image: torch.Tensor, keypoints: np.ndarray, mr_size: float = 12.0
) -> torch.Tensor:
    """Sample oriented patches around keypoints from an image pyramid.

    Equal to kornia's `extract_patches_from_pyramid`, and several times faster on a CPU.

    Args:
        image: (1, 1, H, W) float in [0, 1].
        keypoints: (N, 4) x, y (pixels, centres at integers), scale (pixels), orientation
            (degrees, from x towards y).
        mr_size: side of a patch in units of the keypoint's scale.

    Returns:
        (N, 1, 32, 32) float32 in [0, 1].
    """
    levels = pyramid(image[0, 0].cpu().numpy())
    x_y, scale, orientation = np.split(keypoints.astype(np.float32), [2, 3], axis=1)
    half_width, angle = scale * mr_size / 2, np.deg2rad(orientation)
    level = np.log2(2 * half_width[:, 0] / PATCH_SIZE).clip(0, len(levels) - 1).astype(int)
    # vectors from the centre of a patch to its right and lower sides, in pixels of the image
    right = half_width * np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
    down = right[:, ::-1] * [-1, 1]
    steps = ((torch.arange(PATCH_SIZE) + 0.5) * (2 / PATCH_SIZE) - 1).to(image.device)
    patches = image.new_empty(len(keypoints), 1, PATCH_SIZE, PATCH_SIZE)
    size = np.array(image.shape[:1:-1])
    for number, pixels in enumerate(levels):
        rows = np.flatnonzero(level == number)
        # grid_sample's coordinates: -1 and 1 are the borders of the image at every level
        centre, across, along = (
            torch.from_numpy((2 * part[rows] / size).astype(np.float32)).to(image.device)
            for part in (x_y + 0.5, right, down)
        )
        grid = (
            (centre - 1)[:, None, None]
            + along[:, None, None] * steps[:, None, None]
            + across[:, None, None] * steps[:, None]
        )
        patches[rows] = grid_sample(
            torch.from_numpy(pixels)[None, None].to(image.device),
            grid.flatten(0, 1)[None],
            padding_mode="border",
            align_corners=False,
        ).view(-1, 1, PATCH_SIZE, PATCH_SIZE)
    return patches


def pyramid(image: np.ndarray) -> list[np.ndarray]:
    """Halve an image (H, W) float32 repeatedly, while a patch fits into it."""
    levels = [image]
    kernel = np.array([1, 4, 6, 4, 1], np.float32) / 16
    while min(levels[-1].shape) // 2 >= PATCH_SIZE:
        blurred = cv2.sepFilter2D(levels[-1], -1, kernel, kernel, borderType=cv2.BORDER_REFLECT_101)
        height, width = blurred.shape
        levels.append(cv2.resize(blurred, (width // 2, height // 2)))
    return levels


class DoG(Extractor):
    """hloc's `dog`: DoG keypoints of COLMAP, or of OpenCV, and descriptors of 32x32 patches.

    The descriptor `colmap_sift` is COLMAP's SIFT, which needs no patches. Unlike hloc's `dog` this
    one stores keypoints with pixel centres at integers for every version of pycolmap, scores each
    keypoint by its scale, as COLMAP ranks them, and honours `max_keypoints`.

    `keypoints` names the settings of DoG: "adaptive" uses hloc's, and others in photos where these
    find too few (`detectors.dog.detect`); "colmap" uses COLMAP's, which find several times as many,
    with the same fallback; "hloc" uses hloc's for every photo; "fast" finds them by OpenCV, whose
    descriptors take the place of COLMAP's. `options` that differ from hloc's override `keypoints`.
    """

    default_conf = dog.DEFAULT_CONF
    detection_noise = dog.KEYPOINT_UNCERTAINTY_PIXELS
    detect: Detect

    def _init(self, conf: dict) -> None:
        descriptor = choose("descriptor", conf["descriptor"], BASE_DESCRIPTORS)
        self.describe = None if descriptor == COLMAP_SIFT else Descriptor(descriptor)
        self.detect = dog.detector(conf)
        self.detection_blocks = not dog.is_fast(conf)
        self.rotation_invariant = self.is_rotation_invariant(conf)

    @classmethod
    def is_rotation_invariant(cls, conf: dict) -> bool:
        """Tell whether keypoints have orientations of their own."""
        return dog.is_rotation_invariant({**cls.default_conf, **conf})

    @property
    def descriptor(self) -> str:
        """The name of these descriptors in the metadata of projections."""
        return self.conf["descriptor"]

    @property
    def detection(self) -> dict:
        """What determines the keypoints."""
        return {key: value for key, value in super().detection.items() if key != "descriptor"}

    def _forward(self, data: dict) -> dict:
        """Describe the `detected` keypoints of an image (1, 1, H, W), by default detect them."""
        image = data["image"]
        if image.shape[1] != 1:
            raise InputError("DoG needs grey images: preprocessing: {grayscale: true}.")
        keypoints, descriptors = data.get("detected") or self.detect(image[0, 0].cpu().numpy())
        keypoints, descriptors = dog.strongest(keypoints, descriptors, self.conf["max_keypoints"])
        if self.describe is None:
            descriptors = torch.from_numpy(descriptors).to(image.device)
        else:
            descriptors = self.describe(extract_patches(image, keypoints, self.conf["mr_size"]))
        x_y, scales, oris = np.split(keypoints, [2, 3], axis=1)
        return {
            "keypoints": torch.from_numpy(x_y)[None],
            "scales": torch.from_numpy(scales[:, 0])[None],
            "oris": torch.from_numpy(oris[:, 0])[None],
            "scores": torch.from_numpy(scales[:, 0])[None],
            "descriptors": descriptors.T[None],
        }
