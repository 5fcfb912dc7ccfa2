"""Lenses whose image a focal length and one radial distortion do not explain, such as fisheyes.

The pose of a photo by such a lens is wrong if its intrinsics are estimated with it: those of the
map's photos by the same lens are needed.
"""

import copy
from collections import Counter
from collections.abc import Iterable

import numpy as np
import pycolmap

from ..utils.colmap import cam_from_img
from .exif import WELL_KNOWN
from .pose import MAX_ERROR
from .projection import DETECTED

# camera models with one coefficient of radial distortion or none, which queries are estimated with
PLAIN = "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL"
# The largest error that the best such camera may have, in longer sides: half of RANSAC's threshold.
# Lenses with 0.5 to 1 % move synthetic queries by up to 2 %, those with 2 % by 6 % and more.
BENT = MAX_ERROR / DETECTED / 2
SAME_LENS = 0.002  # two lenses that project no ray farther apart, in longer sides, count as one
LENS_SHARE = (
    0.1  # of the photos of a map, or WELL_KNOWN ones: a lens of fewer may be a failed estimate
)
GRID = 12  # points of an image across and down at which a lens is judged
SAME = 0.01  # pixels between a point and its ray, projected again, unless the lens has no such ray

Size = tuple[int, int]  # width and height in pixels


def is_bent(camera: pycolmap.Camera) -> bool:
    """Tell whether no focal length and radial distortion explain the image of a lens.

    The principal point is that of the lens. Only points whose rays are less than 90 degrees from
    the axis count; a lens without such points is bent.
    """
    if camera.model.name in PLAIN:
        return False
    points2D, rays = _rays(camera)
    seen = np.isfinite(rays).all(axis=1)
    if not seen.any():
        return True
    plane = rays[seen, :2] / rays[seen, 2:]
    cubic = plane * (plane**2).sum(axis=1, keepdims=True)
    equations = np.stack([plane.ravel(), cubic.ravel()], axis=1)
    image = points2D[seen] - [camera.principal_point_x, camera.principal_point_y]
    solution = np.linalg.lstsq(equations, image.ravel(), rcond=None)[0]
    errors = np.linalg.norm((equations @ solution).reshape(-1, 2) - image, axis=1)
    return bool(errors.max() > BENT * max(camera.width, camera.height))


def _rays(camera: pycolmap.Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return image points (P, 2) on a grid, and their unit rays (P, 3), NaN where there is none."""
    steps = (np.arange(GRID) + 0.5) / GRID
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    points2D = grid * [camera.width, camera.height]
    plane = cam_from_img(camera, points2D)
    rays = np.full((len(plane), 3), np.nan)
    inside = np.isfinite(plane).all(axis=1)
    rays[inside] = np.pad(plane[inside], ((0, 0), (0, 1)), constant_values=1)
    again = np.full_like(points2D, np.nan)
    if inside.any():
        again[inside] = camera.img_from_cam(rays[inside])
    with np.errstate(invalid="ignore"):
        rays[~(np.linalg.norm(again - points2D, axis=1) <= SAME)] = np.nan
    return points2D, rays / np.linalg.norm(rays, axis=1, keepdims=True)


def split(
    cameras: Iterable[pycolmap.Camera],
) -> tuple[list[pycolmap.Camera], dict[Size, list[pycolmap.Camera]]]:
    """Split the cameras of the photos of a map, one for each photo.

    Returns:
        The cameras that a query can be estimated with, and of each size the different bent lenses,
        those of the most photos first. A bent lens of few photos counts among the former.
    """
    cameras = list(cameras)
    keys = [(camera.model.name, camera.width, camera.height, *camera.params) for camera in cameras]
    number, one = Counter(keys), dict(zip(keys, cameras, strict=True))
    groups: dict[Size, list[tuple[np.ndarray, list[tuple]]]] = {}  # of lenses that are alike
    for key, _ in number.most_common():
        if is_bent(camera := one[key]):
            rays = np.nan_to_num(_rays(camera)[1])
            apart = SAME_LENS * max(camera.width, camera.height) / camera.mean_focal_length()
            alike = groups.setdefault((camera.width, camera.height), [])
            for others, same in alike:
                if np.linalg.norm(others - rays, axis=1).max() <= apart:
                    same.append(key)
                    break
            else:
                alike.append((rays, [key]))
    lenses: dict[Size, list[pycolmap.Camera]] = {}
    bent: set[tuple] = set()
    for size, alike in groups.items():
        taken = [(sum(number[key] for key in same), same) for _, same in alike]
        for photos, same in sorted(taken, key=lambda lens: -lens[0]):
            if photos >= min(WELL_KNOWN, LENS_SHARE * len(cameras)):
                lenses.setdefault(size, []).append(copy.deepcopy(one[same[0]]))
                bent.update(same)
    return [camera for key, camera in zip(keys, cameras, strict=True) if key not in bent], lenses
