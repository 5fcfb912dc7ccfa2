"""Where photos were taken: GPS positions in EXIF data or in a CSV file."""

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..utils.cli import InputError
from ..utils.parsers import check_names, not_text
from ..utils.progress import progress
from .frame import on_earth

COLUMNS = ("name", "latitude", "longitude", "altitude")
FORM = f"A GPS file begins with the line `{','.join(COLUMNS)}`"
GPS = 0x8825  # EXIF tags
SOUTH_OR_NORTH, LATITUDE, WEST_OR_EAST, LONGITUDE, BELOW, ALTITUDE = 1, 2, 3, 4, 5, 6
BELOW_LEVEL = (1, 3, b"\x01", b"\x03")  # values of `BELOW`

Positions = dict[str, np.ndarray]  # (3,) latitude, longitude and altitude by name, see `position`


def position(latitude: float, longitude: float, altitude: float | None) -> np.ndarray | None:
    """Return a GPS position, None for (0, 0), which stands for a missing one.

    Args:
        latitude: degrees (WGS84).
        longitude: degrees.
        altitude: metres above the ellipsoid, None if not known.

    Returns:
        (3,) float64 latitude, longitude and altitude, which is NaN if not known.
    """
    if latitude == longitude == 0:
        return None
    return np.array([latitude, longitude, np.nan if altitude is None else altitude], float)


def of_photos(image_dir: Path, names: Iterable[str]) -> Positions:
    """Read the positions in the EXIF data of photos; those without one are left out."""
    named = progress([*names], "Reading GPS", "photo")
    found = {name: of_photo(image_dir / name) for name in named}
    return {name: place for name, place in found.items() if place is not None}


def of_photo(image: Path) -> np.ndarray | None:
    """Return the position in the EXIF data of a photo, see `position`; None without a sound one."""
    try:
        tags = gps_tags(image)
        latitude = _degrees(tags[LATITUDE], tags.get(SOUTH_OR_NORTH), "S")
        longitude = _degrees(tags[LONGITUDE], tags.get(WEST_OR_EAST), "W")
        altitude = _altitude(tags)
    except Exception:  # Pillow raises many types for broken data
        return None
    return position(latitude, longitude, altitude) if on_earth(latitude, longitude) else None


def gps_tags(image: Path) -> dict[int, Any]:
    """Return the EXIF data of a photo that are of GPS, by their tags."""
    with Image.open(image) as opened:
        return dict(opened.getexif().get_ifd(GPS))


def _degrees(values: Any, side: object, negative: str) -> float:
    """Return the degrees of degrees, minutes and seconds."""
    degrees, minutes, seconds = map(float, values)
    sign = -1 if str(side).strip("\0 ").upper() == negative else 1
    return sign * (degrees + minutes / 60 + seconds / 3600)


def _altitude(tags: Mapping[int, Any]) -> float | None:
    """Return the altitude in EXIF data, None without a sound one."""
    try:
        altitude = float(tags[ALTITUDE])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    sign = -1 if tags.get(BELOW) in BELOW_LEVEL else 1
    return sign * altitude if np.isfinite(altitude) else None


def read_csv(path: Path) -> Positions:
    """Read positions from a CSV file with the columns `COLUMNS`; altitudes may be empty.

    Raises:
        InputError: when it is missing, is no CSV file in UTF-8, lacks a column, has a broken
            number or one that is out of range, or a name twice.
    """
    found: dict[str, np.ndarray | None] = {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            given = [str(column).strip() for column in reader.fieldnames or ()]
            reader.fieldnames = given
            if missing := [column for column in COLUMNS if column not in given]:
                raise InputError(f"{path} has no column {' and no column '.join(missing)}. {FORM}.")
            for row in reader:
                place = f"{path}:{reader.line_num}"
                [name] = check_names([(row["name"] or "").strip()], place)
                if name in found:
                    raise InputError(f"{place}: {name} is listed twice.")
                if "".join(row.pop(None, ())).strip():
                    raise InputError(
                        f"{place} has more values than columns: decimals have a point, no comma."
                    )
                found[name] = _of_row(row, place)
    except UnicodeDecodeError:
        raise not_text(path, f"{FORM}; save it as UTF-8.") from None
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror}.") from None
    except csv.Error as error:
        raise InputError(f"{path} is not a CSV file ({error}). {FORM}.") from None
    return {name: place for name, place in found.items() if place is not None}


def _of_row(row: Mapping[str, str | None], place: str) -> np.ndarray | None:
    """Return the position in a row; `place` names its line."""
    latitude, longitude = (_number(row[column], column, place) for column in COLUMNS[1:3])
    if not on_earth(latitude, longitude):
        raise InputError(
            f"{place}: latitude {latitude:g} and longitude {longitude:g} are not degrees from -90 "
            "to 90 and from -180 to 180. Are they swapped?"
        )
    has_altitude = (row["altitude"] or "").strip()
    altitude = _number(row["altitude"], "altitude", place) if has_altitude else None
    return position(latitude, longitude, altitude)


def _number(text: str | None, column: str, place: str) -> float:
    try:
        found = float(text or "")
    except ValueError:
        found = np.nan
    if not np.isfinite(found):
        raise InputError(f"{place}: the {column} {text or ''!r} is not a number.")
    return found
