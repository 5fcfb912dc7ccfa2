"""COLMAP's SIFT on the CPU."""

import json
import threading
from typing import Any

import numpy as np
import pycolmap

from .databases import parse_options


def detect_dog(image: np.ndarray, options: dict) -> tuple[np.ndarray, np.ndarray]:
    """Detect and describe keypoints with COLMAP's SIFT on the CPU, in one thread.

    Args:
        image: (H, W) float32 in [0, 1].
        options: pycolmap's SiftExtractionOptions.

    Returns:
        Keypoints (N, 4) float32: x, y with pixel centres at integers, scale in pixels, orientation
        in degrees from x towards y; and COLMAP's descriptors (N, 128) float32, unit norm.
    """
    extractor: Any = _sift_extractor(json.dumps(options, sort_keys=True))
    if hasattr(extractor, "extract_from_float32_array"):  # pycolmap 4
        found, described = extractor.extract_from_float32_array(image)
        keypoints = np.array(
            [(k.x, k.y, k.compute_scale(), k.compute_orientation()) for k in found], np.float32
        )
        descriptors = described.data.astype(np.float32)
    else:
        keypoints, descriptors = extractor.extract(image)
    x_y, scale, orientation = np.split(keypoints.reshape(-1, 4), [2, 3], axis=1)
    descriptors = descriptors.reshape(-1, 128)
    norm = np.linalg.norm(descriptors, axis=1, keepdims=True)
    # COLMAP's origin is the corner
    return (
        np.concatenate([x_y - 0.5, scale, np.rad2deg(orientation)], axis=1),
        np.divide(descriptors, norm, out=np.zeros_like(descriptors), where=norm > 0),
    )


_thread = threading.local()


def _sift_extractor(options: str) -> "pycolmap.FeatureExtractor":
    """Return an extractor for this thread: COLMAP's have state.

    Only the last one is kept: its pyramid of an image at twice its size takes half a gigabyte.
    """
    if getattr(_thread, "options", None) != options:
        _thread.extractor = _thread.options = None  # free it before another is created
        extraction = _extraction_options(json.loads(options))
        new = hasattr(pycolmap, "FeatureExtractor")  # pycolmap 4
        make = pycolmap.FeatureExtractor.create if new else pycolmap.Sift
        _thread.extractor, _thread.options = make(extraction, pycolmap.Device.cpu), options
    return _thread.extractor


def check_dog_options(options: dict) -> None:
    """Raise an InputError for an unknown option of `detect_dog`."""
    _extraction_options(options)


def _extraction_options(options: dict) -> pycolmap.FeatureExtractionOptions:
    sift = parse_options(pycolmap.SiftExtractionOptions, options, "DoG")
    return pycolmap.FeatureExtractionOptions(sift=sift)
