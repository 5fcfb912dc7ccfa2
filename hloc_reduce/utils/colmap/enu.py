"""Latitude, longitude and altitude (WGS84), and metres east, north and up of an origin."""

import inspect

import numpy as np
import pycolmap

# pycolmap 3.13 does not take the altitude of the origin
_TAKES_ALTITUDE = "ref_alt" in (inspect.getdoc(pycolmap.GPSTransform.ellipsoid_to_enu) or "")


def enu_from_ellipsoid(positions: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return positions in the frame of an origin.

    Args:
        positions: (N, 3) float64 latitude and longitude in degrees, altitude in metres.
        origin: (3,) the same of the origin.

    Returns:
        (N, 3) float64, x east, y north, z up, in metres.
    """
    latitude, longitude, altitude = map(float, origin)
    reference = (latitude, longitude, altitude) if _TAKES_ALTITUDE else (latitude, longitude)
    # the first position is the origin of pycolmap 3.13
    rows = np.vstack([[latitude, longitude, altitude], positions])
    return pycolmap.GPSTransform().ellipsoid_to_enu(rows, *reference)[1:]


def ellipsoid_from_enu(points: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return the inverse of `enu_from_ellipsoid`."""
    return pycolmap.GPSTransform().enu_to_ellipsoid(points, *map(float, origin))
