"""Exact features and matches of photos of points, by any camera."""

from pathlib import Path

import cv2
import h5py
import numpy as np
import pycolmap

from hloc_reduce import match_features
from hloc_reduce.utils import parsers


def write(
    root: Path, poses: dict[str, pycolmap.Rigid3d], camera: pycolmap.Camera, points: np.ndarray
) -> tuple[Path, Path, Path, Path]:
    """Write photos of points, their features, and all matches.

    Args:
        root: the folder.
        poses: of the photos, camera from world, by name.
        camera: of all photos.
        points: (P, 3); photos show those in front of them and within their size.

    Returns:
        The folder of the photos, and the files of pairs, features and matches.
    """
    generator = np.random.default_rng(1)
    descriptors = generator.standard_normal((len(points), 64))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    blank = np.full((camera.height, camera.width), 99, np.uint8)
    features, photo = root / "features.h5", cv2.imencode(".jpg", blank)[1]
    with h5py.File(features, "w") as file:
        for name, pose in poses.items():
            local = points @ pose.rotation.matrix().T + pose.translation
            pixels = camera.img_from_cam(local)
            inside = (pixels > 0).all(axis=1) & (pixels < [camera.width, camera.height]).all(axis=1)
            order = generator.permutation(np.flatnonzero(inside & (local[:, 2] > 0.1)))
            group = file.create_group(name)
            group["keypoints"] = (pixels[order] - 0.5).astype(np.float32)
            group["descriptors"] = descriptors[order].T.astype(np.float16)
            path = root / "images" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(photo.tobytes())
    pairs, matches, names = root / "pairs.txt", root / "matches.h5", sorted(poses)
    parsers.write_pairs([(a, b) for a in names for b in names if a < b], pairs)
    match_features.main(match_features.confs["NN-ratio"], pairs, features, matches=matches)
    return root / "images", pairs, features, matches
