"""What clients send: photos, and what goes with them. Nobody vouches for any of it."""

import base64
import binascii
import json
import math
from collections.abc import Callable, Iterable, Mapping
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from ..localization.rigs import NOT_UNIT
from ..utils.cli import some
from ..utils.images import refusal
from ..utils.parsers import parse_camera

MAX_PIXELS = 100_000_000  # of a photo: a small file may be a huge image
MAX_CAMERAS = 16  # of a rig
MAX_COMMAS = 64 * MAX_CAMERAS  # in its JSON: 20 MB of brackets would take 500 MB of memory
PHOTO_FORMATS = ("JPEG", "PNG")
POSE = "qw,qx,qy,qz,tx,ty,tz"
CAMERA = "MODEL WIDTH HEIGHT PARAMS"
SHOWN = 20  # letters of a wrong value


class Refused(Exception):
    """A request that is refused, with the HTTP status and the reason."""

    def __init__(self, status: int, reason: str):
        self.status, self.reason = status, reason
        super().__init__(reason)


class RigCamera(NamedTuple):
    """A camera of a rig.

    Args:
        photo: content of the file of its photo.
        camera: its intrinsics.
        cam_from_rig: its pose in the rig.
    """

    photo: bytes
    camera: pycolmap.Camera
    cam_from_rig: pycolmap.Rigid3d


def parameters(given: list[tuple[str, str]], known: Iterable[str]) -> dict[str, Any]:
    """Parse the parameters of a request.

    Args:
        given: names and values in its URL.
        known: the names that it may have, of `PARAMETERS`.

    Raises:
        Refused: if one is unknown or wrong, is there twice, or needs another.
    """
    names, known = [name for name, _ in given], tuple(known)
    _check_names(names, known, "parameters")
    if twice := [name for name in known if names.count(name) > 1]:
        raise Refused(400, f"{' and '.join(twice)}: give it once")
    if "radius" in names and "near" not in names:
        raise Refused(400, "radius: it is that of near, which is not given")
    return {name: PARAMETERS[name](value) for name, value in given}


def _check_names(names: Iterable[str], known: tuple[str, ...], what: str) -> None:
    if unknown := sorted(set(names) - set(known)):
        named = some(name[:SHOWN] for name in unknown)
        raise Refused(400, f"unknown {what}: {named}; there are {_listed(known)}")


def _listed(names: tuple[str, ...]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def _flag(text: str) -> bool:
    if text not in ("0", "1"):
        raise Refused(400, f"inliers is {text[:SHOWN]!r}: it is 0 or 1")
    return text == "1"


def _radius(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise Refused(400, f"radius is {text[:SHOWN]!r}: it is a number") from None


def _camera(text: str) -> pycolmap.Camera:
    """Parse intrinsics as in a query list, or with commas."""
    try:
        return parse_camera(text.replace(",", " ").split())
    except ValueError as error:
        raise Refused(400, f"camera: {error}; it is {CAMERA}") from None


def _near(text: str) -> pycolmap.Rigid3d:
    """Parse a pose as in a list of poses, or with commas."""
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
        return _pose(numbers[:4], numbers[4:])
    except ValueError as error:
        raise Refused(400, f"near: {error}; it is {POSE}, camera from world") from None


PARAMETERS: Mapping[str, Callable[[str], Any]] = {
    "camera": _camera,
    "inliers": _flag,
    "near": _near,
    "radius": _radius,
}


def _pose(qvec: list[float], tvec: list[float]) -> pycolmap.Rigid3d:
    """Return a pose; raise a ValueError that says why numbers are none."""
    if (len(qvec), len(tvec)) != (4, 3):
        raise ValueError(f"it has {len(qvec) + len(tvec)} numbers")
    if not np.isfinite([*qvec, *tvec]).all():
        raise ValueError("its numbers are not finite")
    length = math.hypot(*qvec)
    if not abs(length - 1) <= NOT_UNIT:
        raise ValueError(f"its quaternion has the length {length:.3g}, not 1")
    w, x, y, z = qvec
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w]) / length), np.array(tvec))


def rig(body: bytes) -> list[RigCamera]:
    """Parse the body of a request with the photos of a rig.

    Raises:
        Refused: if it is not JSON of the form that docs/serve.md has, or a photo is none.
    """
    if body.count(b",") > MAX_COMMAS:  # photos have none
        raise Refused(400, f"the body has too many values: a rig has 1 to {MAX_CAMERAS} cameras")
    try:
        found = json.loads(body)
    except (ValueError, RecursionError):
        raise Refused(400, "the body is not JSON") from None
    if not isinstance(found, dict) or not isinstance(found.get("cameras"), list):
        raise Refused(400, "the body is not a JSON object with a list of cameras")
    _check_names(found, ("cameras",), "keys")
    cameras = found["cameras"]
    if not 1 <= len(cameras) <= MAX_CAMERAS:
        raise Refused(400, f"{len(cameras)} cameras: a rig has 1 to {MAX_CAMERAS}")
    return [_of_rig(number, given) for number, given in enumerate(cameras)]


def _of_rig(number: int, given: object) -> RigCamera:
    """Parse a camera of a rig."""
    keys = RigCamera._fields
    try:
        if not isinstance(given, dict) or set(keys) - given.keys():
            raise Refused(400, f"it has {_listed(keys)}")
        _check_names(given, keys, "keys")
        if not isinstance(given["camera"], str):
            raise Refused(400, f"camera: it is a string, {CAMERA}")
        camera, cam_from_rig = _camera(given["camera"]), _cam_from_rig(given["cam_from_rig"])
        return RigCamera(_photo(given["photo"]), camera, cam_from_rig)
    except Refused as error:
        raise Refused(error.status, f"camera {number}: {error.reason}") from None


def _cam_from_rig(given: object) -> pycolmap.Rigid3d:
    expected = '{"qvec": [w, x, y, z], "tvec": [x, y, z]}'
    try:
        if not isinstance(given, dict) or given.keys() != {"qvec", "tvec"}:
            raise ValueError("it has other keys")
        return _pose(*(_numbers(given[key]) for key in ("qvec", "tvec")))
    except (ValueError, OverflowError) as error:
        raise Refused(400, f"cam_from_rig: {error}; it is {expected}") from None


def _numbers(values: object) -> list[float]:
    """Return a list of numbers; raise a ValueError or OverflowError for anything else."""
    if not isinstance(values, list) or not all(type(one) in (int, float) for one in values):
        raise ValueError("it has no lists of numbers")
    return [float(one) for one in values]


def _photo(text: object) -> bytes:
    """Return a photo, which is in base64."""
    try:
        photo = base64.b64decode(text, validate=True) if isinstance(text, str) else b""
    except (binascii.Error, ValueError):
        photo = b""
    if not photo:
        raise Refused(400, "photo: it is a JPEG or PNG file in base64")
    check_photo(photo, "photo")
    return photo


def check_photo(photo: bytes, name: str) -> None:
    """Check that the content of a file is a photo.

    Args:
        photo: the content.
        name: what it is called in messages.

    Raises:
        Refused: when it is not one, or has too many pixels.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(BytesIO(photo), formats=PHOTO_FORMATS) as opened:
            width, height = opened.size
    except Image.DecompressionBombError:
        width = height = MAX_PIXELS
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError):
        reason = refusal(photo[:32])
        said = f"cannot be read: {reason}" if reason else "is not a JPEG or PNG file"
        raise Refused(400, f"the {name} {said}") from None
    if width * height > MAX_PIXELS:
        raise Refused(413, f"a photo has at most {MAX_PIXELS:,} pixels")
