"""Descriptors of keypoints in a photo and in photometric variants of it, as seen and mirrored."""

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from .. import extractors
from ..descriptors import COLMAP_SIFT, DIM
from ..descriptors.model import Descriptor
from ..extractors.dog import extract_patches
from .loop import device

VARIANTS = 4  # the photo and three photometric variants, each as seen and mirrored
MAX_SHIFT = 1.5  # pixels between a keypoint of the photo and the same one of a variant
NUM_CANDIDATES = 4  # for it


class PatchDescriber:
    """Describes keypoints by the patches around them, in a photo and its variants."""

    def __init__(self, descriptor: str):
        self.describe = Descriptor(descriptor).to(device())

    @torch.no_grad()
    def __call__(
        self,
        image: torch.Tensor,
        keypoints: np.ndarray,
        known: np.ndarray,
        generator: np.random.Generator,
    ) -> np.ndarray:
        """Describe the keypoints of a photo.

        Args:
            image: (1, 1, H, W) float32 in [0, 1].
            keypoints: (N, 4) x, y, scale (pixels), orientation (degrees).
            known: not used.
            generator: draws the variants.

        Returns:
            (N, 2, VARIANTS, D) float16: as seen and mirrored.
        """
        described = np.empty((len(keypoints), 2, VARIANTS, DIM), np.float16)
        photo = image[0, 0].numpy()
        for variant in range(VARIANTS):
            view = photometric_variant(photo, generator) if variant else photo
            patches = extract_patches(torch.from_numpy(view)[None, None], keypoints)
            described[:, :, variant] = describe_mirrored(patches, self.describe)
        return described


class FeatureDescriber:
    """Describes keypoints by an extractor, which detects them again in each variant."""

    def __init__(self, model: dict):
        self.extract = extractors.load(model).eval().to(device())
        self.mirror = MIRRORS.get(self.extract.descriptor, np.copy)

    @torch.no_grad()
    def __call__(
        self,
        image: torch.Tensor,
        keypoints: np.ndarray,
        known: np.ndarray,
        generator: np.random.Generator,
    ) -> np.ndarray:
        """Describe the keypoints of a photo (1, C, H, W) as `PatchDescriber` does.

        A keypoint that is not found within `MAX_SHIFT` pixels in a variant keeps its `known`
        descriptor (N, D). Only COLMAP's SIFT is mirrored; of others both views are as seen.
        """
        described = np.repeat(known[:, None, None].astype(np.float16), VARIANTS, axis=2)
        photo = image[0].numpy().transpose(1, 2, 0)
        for variant in range(1, VARIANTS):
            view = np.atleast_3d(photometric_variant(photo, generator)).transpose(2, 0, 1)
            features = self.extract({"image": torch.from_numpy(view.copy())[None].to(device())})
            found = features["keypoints"][0].cpu().numpy()
            if not len(found):
                continue
            descriptors = features["descriptors"][0].T.cpu().numpy()
            # several keypoints may lie at one place with different orientations: take the best
            distance, near = cKDTree(found).query(
                keypoints[:, :2], k=range(1, NUM_CANDIDATES + 1), distance_upper_bound=MAX_SHIFT
            )
            candidates = descriptors[np.minimum(near, len(found) - 1)]
            likeness = np.einsum("nkd,nd->nk", candidates, known.astype(np.float32))
            best = np.where(np.isfinite(distance), likeness, -np.inf).argmax(axis=1)
            again = np.isfinite(distance[:, 0])
            described[again, 0, variant] = candidates[again, best[again]]
        return np.concatenate([described, self.mirror(described)], axis=1)


def mirror_colmap_sift(descriptors: np.ndarray) -> np.ndarray:
    """Mirror COLMAP's SIFT descriptors (..., 128) as `describe_mirrored` does patches."""
    bins = descriptors.reshape(*descriptors.shape[:-1], 4, 4, 8)  # rows, columns, orientations
    mirrored = np.roll(bins[..., ::-1, :, ::-1], 1, axis=-1)  # orientation 0 stays
    return mirrored.reshape(descriptors.shape)


MIRRORS = {COLMAP_SIFT: mirror_colmap_sift}


def describe_mirrored(patches: torch.Tensor, describe: Descriptor) -> np.ndarray:
    """Describe patches (N, 1, 32, 32) as seen and mirrored, (N, 2, 128) float32.

    They are mirrored across the axis of the keypoint's orientation, which stays the same.
    """
    views = (patches.to(device()), patches.flip(2).to(device()))
    return np.stack([describe(view).cpu().numpy() for view in views], axis=1)


def photometric_variant(image: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Draw another photo of the same under other light: darker or brighter, blurred, noisy, 8 bit.

    Args:
        image: (H, W) or (H, W, C) float32 in [0, 1].
        generator: draws gamma 0.5-2, gain 0.08-1.2, blur up to 1.5 px and noise up to 2 %.

    Returns:
        Like the image, without the last axis if C is 1.
    """
    gamma = 2 ** generator.uniform(-1, 1)
    gain = np.exp(generator.uniform(np.log(0.08), np.log(1.2)))
    view = gain * image**gamma
    blur = generator.uniform(-1.5, 1.5)
    if blur > 0.3:
        view = cv2.GaussianBlur(view, (0, 0), blur)
    noise = generator.uniform(0, 0.02) * np.sqrt(gain)  # less light, less shot noise
    view = view + noise * generator.standard_normal(view.shape, np.float32)
    return (np.round(view.clip(0, 1) * 255) / 255).astype(np.float32)
