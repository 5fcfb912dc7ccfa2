"""Complete the tracks of a map by geometry alone.

A matcher finds the observations that its descriptor makes easy. Where a point must appear in the
other images is known from the poses; a keypoint at that place, of the scale and the orientation
that the point must have there, is an observation that the descriptor missed.
"""

import numpy as np
import pycolmap
from scipy.spatial import cKDTree

MAX_DISTANCE = 2.0  # pixels
MAX_OCTAVES = 0.5
MAX_ROTATION = 30.0  # degrees
MAX_VIEW_ANGLE = 40.0  # degrees between the rays of the known and the new observation
NEIGHBORS = 8  # keypoints looked at around each place


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
        self.reconstruction, self.keypoints, self.observed = reconstruction, keypoints, observed
        self.images = {image.name: image for image in reconstruction.images.values()}
        names = sorted(keypoints)
        known = {name: np.flatnonzero(observed[name] >= 0) for name in names}
        # an entry for each observation
        image_index = np.repeat(np.arange(len(names)), [len(known[name]) for name in names])
        self.point_id = np.concatenate([observed[name][known[name]] for name in names])
        self.points = np.array(
            [reconstruction.points3D[i].xyz for i in self.point_id],
        ).reshape(-1, 3)
        self.centres = {name: self.images[name].projection_center() for name in names}
        self.rays = np.array([self.centres[name] for name in names])[image_index] - self.points
        self.rays /= np.linalg.norm(self.rays, axis=1, keepdims=True)
        # how each point looks from where it is known: two short steps along the keypoint's axes
        self.steps = np.concatenate(
            [
                _steps(
                    self.images[name],
                    reconstruction,
                    keypoints[name][known[name]],
                    self.points[image_index == i],
                )
                for i, name in enumerate(names)
            ]
        )
        self.scales = np.concatenate([keypoints[name][known[name], 2] for name in names])

    def __call__(self, name: str) -> np.ndarray:
        """Return `observed` (N,) of an image, with points for some keypoints that had none."""
        image, keypoints, observed = self.images[name], self.keypoints[name], self.observed[name]
        completed = observed.copy()
        free = observed < 0
        if not free.any() or not len(self.points):
            return completed
        view = self.centres[name] - self.points
        view /= np.linalg.norm(view, axis=1, keepdims=True)
        cosine = (view * self.rays).sum(1)
        # of each point that is not seen here yet, the observation from the nearest direction
        order = np.lexsort((-cosine, self.point_id))
        order = order[np.r_[True, np.diff(self.point_id[order]) > 0]]
        seen_here = np.isin(self.point_id[order], observed)
        order = order[~seen_here & (cosine[order] > np.cos(np.radians(MAX_VIEW_ANGLE)))]
        place, along, across, inside = _project(
            image, self.reconstruction, self.points[order], self.steps[order]
        )
        order, place, along, across = (a[inside] for a in (order, place, along, across))
        if not len(order):
            return completed
        scale = self.scales[order] * np.sqrt(
            np.linalg.norm(along, axis=1) * np.linalg.norm(across, axis=1)
        )
        orientation = np.degrees(np.arctan2(along[:, 1], along[:, 0]))
        candidates = keypoints[free]
        distance, nearest = cKDTree(candidates[:, :2]).query(
            place, k=range(1, NEIGHBORS + 1), distance_upper_bound=MAX_DISTANCE
        )
        found = np.minimum(nearest, len(candidates) - 1)
        octaves = np.abs(np.log2(candidates[found, 2] / scale[:, None]))
        turned = candidates[found, 3] - orientation[:, None]
        turned = np.abs((turned + 180) % 360 - 180)
        fits = np.isfinite(distance) & (octaves < MAX_OCTAVES) & (turned < MAX_ROTATION)
        cost = np.where(fits, distance, np.inf)
        row = np.flatnonzero(fits.any(axis=1))
        best = cost[row].argmin(axis=1)
        # a keypoint that several points want is the nearest's
        row, best = (a[np.argsort(cost[row, best], kind="stable")] for a in (row, best))
        keypoint, first = np.unique(found[row, best], return_index=True)
        completed[np.flatnonzero(free)[keypoint]] = self.point_id[order[row[first]]]
        return completed


def _steps(
    image: pycolmap.Image,
    reconstruction: pycolmap.Reconstruction,
    keypoints: np.ndarray,
    points: np.ndarray,
) -> np.ndarray:
    """Return the world vectors (N, 2, 3) that are steps of one pixel along keypoints' axes."""
    camera = reconstruction.cameras[image.camera_id]
    pose = image.cam_from_world()
    rotation = pose.rotation.matrix()
    depth = points @ rotation[2] + pose.translation[2]
    angle = np.radians(keypoints[:, 3])
    axes = np.stack([np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)], 1)
    steps = axes.reshape(-1, 2, 2) * (depth / camera.mean_focal_length())[:, None, None]
    return steps @ rotation[:2]


def _project(
    image: pycolmap.Image,
    reconstruction: pycolmap.Reconstruction,
    points: np.ndarray,
    steps: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Project points (N, 3) and steps from them (N, 2, 3) into an image.

    Returns:
        Places (N, 2) in COLMAP's pixels; both steps there, each (N, 2); and which points are in
        front of the camera and inside the image, (N,) bool.
    """
    camera = reconstruction.cameras[image.camera_id]
    pose = image.cam_from_world()
    corners = np.stack([points, points + steps[:, 0], points + steps[:, 1]], 1)
    in_camera = corners @ pose.rotation.matrix().T + pose.translation
    front = in_camera[..., 2].min(axis=1, initial=np.inf) > 1e-6
    in_camera[~front] = (0, 0, 1)
    pixels = np.asarray(camera.img_from_cam(in_camera.reshape(-1, 3))).reshape(-1, 3, 2)
    place = pixels[:, 0]
    inside = (place > 0).all(axis=1) & (place < (camera.width, camera.height)).all(axis=1)
    return place, pixels[:, 1] - place, pixels[:, 2] - place, front & inside
