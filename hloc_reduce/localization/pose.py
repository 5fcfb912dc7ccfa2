"""A pose with the matches that agree with it, and how poses compare."""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from . import gate
from .measures import Measures, Uncertainty
from .projection import POSE

MAX_ERROR = 12.0  # pixels, pycolmap's default
OF_SIZE = {"of_map": True, "by_size": True}  # options of a photo by a lens of the map's photos


@dataclass(frozen=True)
class Pose:
    """A pose and how the matches agree with it.

    Args:
        cam_from_world: the pose, None if there is none.
        camera: intrinsics, estimated if the configuration says so.
        inliers: (M,) bool.
        confidence: -log10 of the number of such poses that are expected by chance.
        degrees_of_freedom: the number of estimated parameters, see `projection`.
        measures: all that `gate` needs.
        refusal: why it is not trusted, None if it is.
        precision: how precisely its inliers fix it, even without those that tell most about it;
            None if that is not known.
    """

    cam_from_world: pycolmap.Rigid3d | None
    camera: pycolmap.Camera
    inliers: np.ndarray
    confidence: float = -np.inf
    degrees_of_freedom: int = POSE
    measures: Measures = Measures()
    refusal: str | None = None
    precision: Uncertainty | None = None

    @property
    def num_inliers(self) -> int:
        """The number of inliers."""
        return int(self.inliers.sum())


@dataclass(frozen=True)
class Matches:
    """All matches of a query, its intrinsics, and how its pose is estimated.

    Args:
        points2D: (M, 2) image points, COLMAP's pixels.
        points3D: (M, 3) their world points.
        camera: intrinsics.
        config: as in `absolute_pose.estimate`.
    """

    points2D: np.ndarray
    points3D: np.ndarray
    camera: pycolmap.Camera
    config: dict

    def __len__(self) -> int:
        return len(self.points2D)

    def inliers(self, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
        """Return the image points (N, 2) and world points (N, 3) of the inliers of a pose."""
        return self.points2D[pose.inliers], self.points3D[pose.inliers]

    @property
    def max_error(self) -> float:
        """The inlier threshold in pixels."""
        return self.config.get("estimation", {}).get("ransac", {}).get("max_error", MAX_ERROR)

    def with_max_error(self, max_error: float) -> "Matches":
        """Return the same matches with another inlier threshold in pixels."""
        estimation = self.config.get("estimation", {})
        ransac = {**estimation.get("ransac", {}), "max_error": max_error}
        return replace(self, config={**self.config, "estimation": {**estimation, "ransac": ransac}})

    def may_be_cropped(self, pose: Pose) -> bool:
        """Return whether the photo may be cropped.

        Its size tells, or that the focal length of a pose is unlike the map's, as that of photos
        which were cropped and enlarged again.
        """
        photo = self.config.get("photo", {})
        low, high = photo.get("focal_lengths", (0, np.inf))
        fits = low / gate.ZOOMED <= pose.camera.mean_focal_length() <= gate.ZOOMED * high
        return bool(photo.get("cropped")) or not fits

    def with_typical_lens(self) -> "Matches | None":
        """Return the same matches with the lens of the map's photos, None if it is not known."""
        if (lens := self.config.get("photo", {}).get("typical")) is None:
            return None
        width, height = self.camera.width, self.camera.height
        focal_length, distortion, x, y = lens
        params = [focal_length * max(width, height), x * width, y * height, distortion]
        return self.with_lens(
            pycolmap.Camera(model="SIMPLE_RADIAL", width=width, height=height, params=params)
        )

    def with_lens(self, camera: pycolmap.Camera) -> "Matches":
        """Return the same matches with the exact intrinsics of a lens of the map's photos."""
        estimation = {**self.config.get("estimation", {}), "estimate_focal_length": False}
        refinement = {**self.config.get("refinement", {}), "refine_focal_length": False}
        config = {"estimation": estimation, "refinement": refinement, "photo": OF_SIZE}
        return replace(self, camera=camera, config=config)

    @property
    def is_camera_given(self) -> bool:
        """Whether the intrinsics are known, not those of photos of the map."""
        return not self.is_focal_length_free and not self.is_lens_of_map

    @property
    def is_lens_of_map(self) -> bool:
        """Whether the intrinsics are those of photos of the map that the same lens took."""
        return bool(self.config.get("photo", {}).get("of_map"))

    @property
    def is_lens_by_size(self) -> bool:
        """Whether nothing but the size of the photo tells that."""
        return bool(self.config.get("photo", {}).get("by_size"))

    @property
    def is_focal_length_guessed(self) -> bool:
        """Whether RANSAC estimates the focal length."""
        return bool(self.config.get("estimation", {}).get("estimate_focal_length"))

    @property
    def is_focal_length_free(self) -> bool:
        """Whether the focal length is estimated or refined."""
        refined = self.config.get("refinement", {}).get("refine_focal_length")
        return self.is_focal_length_guessed or bool(refined)


def quality(pose: Pose) -> tuple[float, int]:
    """Return the confidence and the number of inliers, by which poses are compared."""
    return pose.confidence, pose.num_inliers


def apart(pose: Pose, other: Pose, points3D: np.ndarray) -> tuple[float, float]:
    """Return how far apart two poses are.

    Args:
        pose: one of them, with inliers.
        other: the other one.
        points3D: (M, 3) the points of the first one's matches.

    Returns:
        The distance of their positions in units of the median depth of the first one's inliers, and
        the angle between their rotations in degrees.
    """
    assert pose.cam_from_world is not None and other.cam_from_world is not None
    moved, degrees = motion(pose.cam_from_world, other.cam_from_world)
    inliers = points3D[pose.inliers]
    depths = inliers @ pose.cam_from_world.rotation.matrix().T + pose.cam_from_world.translation
    return float(moved / np.median(depths[:, 2])), degrees


def motion(pose: pycolmap.Rigid3d, other: pycolmap.Rigid3d) -> tuple[float, float]:
    """Return the distance of the positions of two poses, and the angle between them in degrees."""
    relative = pose * other.inverse()
    return float(np.linalg.norm(relative.translation)), float(np.degrees(relative.rotation.angle()))


def differ(pose: Pose, other: Pose, points3D: np.ndarray, tolerance: gate.Tolerance) -> bool:
    """Return whether there are two poses, and they differ by more than a tolerance, see `apart`."""
    if pose.cam_from_world is None or other.cam_from_world is None:
        return False
    position, rotation = apart(pose, other, points3D)
    return position > tolerance.position or rotation > tolerance.rotation
