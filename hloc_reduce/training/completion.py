"""Complete the tracks of a map by geometry alone.

A matcher finds the observations that its descriptor makes easy. The poses tell where else a point
must appear: a keypoint at that place, of the scale and the orientation that the point must have
there, is an observation that the descriptor missed.
"""

import numpy as np
import pycolmap
from scipy.spatial import cKDTree

MAX_DISTANCE_PIXELS = 2.0
MAX_SCALE_OCTAVES = 0.5
MAX_ROTATION_DEGREES = 30.0
MAX_VIEW_ANGLE_DEGREES = 40.0  # between the rays of the known and the new observation
NUM_CANDIDATES = 8  # at each place


class Completion:
    """Finds the keypoints of an image that observe points of a map, matched or not.

    Args:
        reconstruction: the map.
        keypoints: from image name to (N, 4): x, y (COLMAP's pixels), scale (pixels), orientation
            (degrees).
        observed: from image name to the id of the point of each keypoint (N,), -1 where none.
    """

    def __init__(
        self,
        reconstruction: pycolmap.Reconstruction,
        keypoints: dict[str, np.ndarray],
        observed: dict[str, np.ndarray],
    ):
        self.keypoints, self.observed = keypoints, observed
        images = {image.name: image for image in reconstruction.images.values()}
        self.centers = {name: images[name].projection_center() for name in keypoints}
        self.views = {
            name: (reconstruction.cameras[images[name].camera_id], images[name].cam_from_world())
            for name in keypoints
        }
        names = sorted(keypoints)
        # one row per observation: its point, and how the point looks from there
        parts = []
        for name in names:
            known = np.flatnonzero(observed[name] >= 0)
            ids = observed[name][known]
            points = np.array([reconstruction.points3D[i].xyz for i in ids]).reshape(-1, 3)
            found = keypoints[name][known]
            rays = self.centers[name] - points
            steps = _steps(*self.views[name], found, points)
            parts.append((ids, points, rays, steps, found[:, 2]))
        self.point_id, self.points, self.rays, self.steps, self.scales = (
            np.concatenate(part) for part in zip(*parts, strict=True)
        )
        self.rays /= np.linalg.norm(self.rays, axis=1, keepdims=True)

    def __call__(self, name: str) -> np.ndarray:
        """Return `observed` (N,) of an image, with points for some keypoints that had none."""
        completed = self.observed[name].copy()
        free = np.flatnonzero(completed < 0)
        rows = self._candidates(name)
        place, along, across, inside = _project(
            *self.views[name], self.points[rows], self.steps[rows]
        )
        rows, place, along, across = (a[inside] for a in (rows, place, along, across))
        if not len(free) or not len(rows):
            return completed
        scale = self.scales[rows] * np.sqrt(
            np.linalg.norm(along, axis=1) * np.linalg.norm(across, axis=1)
        )
        orientation = np.degrees(np.arctan2(along[:, 1], along[:, 0]))
        keypoints = self.keypoints[name][free]
        distance, nearest = cKDTree(keypoints[:, :2]).query(
            place, k=range(1, NUM_CANDIDATES + 1), distance_upper_bound=MAX_DISTANCE_PIXELS
        )
        nearest = np.minimum(nearest, len(keypoints) - 1)
        octaves = np.abs(np.log2(keypoints[nearest, 2] / scale[:, None]))
        turned = keypoints[nearest, 3] - orientation[:, None]
        turned = np.abs((turned + 180) % 360 - 180)
        fits = (
            np.isfinite(distance) & (octaves < MAX_SCALE_OCTAVES) & (turned < MAX_ROTATION_DEGREES)
        )
        cost = np.where(fits, distance, np.inf)
        found = np.flatnonzero(fits.any(axis=1))
        best = cost[found].argmin(axis=1)
        # a keypoint that fits several points goes to the nearest
        order = np.argsort(cost[found, best], kind="stable")
        found, best = found[order], best[order]
        keypoint, first = np.unique(nearest[found, best], return_index=True)
        completed[free[keypoint]] = self.point_id[rows[found[first]]]
        return completed

    def _candidates(self, name: str) -> np.ndarray:
        """Return the observations of points that an image may see, one per point.

        It is the one from the nearest direction, within `MAX_VIEW_ANGLE_DEGREES`.
        """
        view = self.centers[name] - self.points
        view /= np.linalg.norm(view, axis=1, keepdims=True)
        cosine = (view * self.rays).sum(1)
        order = np.lexsort((-cosine, self.point_id))
        order = order[np.diff(self.point_id[order], prepend=-1) > 0]
        seen_here = np.isin(self.point_id[order], self.observed[name])
        return order[~seen_here & (cosine[order] > np.cos(np.radians(MAX_VIEW_ANGLE_DEGREES)))]


def _steps(
    camera: pycolmap.Camera, pose: pycolmap.Rigid3d, keypoints: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Return the world vectors (N, 2, 3) that are steps of one pixel along keypoints' axes."""
    rotation = pose.rotation.matrix()
    depth = points @ rotation[2] + pose.translation[2]
    angle = np.radians(keypoints[:, 3])
    axes = np.stack([np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)], 1)
    steps = axes.reshape(-1, 2, 2) * (depth / camera.mean_focal_length())[:, None, None]
    return steps @ rotation[:2]


def _project(
    camera: pycolmap.Camera, pose: pycolmap.Rigid3d, points: np.ndarray, steps: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Project points (N, 3) and steps from them (N, 2, 3) into an image.

    Returns:
        Places (N, 2) in COLMAP's pixels; both steps there, each (N, 2); and which points are in
        front of the camera and inside the image, (N,) bool.
    """
    corners = np.stack([points, points + steps[:, 0], points + steps[:, 1]], 1)
    in_camera = corners @ pose.rotation.matrix().T + pose.translation
    front = in_camera[..., 2].min(axis=1, initial=np.inf) > 1e-6
    in_camera[~front] = (0, 0, 1)
    pixels = np.asarray(camera.img_from_cam(in_camera.reshape(-1, 3))).reshape(-1, 3, 2)
    place = pixels[:, 0]
    inside = (place > 0).all(axis=1) & (place < (camera.width, camera.height)).all(axis=1)
    return place, pixels[:, 1] - place, pixels[:, 2] - place, front & inside
