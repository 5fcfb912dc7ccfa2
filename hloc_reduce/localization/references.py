"""Maps to localize in: the 3D points that keypoints of images show."""

import hashlib
from collections.abc import Mapping
from functools import lru_cache
from typing import Protocol

import h5py
import numpy as np
import pycolmap

from ..datasets import scans
from ..utils import colmap
from ..utils.cli import InputError
from ..utils.feature_files import get_image_size, get_keypoints
from ..utils.h5 import get_dataset, reading


class Reference(Protocol):
    """A map: the 3D points that the keypoints of its images show."""

    def __contains__(self, name: str) -> bool:
        """Return whether it has an image."""

    def num_keypoints(self, name: str) -> int:
        """Return how many keypoints an image has."""

    def lift(self, name: str, keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the points that keypoints (M,) of an image show.

        Returns:
            Their ids (M,) int64, -1 where there is none, and coordinates (M, 3).
        """

    def clusters(self, names: list[str]) -> list[list[str]]:
        """Split images, one at least, into those whose points are matched together."""

    def fallback(self, names: list[str]) -> pycolmap.Rigid3d | None:
        """Return what to say of a query without a pose, by its images, best first, if any."""


CACHED_IMAGES = 128  # points of so many cutouts stay in memory: 25 MB at 8,000 keypoints


def point_group(features: h5py.File, name: str) -> str:
    """Return the group of the points of a cutout, which is named by its keypoints, too.

    So features that have the same keypoints share their points, and others do not.
    """
    keypoints, _ = get_keypoints(features, name)
    size = np.array(get_image_size(features, name))
    return f"{name}/{hashlib.sha256(size.tobytes() + keypoints.tobytes()).hexdigest()[:16]}"


class ScanMap:
    """Keypoints of cutouts and the points that they show, as a `localization.Reference`.

    Args:
        file: open h5 file of `lift_keypoints`.
        features: open feature file.
        poses: from cutout to the pose of its scan, floor from scan (4, 4).
    """

    def __init__(self, file: h5py.File, features: h5py.File, poses: Mapping[str, np.ndarray]):
        self.file, self.features, self.poses = file, features, poses
        self.points = lru_cache(CACHED_IMAGES)(self._read)
        # by name, so that no order of queries or cutouts changes anything
        self.numbers = {name: number for number, name in enumerate(sorted(poses))}

    def _read(self, name: str) -> np.ndarray:
        group = point_group(self.features, name)
        with reading(self.file.filename):
            found = group in self.file
        if not found:
            raise InputError(
                f"{self.file.filename} is not of the keypoints of {name} that are now in "
                f"{self.features.filename}: localize anew."
            )
        points = get_dataset(self.file, group, "points3D")[()].astype(np.float64)
        pose = self.poses[name]
        return points @ pose[:3, :3].T + pose[:3, 3]

    def __contains__(self, name: str) -> bool:
        return name in self.numbers

    def num_keypoints(self, name: str) -> int:
        """Return how many keypoints a cutout has."""
        return get_dataset(self.features, name, "keypoints").shape[0]

    def lift(self, name: str, keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the ids and coordinates of the points that keypoints of a cutout show.

        Every keypoint of every cutout has a point of its own.
        """
        points = self.points(name)[keypoints]
        ids = (self.numbers[name] << 32) + keypoints
        return np.where(np.isfinite(points[:, 0]), ids, -1), points

    def clusters(self, names: list[str]) -> list[list[str]]:
        """Split cutouts by floor, the floor of the first one first."""
        floors: dict[str, list[str]] = {}
        for name in names:
            floors.setdefault(scans.floor_of(name), []).append(name)
        return list(floors.values())

    def fallback(self, names: list[str]) -> None:
        """Return None: a cutout has no pose."""


class SfmMap:
    """A COLMAP model to localize in, as a `localization.Reference`.

    Args:
        reconstruction: the model.
        covisibility_clustering: match each cluster of images that see common points by itself.

    Raises:
        InputError: when it has no point.
    """

    def __init__(
        self, reconstruction: pycolmap.Reconstruction, covisibility_clustering: bool = False
    ):
        if reconstruction.num_points3D() == 0:
            raise InputError("The map is empty: no query can be localized in it.")
        self.covisibility_clustering = covisibility_clustering
        self.images = {image.name: image for image in reconstruction.images.values()}
        ids = np.array(sorted(reconstruction.point3D_ids()), np.int64)
        self.point_ids = ids
        self.points = np.array([reconstruction.points3D[i].xyz for i in ids])
        self._rows: dict[str, np.ndarray] = {}

    def __contains__(self, name: str) -> bool:
        return name in self.images

    def num_keypoints(self, name: str) -> int:
        """Return how many keypoints an image has."""
        return self.images[name].num_points2D()

    def point_rows(self, name: str) -> np.ndarray:
        """Return for each keypoint of an image the row of `points` (N,), -1 where none."""
        if name not in self._rows:
            ids = colmap.point3D_ids(self.images[name])
            self._rows[name] = np.where(ids >= 0, np.searchsorted(self.point_ids, ids), -1)
        return self._rows[name]

    def lift(self, name: str, keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the ids and coordinates of the points that keypoints of an image show."""
        rows = self.point_rows(name)[keypoints]
        return np.where(rows >= 0, self.point_ids[rows], -1), self.points[rows]

    def clusters(self, names: list[str]) -> list[list[str]]:
        """Split images into clusters that see no common point, the largest first."""
        if not self.covisibility_clustering:
            return [names]
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        rows = [self.point_rows(name) for name in names]
        image = np.repeat(np.arange(len(rows)), [len(part) for part in rows])
        point = np.concatenate(rows)
        seen = coo_array(
            (np.ones((point >= 0).sum()), (image[point >= 0], point[point >= 0])),
            shape=(len(rows), len(self.points)),
        ).tocsr()
        number, label = connected_components(seen @ seen.T, directed=False)
        clusters = [[] for _ in range(number)]
        for name, cluster in zip(names, label, strict=True):
            clusters[cluster].append(name)
        return sorted(clusters, key=len, reverse=True)

    def fallback(self, names: list[str]) -> pycolmap.Rigid3d:
        """Return the pose of the first of some images, or of the first of all."""
        return self.images[names[0] if names else min(self.images)].cam_from_world()
