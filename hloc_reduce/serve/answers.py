"""Localize what clients send, and tell it as JSON values."""

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pycolmap

from ..localization.intrinsics import to_list
from ..utils.cli import InputError
from . import requests
from .requests import Refused

if TYPE_CHECKING:
    from ..maps.localizer import Localizer

RETRIEVED_SHOWN = 5  # retrieved images in an answer
# what answers have of the info of a `Localizer` as it is, on photos and on rigs
OF_BOTH = "reason", "confidence", "agreement", "probability", "num_inliers", "again", "map_doubts"
OF_PHOTOS = "turned", "near", "intrinsics"
OF_CAMERAS = "num_matches", "num_correspondences", "num_inliers"
OF_POSES = ("wgs84",)  # only with a pose, and if they are known


def answer(
    localizer: "Localizer",
    photo: bytes,
    camera: pycolmap.Camera | None = None,
    inliers: bool = False,
    near: pycolmap.Rigid3d | None = None,
    radius: float | None = None,
) -> dict[str, Any]:
    """Localize a photo and return the content of the answer.

    Args:
        localizer: of the map.
        photo: content of its file.
        camera: its intrinsics, None if they are not known.
        inliers: whether the answer has them.
        near: about its pose, see `Localizer.localize`.
        radius: see `Localizer.localize`.

    Raises:
        Refused: when it is not a photo, has too many pixels, or another size than its intrinsics,
            or `near` is far from the map.
    """
    requests.check_photo(photo, "body")
    # a file, as its EXIF data tell the intrinsics
    with tempfile.NamedTemporaryFile(suffix=".jpg") as file:
        Path(file.name).write_bytes(photo)
        try:
            pose, info = localizer.localize(file.name, camera, near=near, radius=radius)
        except InputError as error:
            raise Refused(400, str(error).replace(f" {file.name}", "")) from None
    of_photo = {key: info[key] for key in OF_PHOTOS} | {"camera": to_list(info["camera"])}
    return _answer(pose, info, of_photo | _retrieved(info, inliers))


def answer_of_rig(localizer: "Localizer", body: bytes, inliers: bool = False) -> dict[str, Any]:
    """Localize the photos of a rig and return the content of the answer.

    Args:
        localizer: of the map.
        body: of the request, see `requests.rig`.
        inliers: whether the answer has them.

    Raises:
        Refused: when it is not such a body, or a photo has another size than its intrinsics.
    """
    photos, cameras, cams_from_rig = zip(*requests.rig(body), strict=True)
    with tempfile.TemporaryDirectory() as folder:
        # files, as their EXIF data tell which side is up
        files = [Path(folder) / f"{number}.jpg" for number in range(len(photos))]
        for file, photo in zip(files, photos, strict=True):
            file.write_bytes(photo)
        try:
            pose, info = localizer.localize_rig(files, cameras, cams_from_rig)
        except InputError as error:
            said = str(error)
            for number, file in enumerate(files):
                said = said.replace(str(file), f"of camera {number}")
            raise Refused(400, said) from None
    of_cameras = [
        {key: one[key] for key in OF_CAMERAS} | _retrieved(one, inliers) for one in info["cameras"]
    ]
    return _answer(pose, info, {"cameras": of_cameras})


def _retrieved(info: dict, inliers: bool) -> dict[str, Any]:
    """Return the map images that a photo is like, and its inliers."""
    found = {"retrieved": info["retrieved"][:RETRIEVED_SHOWN]}
    if inliers:
        chosen = info["inliers"]
        found |= {key: info[key][chosen].tolist() for key in ("points2D", "points3D")}
    return found


def _answer(pose: pycolmap.Rigid3d | None, info: dict, seen: dict[str, Any]) -> dict[str, Any]:
    """Return an answer.

    Args:
        pose: of the photo or the rig.
        info: of the `Localizer`.
        seen: what answers on photos and on rigs have not in common.
    """
    found: dict[str, Any] = {
        "localized": pose is not None,
        **{key: info[key] for key in OF_BOTH},
        **seen,
        "seconds": {stage: round(value, 4) for stage, value in info["seconds"].items()},
    }
    if pose is None:
        return found
    x, y, z, w = pose.rotation.quat.tolist()
    covariance = info["covariance"]
    return found | {
        "qvec": [w, x, y, z],
        "tvec": pose.translation.tolist(),
        "covariance": None if covariance is None else covariance.tolist(),
        **{key: info[key] for key in OF_POSES if info.get(key)},
    }
