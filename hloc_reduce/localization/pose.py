"""A pose with the matches that agree with it, and how poses compare."""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from .confidence import RIVAL
from .projection import POSE

MAX_ERROR = 12.0  # pixels, pycolmap's default
# poses that differ by more are rivals
SAME_ROTATION = 10.0  # degrees
SAME_POSITION = 0.25  # of the median depth of the inliers
OF_SIZE = {"of_map": True, "by_size": True}  # options of a photo by a lens of the map's photos
ZOOMED = 1.05  # times the map's focal lengths: beyond, a photo may be cropped and enlarged


@dataclass(frozen=True)
class Pose:
    """A pose and how the matches agree with it.

    Args:
        cam_from_world: the pose, None if there is none.
        camera: intrinsics, estimated if the configuration says so.
        inliers: (M,) bool.
        confidence: -log10 of the number of such poses that are expected by chance.
        agreement: the largest share of an image's matches that agree, minus one standard deviation.
        refusal: why it is not trusted, None if it is.
        degrees_of_freedom: the number of estimated parameters, see `projection`.
    """

    cam_from_world: pycolmap.Rigid3d | None
    camera: pycolmap.Camera
    inliers: np.ndarray
    confidence: float = -np.inf
    agreement: float = 0.0
    refusal: str | None = None
    degrees_of_freedom: int = POSE

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

    def may_be_cropped(self, pose: Pose) -> bool:
        """Return whether the photo may be cropped.

        Its size tells, or that the focal length of a pose is unlike the map's, as that of photos
        which were cropped and enlarged again.
        """
        photo = self.config.get("photo", {})
        low, high = photo.get("focal_lengths", (0, np.inf))
        fits = low / ZOOMED <= pose.camera.mean_focal_length() <= ZOOMED * high
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


def is_rival(pose: Pose, other: Pose, points3D: np.ndarray) -> bool:
    """Return whether another pose, from other matches, makes a pose ambiguous.

    Args:
        pose: the best one.
        other: from the same matches (M).
        points3D: (M, 3) their points.
    """
    if other.confidence < RIVAL * pose.confidence:
        return False
    shared = (other.inliers & pose.inliers).sum()
    return bool(2 * shared < other.num_inliers) and differ(pose, other, points3D)


def differ(
    pose: Pose,
    other: Pose,
    points3D: np.ndarray,
    position: float = SAME_POSITION,
    rotation: float = SAME_ROTATION,
) -> bool:
    """Return whether two poses differ by more than a position or a rotation.

    Args:
        pose: one of them.
        other: the other one.
        points3D: (M, 3) the points of the first one's matches.
        position: in units of the median depth of the first one's inliers.
        rotation: in degrees.
    """
    if pose.cam_from_world is None or other.cam_from_world is None:
        return False
    relative = pose.cam_from_world * other.cam_from_world.inverse()
    inliers = points3D[pose.inliers]
    depths = inliers @ pose.cam_from_world.rotation.matrix().T + pose.cam_from_world.translation
    moved = np.linalg.norm(relative.translation) / np.median(depths[:, 2])
    return np.degrees(relative.rotation.angle()) > rotation or moved > position
