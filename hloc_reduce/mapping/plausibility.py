"""Which images of a reconstructed model are plausible, and which models can be used."""

from dataclasses import replace

import numpy as np
import pycolmap

from .. import logger
from ..utils import colmap
from .checks import CHECKS, Inputs
from .findings import Finding, merged, names_in
from .registration import MIN_VIEWPOINTS

SAME_VIEWPOINT = 0.03  # of the distance to the scene, between images of one viewpoint
DROPPING = "lenses", "misplaced", "copies", "few_points"  # checks, in this order

Models = tuple[list[pycolmap.Reconstruction], list[Finding]]  # see `keep_plausible`


def keep_plausible(models: list[Inputs]) -> Models:
    """Drop images from models: implausible lenses, misplaced ones, copies, and with few points.

    Photos that a rig took at one moment are dropped together.

    Args:
        models: of COLMAP's mapper, changed in place.

    Returns:
        The models that have points, the largest first; and what was found of the images that were
        dropped.
    """
    dropped: list[Finding] = []
    for one in models:
        for kind in DROPPING:
            while found := CHECKS[kind].find(replace(one)):  # the model has changed
                dropped += found
                names = names_in(found)
                for frame_id in {image.frame_id for image in one.images if image.name in names}:
                    one.model.deregister_frame(frame_id)
                _keep_connected(one.model)
    whole = []
    for model in (one.model for one in models):
        if min(size(model)) < 2:
            continue
        if (number := count_viewpoints(model)) >= MIN_VIEWPOINTS:
            whole.append(model)
            continue
        logger.info(
            "A model of %d photos is not used: %d viewpoints do not determine focal lengths.",
            model.num_reg_images(),
            number,
        )
    return sorted(whole, key=size, reverse=True), merged(dropped)


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


def _keep_connected(model: pycolmap.Reconstruction) -> None:
    """Keep only the largest set of frames that common points connect."""
    from scipy.sparse.csgraph import connected_components

    seen: dict[int, list[np.ndarray]] = {}
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        seen.setdefault(image.frame_id, []).append(colmap.point3D_ids(image))
    if not seen or not model.num_points3D():
        return
    sees = colmap.visibility(map(np.concatenate, seen.values()))
    _, label = connected_components(sees @ sees.T, directed=False)
    largest = np.bincount(label).argmax()
    for frame_id, part in zip(seen, label, strict=True):
        if part != largest:
            model.deregister_frame(frame_id)


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
    model = models[0]
    ids = [*model.images] if with_dropped else model.reg_image_ids()
    cameras = {model.images[i].camera_id for i in ids}
    focal_lengths = [model.cameras[i].mean_focal_length() for i in cameras]
    return max(focal_lengths) / min(focal_lengths) if focal_lengths else 1.0
