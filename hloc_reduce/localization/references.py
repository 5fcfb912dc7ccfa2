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

CACHED_IMAGES = 128  # cutouts whose points stay in memory: 25 MB at 8,000 keypoints


class Reference(Protocol):
    """A map: the 3D points that the keypoints of its images show."""

    def __contains__(self, name: str) -> bool:
        """Return whether it has an image."""

    def num_keypoints(self, name: str) -> int:
        """Return the number of keypoints of an image."""

    def lift(self, name: str, keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the points that keypoints (M,) of an image show.

        Returns:
            Their ids (M,) int64, -1 if there is none, and coordinates (M, 3).
        """

    def clusters(self, names: list[str]) -> list[list[str]]:
        """Split images, at least one, into clusters that queries are localized in separately."""

    def floors(self, names: list[str]) -> list[list[str]]:
        """Split images, at least one, into those whose points have a common frame."""

    def fallback(self, names: list[str]) -> pycolmap.Rigid3d | None:
        """Return the pose for a query that was not localized, from its images, best first."""


class SfmMap:
    """A COLMAP model, as a `Reference`.

    Args:
        reconstruction: the model.
        covisibility_clustering: split images into clusters that see common points.

    Raises:
        InputError: if it has no point.
    """

    def __init__(
        self, reconstruction: pycolmap.Reconstruction, covisibility_clustering: bool = False
    ):
        if reconstruction.num_points3D() == 0:
            raise InputError("The map is empty: no query can be localized in it.")
        self.covisibility_clustering = covisibility_clustering
        self.images = {image.name: image for image in reconstruction.images.values()}
        self.point_ids = np.array(sorted(reconstruction.point3D_ids()), np.int64)
        self.points = np.array([reconstruction.points3D[i].xyz for i in self.point_ids])
        self._rows: dict[str, np.ndarray] = {}

    def __contains__(self, name: str) -> bool:
        return name in self.images

    def num_keypoints(self, name: str) -> int:
        """Return the number of keypoints of an image."""
        return self.images[name].num_points2D()

    def point_rows(self, name: str) -> np.ndarray:
        """Return for each keypoint of an image its row of `points` (N,), -1 if it has none."""
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
        point = np.concatenate(rows)
        image = np.repeat(np.arange(len(rows)), list(map(len, rows)))[point >= 0]
        edges = image, len(names) + point[point >= 0]
        size = len(names) + len(self.points)
        graph = coo_array((np.ones(len(image)), edges), shape=(size, size))
        label = connected_components(graph, directed=False)[1][: len(names)]
        clusters: dict[int, list[str]] = {}
        for name, cluster in zip(names, label, strict=True):
            clusters.setdefault(cluster, []).append(name)
        return sorted(clusters.values(), key=len, reverse=True)

    def floors(self, names: list[str]) -> list[list[str]]:
        """Return all images together: a model has one frame."""
        return [names]

    def fallback(self, names: list[str]) -> pycolmap.Rigid3d:
        """Return the pose of the first of some images, or without them of the first of all."""
        return self.images[names[0] if names else min(self.images)].cam_from_world()

    def views(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions (I, 3) and the optical axes (I, 3) of the images by name."""
        poses = [self.images[name].cam_from_world().inverse() for name in sorted(self.images)]
        axes = [pose.rotation.matrix()[:, 2] for pose in poses]
        return np.array([pose.translation for pose in poses]), np.array(axes)


class ScanMap:
    """Cutouts with scans, as a `Reference`.

    Args:
        file: open h5 file from `lift_keypoints`.
        features: open feature file.
        poses: from cutout to the pose of its scan, floor from scan (4, 4).
    """

    def __init__(self, file: h5py.File, features: h5py.File, poses: Mapping[str, np.ndarray]):
        self.file, self.features, self.poses = file, features, poses
        self.points = lru_cache(CACHED_IMAGES)(self._read)
        # sorted, so that the order of queries and cutouts does not matter
        self.numbers = {name: number for number, name in enumerate(sorted(poses))}

    def _read(self, name: str) -> np.ndarray:
        group = point_group(self.features, name)
        with reading(self.file.filename):
            found = group in self.file
        if not found:
            raise InputError(
                f"{self.file.filename} has no points of the present keypoints of {name} in "
                f"{self.features.filename}: localize again."
            )
        stored, pose = get_dataset(self.file, group, "points3D"), self.poses[name]
        points = stored[()].astype(np.float64) + stored.attrs.get("origin", 0.0)
        return points @ pose[:3, :3].T + pose[:3, 3]

    def __contains__(self, name: str) -> bool:
        return name in self.numbers

    def num_keypoints(self, name: str) -> int:
        """Return the number of keypoints of a cutout."""
        return get_dataset(self.features, name, "keypoints").shape[0]

    def lift(self, name: str, keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the ids and coordinates of the points that keypoints of a cutout show.

        Every keypoint of every cutout has a point of its own.
        """
        points = self.points(name)[keypoints]
        ids = (self.numbers[name] << 32) + keypoints
        return np.where(np.isfinite(points[:, 0]), ids, -1), points

    def clusters(self, names: list[str]) -> list[list[str]]:
        """Split cutouts as `floors` does."""
        return self.floors(names)

    def floors(self, names: list[str]) -> list[list[str]]:
        """Split cutouts by floor, the floor of the first one first."""
        floors: dict[str, list[str]] = {}
        for name in names:
            floors.setdefault(scans.floor_of(name), []).append(name)
        return list(floors.values())

    def fallback(self, names: list[str]) -> None:
        """Return None: a cutout has no pose."""


def point_group(features: h5py.File, name: str) -> str:
    """Return the name of the h5 group of a cutout's points, with a digest of its keypoints.

    Feature files with the same keypoints share the points.
    """
    keypoints, _ = get_keypoints(features, name)
    size = np.array(get_image_size(features, name))
    return f"{name}/{hashlib.sha256(size.tobytes() + keypoints.tobytes()).hexdigest()[:16]}"
