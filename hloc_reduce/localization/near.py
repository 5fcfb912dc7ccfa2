"""Where a photo was about taken: the map images that see the same, and the matches that fit."""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
import pycolmap

from ..utils import colmap
from ..utils.cli import InputError
from .references import Reference

# a photo is matched with this number of the map images, among these nearest ones, that see most of
# the points in its view
NUM_IMAGES, CANDIDATES = 8, 24
SOME_POINTS = 100  # of an image, by which that is told
FACING = 75.0  # degrees, at most, between the optical axes of such an image and of the photo
TURNED = 10.0  # degrees, at most, by which a guess may be turned
RADIUS = 0.2  # default of the radius of a guess, in median distances of the points in view
FAR = 3.0  # times how far the map reaches, beyond which a guess is of another frame


class Guess(NamedTuple):
    """A guess of a pose.

    Args:
        cam_from_world: the pose.
        radius: how far off its position may be, in the units of the map.
        images: map images that see the same, best first.
    """

    cam_from_world: pycolmap.Rigid3d
    radius: float
    images: list[str]

    def fits(
        self, points2D: np.ndarray, points3D: np.ndarray, camera: pycolmap.Camera
    ) -> np.ndarray:
        """Return which matches may be right if the guess is.

        Args:
            points2D: (M, 2) image points, COLMAP's pixels.
            points3D: (M, 3) their world points.
            camera: intrinsics.

        Returns:
            (M,) bool, whether a point is seen about where it would be from the guessed pose.
        """
        local = _local(points3D, self.cam_from_world)
        distance = np.maximum(np.linalg.norm(local, axis=1), 1e-9)
        rays = np.pad(colmap.cam_from_img(camera, points2D), ((0, 0), (0, 1)), constant_values=1)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        cosine = (rays * local).sum(axis=1) / distance
        allowed = np.deg2rad(TURNED) + np.arcsin(np.minimum(1.0, self.radius / distance))
        return cosine >= np.cos(np.minimum(allowed, np.pi))


class Surroundings:
    """The images of a map by their poses.

    Args:
        reference: the map.
        names: its images.
        views: returns their positions (I, 3) and optical axes (I, 3).
    """

    def __init__(
        self,
        reference: Reference,
        names: Sequence[str],
        views: Callable[[], tuple[np.ndarray, np.ndarray]],
    ):
        self._reference, self._names, self._read = reference, names, views
        self._some: dict[int, np.ndarray] = {}

    @cached_property
    def _views(self) -> tuple[np.ndarray, np.ndarray]:
        return self._read()

    def guess(
        self,
        cam_from_world: pycolmap.Rigid3d,
        radius: float | None,
        camera: pycolmap.Camera,
    ) -> Guess:
        """Return a guess with the images that see most of the points in its view.

        Args:
            cam_from_world: about the pose of the photo.
            radius: how far off its position may be, in the units of the map; default: a fifth of
                the median distance of the points in view.
            camera: intrinsics of the photo.

        Raises:
            InputError: for a radius that is not above 0.
        """
        if radius is not None and not 0 < radius < np.inf:
            raise InputError(f"radius is {radius}: a distance above 0, in the units of the map.")
        positions, axes = self._views
        world_from_cam = cam_from_world.inverse()
        distance = np.linalg.norm(positions - world_from_cam.translation, axis=1)
        facing = axes @ world_from_cam.rotation.matrix()[:, 2] >= np.cos(np.deg2rad(FACING))
        nearest = np.argsort(np.where(facing, distance, np.inf), kind="stable")[:CANDIDATES]
        seen = {i: self._in_view(i, cam_from_world, camera) for i in nearest if facing[i]}
        most = sorted(seen, key=lambda i: -len(seen[i]))[:NUM_IMAGES]
        best = [i for i in most if len(seen[i])]
        if radius is None:
            distances = np.concatenate([np.ones(0), *(seen[i] for i in best)])
            radius = RADIUS * float(np.median(distances)) if best else 0.0
        return Guess(cam_from_world, radius, [self._names[i] for i in best])

    def check(self, cam_from_world: pycolmap.Rigid3d) -> None:
        """Refuse a pose so far from the map that it must be of another frame.

        Raises:
            InputError: then.
        """
        distance, reach = self._distance_and_reach(cam_from_world)
        if not distance <= FAR * reach:
            raise InputError(
                f"near is {distance:.3g} units from the nearest image of the map, which reaches "
                f"{reach:.3g}: is it of another frame, or world from camera?"
            )

    def is_far(self, cam_from_world: pycolmap.Rigid3d) -> bool:
        """Tell whether `check` refuses a pose."""
        distance, reach = self._distance_and_reach(cam_from_world)
        return not distance <= FAR * reach

    def _distance_and_reach(self, cam_from_world: pycolmap.Rigid3d) -> tuple[float, float]:
        """Return the distance of a pose to the nearest image, and how far the map reaches."""
        positions, _ = self._views
        distance = np.linalg.norm(positions - cam_from_world.inverse().translation, axis=1)
        nearest = int(distance.argmin())
        points = self._points(nearest) - positions[nearest]
        depth = np.median(np.linalg.norm(points, axis=1)) if len(points) else 0.0
        extent = np.linalg.norm(np.ptp(positions, axis=0))
        return float(distance[nearest]), float(extent + depth)

    def _in_view(
        self, image: int, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera
    ) -> np.ndarray:
        """Return the distances of the points that show what an image sees and a pose does, too."""
        local = _local(self._points(image), cam_from_world)
        local = local[local[:, 2] > 0]
        if not len(local):
            return np.zeros(0)
        projected = camera.img_from_cam(local)
        inside = (projected >= 0) & (projected <= [camera.width, camera.height])
        return np.linalg.norm(local[inside.all(axis=1)], axis=1)

    def _points(self, image: int) -> np.ndarray:
        """Return some of the points of an image (P, 3)."""
        if image not in self._some:
            name = self._names[image]
            keypoints = np.arange(self._reference.num_keypoints(name))
            ids, points3D = self._reference.lift(name, keypoints)
            points3D = points3D[ids >= 0]
            self._some[image] = points3D[:: -(-len(points3D) // SOME_POINTS) or 1]
        return self._some[image]


def _local(points3D: np.ndarray, cam_from_world: pycolmap.Rigid3d) -> np.ndarray:
    """Return world points (M, 3) in the frame of a camera."""
    return points3D @ cam_from_world.rotation.matrix().T + cam_from_world.translation
