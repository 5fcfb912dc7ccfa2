"""The frame of a map: its unit, and where on Earth its origin is."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from ..utils import colmap

METRES = "m"
TOLD_BY = ("gps", "scale", "gravity")  # what may tell a frame
WGS84 = ("latitude", "longitude", "altitude", "heading")
DIGITS = (8, 8, 3, 2)  # of these in tables: a millimetre, a hundredth of a degree
LEVEL = 1e-6  # the least horizontal part of an optical axis that has a heading


class Frame(NamedTuple):
    """The frame of a map. By default it is as it was given or reconstructed, in unknown units.

    Args:
        units: "m", or None if they are not known.
        told_by: what told the scale and the axes, of `TOLD_BY`. With "gps", x is east, y north and
            z up; with "gravity", z is up as the cameras were held.
        origin: (3,) latitude and longitude of the origin in degrees (WGS84), and its altitude in
            metres, NaN if that is not known; None if nothing tells where it is.
    """

    units: str | None = None
    told_by: tuple[str, ...] = ()
    origin: tuple[float, float, float] | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the frame as JSON values."""
        named = None
        if self.origin is not None:
            known = [None if np.isnan(number) else number for number in self.origin]
            named = dict(zip(WGS84[:3], known, strict=True))
        return {"units": self.units, "told_by": [*self.told_by], "origin": named}

    @classmethod
    def from_json(cls, content: Mapping[str, Any] | None) -> "Frame":
        """Return the frame in JSON values; that of a map of an earlier version, None, is unknown.

        Raises:
            KeyError, TypeError or ValueError: if they are wrong.
        """
        if content is None:
            return cls()
        units, told_by = content["units"], tuple(content["told_by"])
        if units not in (None, METRES) or not {*told_by} <= {*TOLD_BY}:
            raise ValueError(f"a frame in {units!r} by {told_by}")
        if content["origin"] is None:
            return cls(units, told_by)
        given = [content["origin"][key] for key in WGS84[:3]]
        latitude, longitude, altitude = (np.nan if one is None else float(one) for one in given)
        if not (on_earth(latitude, longitude) and not np.isinf(altitude)):
            raise ValueError(f"an origin at {given}")
        return cls(units, told_by, (latitude, longitude, altitude))

    def wgs84(self, cam_from_world: pycolmap.Rigid3d) -> dict[str, float | None] | None:
        """Return where on Earth a camera is, None if the frame has no origin.

        Args:
            cam_from_world: its pose.

        Returns:
            `latitude` and `longitude` in degrees; `altitude` in metres, None if that of the origin
            is not known; `heading` of the optical axis in degrees clockwise from true north, in
            [0, 360), None if the axis is vertical.
        """
        if self.origin is None:
            return None
        centre = cam_from_world.inverse().translation
        ahead = centre + cam_from_world.rotation.matrix()[2]
        places = colmap.ellipsoid_from_enu(np.array([centre, ahead]), np.nan_to_num(self.origin))
        # far from the origin, north is another direction
        east, north, _ = colmap.enu_from_ellipsoid(places[1:], places[0])[0]
        heading = np.rad2deg(np.arctan2(east, north)) % 360
        latitude, longitude, altitude = places[0].tolist()
        return {
            "latitude": latitude,
            "longitude": longitude,
            "altitude": None if np.isnan(self.origin[2]) else altitude,
            "heading": float(heading) if np.hypot(east, north) > LEVEL else None,
        }

    def row(self, cam_from_world: pycolmap.Rigid3d | None) -> dict[str, float | None]:
        """Return `wgs84`, rounded, as cells of a table; without a pose they are None."""
        if self.origin is None:
            return {}
        found = self.wgs84(cam_from_world) if cam_from_world is not None else None
        cells = found or dict.fromkeys(WGS84)
        digits = zip(WGS84, DIGITS, strict=True)
        row = {key: _rounded(cells[key], number) for key, number in digits}
        return row | {"heading": 0.0} if row["heading"] == 360 else row


UNKNOWN = Frame()


def on_earth(latitude: float, longitude: float) -> bool:
    """Tell whether degrees are a latitude and a longitude."""
    return abs(latitude) <= 90 and abs(longitude) <= 180


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
