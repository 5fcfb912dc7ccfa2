"""Matches of photos against their poses, by epipolar geometry."""

from collections.abc import Mapping

import numpy as np
import pycolmap

from ..utils import colmap

MAX_ERROR = 4.0  # pixels, times the uncertainty of the keypoints, as in hloc
# verified matches of a pair that are evidence, and the share of an image's that must agree
EVIDENCE, AGREEING = 15, 0.5

Pair = tuple[str, str]


def misplaced(
    model: pycolmap.Reconstruction,
    keypoints: Mapping[str, np.ndarray],
    verified: Mapping[Pair, np.ndarray],
) -> str | None:
    """Return the image whose pose contradicts its matches most, None if no pose does.

    A mapper may place an image by a few wrong matches, in spite of all its other ones. Those are
    then far from their epipolar lines.

    Args:
        model: the map.
        keypoints: (N, 2) of each image, COLMAP's pixels.
        verified: the matches (M, 2) of pairs that agree with a two-view geometry.
    """
    images = {model.images[i].name: model.images[i] for i in model.reg_image_ids()}
    poses, rays, thresholds = {}, {}, {}
    for name, image in images.items():
        assert image.camera is not None  # it belongs to a model
        poses[name] = image.cam_from_world()
        rays[name] = colmap.cam_from_img(image.camera, keypoints[name])
        thresholds[name] = image.camera.cam_from_img_threshold(MAX_ERROR)
    agree, number = dict.fromkeys(images, 0), dict.fromkeys(images, 0)
    for (name0, name1), indices in verified.items():
        if len(indices) < EVIDENCE or not {name0, name1} <= images.keys():
            continue
        errors0, errors1 = epipolar_errors(
            poses[name1] * poses[name0].inverse(),
            rays[name0][indices[:, 0]],
            rays[name1][indices[:, 1]],
        )
        agreeing = (errors0 <= thresholds[name0]) & (errors1 <= thresholds[name1])
        for name in (name0, name1):
            agree[name] += int(agreeing.sum())
            number[name] += len(indices)
    shares = {name: agree[name] / number[name] for name in images if number[name]}
    worst = min(shares, key=shares.__getitem__, default=None)
    return worst if worst is not None and shares[worst] < AGREEING else None


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
