"""Coordinates near the origin and of moderate size, in which COLMAP's solvers are exact.

They stop at a gradient or a step of a given size, so far from the origin, as in UTM or ECEF, and in
small units, such as millimetres, a camera that is off by a thousandth of the distance and more
counts as found.
"""

import copy
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pycolmap

EXTENT = 16  # units: origins are multiples, so that most maps in a frame of their own keep theirs


def near_from_world(points: np.ndarray) -> pycolmap.Sim3d:
    """Return a frame near points, parallel to theirs.

    Its unit is about the median distance of the points from their centre, a power of two, which
    rounds no coordinate.

    Args:
        points: (N, 3), in any units.
    """
    if len(points) == 0:
        return pycolmap.Sim3d()
    centre = np.median(points, axis=0)
    distance = np.median(np.linalg.norm(points - centre, axis=1))
    unit = 2.0 ** np.round(np.log2(distance)) if distance > 0 else 1.0
    origin = EXTENT * unit * np.rint(centre / (EXTENT * unit))
    return pycolmap.Sim3d(1 / unit, pycolmap.Rotation3d(), -origin / unit)


def transformed(frame: pycolmap.Sim3d, points: np.ndarray) -> np.ndarray:
    """Return points (N, 3) float64 in another frame, parallel to theirs."""
    return frame.scale * points + frame.translation


@contextmanager
def near_origin(model: pycolmap.Reconstruction) -> Iterator[pycolmap.Sim3d]:
    """Move a model into the frame `near_from_world` of its images in a block, and back after it.

    Poses that the block leaves alone are the same to the bit.

    Yields:
        That frame.
    """
    images = [model.images[i] for i in model.reg_image_ids()]
    centres = np.array([image.projection_center() for image in images]).reshape(-1, 3)
    frame, before = near_from_world(centres), _poses(model)
    model.transform(frame)
    moved = _poses(model)
    try:
        yield frame
    finally:
        after = _poses(model)
        model.transform(frame.inverse())
        for i in before.keys() & after.keys():
            if np.array_equal(after[i].matrix(), moved[i].matrix()):
                model.frames[i].rig_from_world = before[i]


def _poses(model: pycolmap.Reconstruction) -> dict[int, pycolmap.Rigid3d]:
    """Return copies of the poses of the frames that have one."""
    frames = model.frames.items()
    return {i: copy.deepcopy(frame.rig_from_world) for i, frame in frames if frame.has_pose()}
