"""Exact features and matches of photos of random points, by any camera."""

from pathlib import Path

import cv2
import h5py
import numpy as np
import pycolmap

from hloc_reduce import match_features
from hloc_reduce.utils import parsers


def write(
    root: Path, poses: dict[str, pycolmap.Rigid3d], camera: pycolmap.Camera, reach: float = 1.0
) -> tuple[Path, Path, Path, Path]:
    """Write photos of 300 points in a cube around the origin, their features, and all matches.

    Args:
        root: the folder.
        poses: of the photos, camera from world, by name.
        camera: of all photos.
        reach: half of the side of the cube.

    Returns:
        The folder of the photos, and the files of pairs, features and matches.
    """
    generator = np.random.default_rng(1)
    points = generator.uniform(-reach, reach, (300, 3))
    descriptors = generator.standard_normal((300, 64))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    blank = np.full((camera.height, camera.width), 99, np.uint8)
    features, photo = root / "features.h5", cv2.imencode(".jpg", blank)[1]
    with h5py.File(features, "w") as file:
        for name, pose in poses.items():
            pixels = camera.img_from_cam(points @ pose.rotation.matrix().T + pose.translation)
            order = generator.permutation(len(points))
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
