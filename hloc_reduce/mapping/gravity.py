"""Which way is up in a model, by its upright cameras."""

from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np
import pycolmap

from ..utils.images import TURNS

# People hold cameras level, but point them up and down. The roll is the least that is assumed.
ROLL, PITCH = 1.0, 10.0  # degrees, standard deviations
ROUNDS, DEVIATIONS = 5, 1.48  # in a median of absolute values
MAX_TILT = 30.0  # degrees by which upright cameras differ from each other
MAX_TRIED = 500  # cameras whose up directions are compared with all others
UP = np.array([0.0, 0.0, 1.0])


class Gravity(NamedTuple):
    """Which way is up.

    Args:
        up: (3,) unit vector in the frame of the model.
        number: of cameras that were held upright.
    """

    up: np.ndarray
    number: int

    def level(self) -> pycolmap.Rotation3d:
        """Return the smallest rotation that turns the frame so that z is up."""
        axis, cosine = np.cross(self.up, UP), float(self.up @ UP)
        if cosine < -1 + 1e-12:
            return pycolmap.Rotation3d(np.array([1.0, 0.0, 0.0, 0.0]))
        quaternion = np.array([*axis, 1 + cosine])
        return pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion))


def find(
    model: pycolmap.Reconstruction,
    orientations: Mapping[str, int | None],
    unknown: Collection[str] = (),
) -> Gravity | None:
    """Find which way is up.

    Args:
        model: the model.
        orientations: EXIF orientation of each photo by name; others are taken to be upright.
        unknown: photos that may be stored in any orientation, which tell nothing.

    Returns:
        None unless more than half of the other cameras, and at least two, agree to `MAX_TILT`.
    """
    images = [model.images[i] for i in model.reg_image_ids()]
    images = [image for image in images if image.name not in unknown]
    if not images:
        return None
    axes = np.array([_upright(image, orientations.get(image.name)) for image in images])
    rows, downs, _ = axes.transpose(1, 0, 2)
    tried = downs[:: -(-len(downs) // MAX_TRIED)]
    agree = downs @ tried.T > np.cos(np.deg2rad(MAX_TILT))
    upright = agree[:, np.argmax(agree.sum(axis=0))]
    number = int(upright.sum())
    if number < 2 or 2 * number <= len(images):
        return None
    return Gravity(_up(rows[upright], -downs[upright]), number)


def _up(rows: np.ndarray, ups: np.ndarray) -> np.ndarray:
    """Return the unit vector (3,) that is up.

    By least squares, rows of pixels (N, 3) are horizontal to `ROLL`, or as they turn out to be,
    and columns (N, 3) vertical to `PITCH`.
    """
    up, roll = np.zeros(3), ROLL
    for _ in range(ROUNDS):
        level = rows / roll
        matrix = level.T @ level + len(ups) * np.eye(3) / PITCH**2
        up = np.linalg.solve(matrix, ups.sum(axis=0) / PITCH**2)
        up /= np.linalg.norm(up)
        roll = max(ROLL, np.rad2deg(np.median(np.abs(rows @ up))) * DEVIATIONS)
    return up


def _upright(image: pycolmap.Image, orientation: int | None) -> np.ndarray:
    """Return the axes of a camera that is turned upright, right, down and forward, as rows."""
    angle = np.deg2rad(90 * TURNS.get(orientation or 0, 0))
    cosine, sine = np.cos(angle), np.sin(angle)
    # what is right in a photo as it is stored is up once that is turned counterclockwise
    turn = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    return turn @ image.cam_from_world().rotation.matrix()
