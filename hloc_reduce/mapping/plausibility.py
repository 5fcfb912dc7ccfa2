"""Which images of a reconstructed model are plausible, and which models can be used."""

from collections import Counter
from collections.abc import Mapping

import numpy as np
import pycolmap

from .. import logger
from ..localization.confidence import focal_lengths
from ..utils import colmap
from . import copies
from .epipolar import Pair, misplaced

# ratios of focal lengths of images that one camera may have taken: one camera for all is tried
SPREAD = 1.2  # above it, always
DOUBTFUL = 1.05  # above it, for few images, if these fit with one
FEW = 100  # images: further attempts take little time, even for one missing image
MAX_DISTORTION = 1.0  # COLMAP's limit for images that it registers
FEWEST = 8  # points of an image: fewer determine no pose for certain
# A few points hold an image like a hinge: it fits them, but its pose is often wrong by degrees.
# Of images with fewer than 30 points, and than an eighth of the median of their map, three of four
# were wrong, in 103 maps.
HINGE, SHARE = 30, 1 / 8
MANY = 3  # images of one camera estimate its focal length better than EXIF data do
SAME_VIEWPOINT = 0.03  # of the distance to the scene, between images of one viewpoint
VIEWPOINTS = 3  # at least, of a model: two do not determine the focal lengths

# in place of an implausible lens; see `epipolar.misplaced` and `copies`
DISTORTION = "distortion"  # begins what is implausible about a lens
MISPLACED, COPY, FEW_POINTS = "misplaced", "another side or a copy", "few points"

Models = tuple[list[pycolmap.Reconstruction], dict[str, str]]  # see `keep_plausible`


def keep_plausible(
    models: list[pycolmap.Reconstruction],
    cameras: dict[int, pycolmap.Camera],
    keypoints: Mapping[str, np.ndarray] | None = None,
    verified: Mapping[Pair, np.ndarray] | None = None,
) -> Models:
    """Drop images from models: implausible lenses, misplaced ones, copies, and with few points.

    Args:
        models: of COLMAP's mapper.
        cameras: from id to the initial camera.
        keypoints: (N, 2) of each image, COLMAP's pixels; with `verified`.
        verified: the matches (M, 2) of pairs that agree with a two-view geometry; default: no image
            is taken for misplaced.

    Returns:
        The models that have points, the largest first; and from the name of each dropped image to
        what is implausible: the lens, or `MISPLACED`, `COPY` or `FEW_POINTS`.
    """
    dropped: dict[str, str] = {}
    for model in models:
        images = _registered(model)
        shared = Counter(image.camera_id for image in images)
        lenses = {}
        for image in images:
            camera_id = image.camera_id
            lens = _implausible(model.cameras[camera_id], cameras[camera_id], shared[camera_id])
            if lens is not None:
                lenses[image.name] = lens
        dropped |= _drop(model, lenses)
        wrong = misplaced(model, keypoints or {}, verified) if verified else []
        dropped |= _drop(model, dict.fromkeys(wrong, MISPLACED))
        while found := copies.find(model):
            dropped |= _drop(model, dict.fromkeys(found, COPY))
        while few := _held_by_few(model):
            dropped |= _drop(model, dict.fromkeys(few, FEW_POINTS))
    whole = []
    for model in models:
        if min(size(model)) < 2:
            continue
        if (number := count_viewpoints(model)) >= VIEWPOINTS:
            whole.append(model)
            continue
        logger.info(
            "A model of %d photos is not used: %d viewpoints do not determine focal lengths.",
            *(model.num_reg_images(), number),
        )
    return sorted(whole, key=size, reverse=True), dropped


def _registered(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    return [model.images[i] for i in model.reg_image_ids()]


def _held_by_few(model: pycolmap.Reconstruction) -> list[str]:
    """Return the images that too few points hold: those with the fewest, as others share these."""
    number = {image.name: image.num_points3D for image in _registered(model)}
    if not number:
        return []
    least = max(FEWEST, min(HINGE, SHARE * np.median(list(number.values()))))
    fewest = min(number.values())
    return [name for name, points in number.items() if points == fewest < least]


def _implausible(camera: pycolmap.Camera, initial: pycolmap.Camera, number: int) -> str | None:
    """Say what is implausible about the refined camera of a number of images, if anything."""
    low, high = focal_lengths(initial, not initial.has_prior_focal_length or number >= MANY)
    focal_length = camera.mean_focal_length()
    if not low <= focal_length <= high:
        return f"focal length {focal_length:.0f}" if focal_length > 0 else "no focal length fits"
    distortion = max(camera.params[list(camera.extra_params_idxs())], key=abs, default=0.0)
    return f"{DISTORTION} {distortion:.1f}" if abs(distortion) > MAX_DISTORTION else None


def count_viewpoints(model: pycolmap.Reconstruction) -> int:
    """Count the viewpoints of a model: a burst of photos from one place is one viewpoint."""
    points = {number: point.xyz for number, point in model.points3D.items()}
    left: list[tuple[np.ndarray, float]] = []  # centres of images, and distances of their points
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        centre = image.projection_center()
        seen = [points[p.point3D_id] for p in image.points2D if p.has_point3D()]
        if seen:
            left.append((centre, float(np.median(np.linalg.norm(np.array(seen) - centre, axis=1)))))
    number = 0
    while left:
        number, (first, distance) = number + 1, left[0]
        left = [
            (centre, other)
            for centre, other in left[1:]
            if np.linalg.norm(centre - first) > SAME_VIEWPOINT * min(distance, other)
        ]
    return number


def _drop(model: pycolmap.Reconstruction, dropped: dict[str, str]) -> dict[str, str]:
    """Drop photos, and those that only these connect; return the photos."""
    if dropped:
        colmap.remove_images(model, dropped)  # in place: the mapper's images have their own frames
        _keep_connected(model)
    return dropped


def _keep_connected(model: pycolmap.Reconstruction) -> None:
    """Keep only the largest set of images that common points connect."""
    from scipy.sparse.csgraph import connected_components

    ids = sorted(model.reg_image_ids())
    if not ids or not model.num_points3D():
        return
    sees = colmap.visibility(colmap.point3D_ids(model.images[i]) for i in ids)
    _, label = connected_components(sees @ sees.T, directed=False)
    largest = np.bincount(label).argmax()
    for image_id, part in zip(ids, label, strict=True):
        if part != largest:
            model.deregister_frame(model.images[image_id].frame_id)


def size(model: pycolmap.Reconstruction) -> tuple[int, int]:
    """Return the numbers of images and points of a model, by which models are compared."""
    return model.num_reg_images(), model.num_points3D()


def focal_length_spread(models: list[pycolmap.Reconstruction], with_dropped: bool = False) -> float:
    """Return the ratio of the largest and the smallest focal length in the largest model, or 1.

    Args:
        models: the largest first.
        with_dropped: also count its images that were dropped.
    """
    if not models:
        return 1.0
    images = models[0].images.values() if with_dropped else _registered(models[0])
    cameras = {image.camera_id for image in images}
    focal_lengths = [models[0].cameras[i].mean_focal_length() for i in cameras]
    return max(focal_lengths) / min(focal_lengths) if focal_lengths else 1.0
