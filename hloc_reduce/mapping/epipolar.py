"""Matches of photos against their poses, by epipolar geometry."""

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
import pycolmap

from ..utils import colmap

EPIPOLAR_ERROR = 4.0  # pixels, times the uncertainty of the keypoints, as in hloc
MIN_VERIFIED_MATCHES = 15  # fewer tell nothing of a pair

Pair = tuple[str, str]


def agreeing(
    images: Iterable[pycolmap.Image],
    keypoints: Mapping[str, np.ndarray],
    matches: Mapping[Pair, np.ndarray],
    uncertainty: Mapping[str, float] | None = None,
) -> dict[Pair, np.ndarray]:
    """Return which matches are close to the epipolar lines of the poses of images of a model.

    Args:
        images: with poses.
        keypoints: (N, 2) of each image, COLMAP's pixels.
        matches: (M, 2) of pairs; those of other images are left out.
        uncertainty: of the keypoints of each image in pixels; default: 1.

    Returns:
        From pair to (M,) bool.
    """
    images, thresholds = list(images), {}
    for image in images:
        assert image.camera is not None  # it belongs to a model
        pixels = EPIPOLAR_ERROR * (1 if uncertainty is None else uncertainty[image.name])
        thresholds[image.name] = image.camera.cam_from_img_threshold(pixels)
    return {
        (name0, name1): (errors0 <= thresholds[name0]) & (errors1 <= thresholds[name1])
        for (name0, name1), errors0, errors1 in errors_of_pairs(images, keypoints, matches)
    }


def errors_of_pairs(
    images: Iterable[pycolmap.Image],
    keypoints: Mapping[str, np.ndarray],
    matches: Mapping[Pair, np.ndarray],
) -> Iterator[tuple[Pair, np.ndarray, np.ndarray]]:
    """Yield pairs, and how far their matches lie from the epipolar lines of the poses.

    Args:
        images: with poses.
        keypoints: (N, 2) of each image, COLMAP's pixels.
        matches: (M, 2) of pairs; those of other images are left out.
    """
    poses, rays = {}, {}
    for image in images:
        assert image.camera is not None  # it belongs to a model
        poses[image.name] = image.cam_from_world()
        rays[image.name] = colmap.cam_from_img(image.camera, keypoints[image.name])
    for (name0, name1), indices in matches.items():
        if {name0, name1} <= poses.keys():
            relative = poses[name1] * poses[name0].inverse()
            rays0, rays1 = rays[name0][indices[:, 0]], rays[name1][indices[:, 1]]
            yield (name0, name1), *epipolar_errors(relative, rays0, rays1)


@np.errstate(invalid="ignore")  # points that no camera sees are infinite
def epipolar_errors(
    cam1_from_cam0: pycolmap.Rigid3d, points0: np.ndarray, points1: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Measure how far matches lie from the epipolar lines of a known relative pose.

    Args:
        cam1_from_cam0: the relative pose.
        points0: (M, 2) points on the normalized image plane of camera 0.
        points1: (M, 2) their matches on the normalized image plane of camera 1.

    Returns:
        Distances (M,) of points0 and of points1 to their epipolar lines, on these planes; infinite
        where a line is undefined.
    """
    tx, ty, tz = cam1_from_cam0.translation
    cross = np.array([[0, -tz, ty], [tz, 0, -tx], [-ty, tx, 0]])
    essential = cross @ cam1_from_cam0.rotation.matrix()
    points0, points1 = (np.pad(p, ((0, 0), (0, 1)), constant_values=1) for p in (points0, points1))
    lines1, lines0 = points0 @ essential.T, points1 @ essential
    distance = np.abs((points1 * lines1).sum(1))
    errors = []
    for lines in (lines0, lines1):
        norm = np.linalg.norm(lines[:, :2], axis=1)
        errors.append(np.divide(distance, norm, out=np.full_like(norm, np.inf), where=norm > 0))
    return errors[0], errors[1]
