"""Panoramas, equirectangular photos of all directions, seen as rigs of perspective views.

A panorama's pose is that of a camera at its place that looks at its centre: x to the right, y down.
The views look around in a ring. They overlap, so that nothing is cut in all of them.
"""

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap
from PIL import Image

from ..runtime import provenance
from ..utils import cli
from ..utils.cli import InputError
from ..utils.files import replacing
from ..utils.images import ORIENTATION, UnreadableImage, read_image, stored_size
from ..utils.parsers import write_poses
from ..utils.progress import progress
from .gps import GPS, gps_tags
from .records import NUMBERS, RECORDS, Log, log_file, nearness, pose_of, written

NUM_VIEWS = 6
FIELD_OF_VIEW = 90  # degrees, across and up
MAX_VIEW = 1600  # pixels of a side: features see no more
MIN_WIDTH = 1024  # pixels of a panorama: views of smaller ones have less than 326 pixels
TWICE = 0.01  # the ratio of width and height may differ from 2 by rounding
HEAD = 2**17  # bytes of a file that may have XMP data
TOLD = re.compile(rb"ProjectionType\s*(?:=|>)\s*[\"']?\s*equirectangular")
SIZES = re.compile(rb"(CroppedAreaImage|FullPano)(Width|Height)Pixels\s*(?:=|>)\s*[\"']?\s*(\d+)")
QUALITY = 95  # of JPEG
OF_VIEW = re.compile(r"^view\d{3}-\d+/")  # begins the name of a view, before that of the panorama
# what the provenance of what is made from panoramas says of their views
VIEWS = f"{NUM_VIEWS} views of {FIELD_OF_VIEW} degrees, at most {MAX_VIEW} pixels"

NONE = (
    "No photo in {} is a panorama of all directions, twice as wide as high: leave out --panoramas."
)
SHOWN = "views"  # folder of the views of queries, in that of the results
NO_RIGS = "Panoramas are rigs of their own views: leave out --rigs {}."

Size = tuple[int, int]  # width and height in pixels
SMALLEST: Size = MIN_WIDTH, MIN_WIDTH // 2


class View(NamedTuple):
    """A perspective view of a panorama.

    Args:
        name: what the names of such views begin with.
        camera: its intrinsics.
        cam_from_rig: its pose, from the panorama.
    """

    name: str
    camera: pycolmap.Camera
    cam_from_rig: pycolmap.Rigid3d


def find(image_dir: Path, names: list[str], given: bool = False) -> dict[str, Size]:
    """Return the sizes of the photos of a folder if they are panoramas, else nothing.

    Photos whose size cannot be read are left out.

    Args:
        image_dir: the folder.
        names: the photos.
        given: photos that are twice as wide as high are panoramas; if not, those of them whose XMP
            data say so (`GPano:ProjectionType`). Those that are only parts of one, by these data,
            are none.

    Raises:
        InputError: if some are panoramas and others are not, or a panorama is too small.
    """
    sizes = {name: size for name in names if (size := stored_size(image_dir / name))}
    twice = [name for name, (width, height) in sizes.items() if abs(width / height - 2) <= TWICE]
    heads = {name: _head(image_dir / name) for name in twice}
    whole = {name for name, head in heads.items() if not _is_part(head)}
    found = whole if given else {name for name in whole if TOLD.search(heads[name])}
    if not found:
        return {}
    if others := [name for name in sizes if name not in found]:
        why = "not twice as wide as high" if given else "without such XMP data"
        why = "parts of panoramas" if {*others} <= heads.keys() - whole else why
        raise InputError(
            f"{image_dir} has panoramas of all directions, {cli.some(sorted(found))}, and other "
            f"photos, {why}: {cli.some(others)}. Put panoramas into a folder of their own."
        )
    if small := [name for name in sizes if sizes[name][0] < MIN_WIDTH]:
        raise InputError(
            f"Panoramas in {image_dir} are too small, less than {MIN_WIDTH} pixels wide: "
            f"{cli.some(small)}."
        )
    return sizes


def _head(path: Path) -> bytes:
    """Return the beginning of a file, which may have XMP data; empty if it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(HEAD)
    except OSError:
        return b""


def _is_part(head: bytes) -> bool:
    """Tell whether the XMP data of a photo say that it is only a part of a panorama."""
    sizes = {(what, side): number for what, side, number in SIZES.findall(head)}
    return any(
        number != sizes.get((b"CroppedAreaImage", side), number)
        for (what, side), number in sizes.items()
        if what == b"FullPano"
    )


def views_of(size: Size) -> list[View]:
    """Return the views of a panorama of a size, which have its resolution; the first one ahead."""
    side = min(MAX_VIEW, round(2 * np.tan(np.radians(FIELD_OF_VIEW / 2)) * size[0] / (2 * np.pi)))
    focal_length = side / 2 / np.tan(np.radians(FIELD_OF_VIEW / 2))
    found = []
    for i in range(NUM_VIEWS):
        angle = 2 * np.pi * i / NUM_VIEWS
        camera = pycolmap.Camera(
            model="SIMPLE_PINHOLE",
            width=side,
            height=side,
            params=[focal_length, side / 2, side / 2],
        )
        camera.has_prior_focal_length = True
        turn = pycolmap.Rotation3d(np.array([0, -angle, 0]))
        # panoramas of another size have other cameras
        name = f"view{round(np.degrees(angle)):03}-{side}/"
        found.append(View(name, camera, pycolmap.Rigid3d(turn, np.zeros(3))))
    return found


def check(shape: tuple[int, ...]) -> None:
    """Raise an InputError for the shape of an array that is no panorama."""
    height, width = shape[:2]
    if abs(width / height - 2) > TWICE or width < MIN_WIDTH:
        raise InputError(
            f"A panorama is twice as wide as high and has {MIN_WIDTH} pixels across or more, not "
            f"{width}x{height}."
        )


def render(panorama: np.ndarray, views: list[View]) -> list[np.ndarray]:
    """Return the views of a panorama (H, W) or (H, W, 3) uint8, which are of the same kind."""
    height, width = panorama.shape[:2]
    camera = views[0].camera
    if (ratio := 2 * np.pi * camera.mean_focal_length() / width) < 1:
        width, height = round(width * ratio), round(height * ratio)
        panorama = cv2.resize(panorama, (width, height), interpolation=cv2.INTER_AREA)
    steps = (np.arange(camera.width) + 0.5 - camera.principal_point_x) / camera.mean_focal_length()
    rays = np.stack([*np.meshgrid(steps, steps), np.ones((len(steps), len(steps)))], axis=-1)
    found = []
    for view in views:
        x, y, z = np.moveaxis(rays @ view.cam_from_rig.rotation.matrix(), -1, 0)
        column = (np.arctan2(x, z) / (2 * np.pi) + 0.5) * width - 0.5
        row = (np.arctan2(y, np.hypot(x, z)) / np.pi + 0.5) * height - 0.5
        maps = column.astype(np.float32), row.astype(np.float32)
        found.append(cv2.remap(panorama, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP))
    return found


def view_names(panorama: str, views: list[View]) -> list[str]:
    """Return the names of the views of a panorama, which are JPEG files."""
    is_jpeg = Path(panorama).suffix.lower() in (".jpg", ".jpeg")
    return [f"{view.name}{panorama}{'' if is_jpeg else '.jpg'}" for view in views]


def of_views(names: Iterable[str]) -> dict[str, str]:
    """Return a view of each panorama, by its name, among photos; others are left out."""
    found: dict[str, str] = {}
    for name in names:
        if OF_VIEW.match(name):
            panorama = OF_VIEW.sub("", name)
            found.setdefault(panorama, name)
            found.setdefault(panorama.removesuffix(".jpg"), name)
    return found


def write_views(
    image_dir: Path, sizes: Mapping[str, Size], folder: Path, strict: bool = True
) -> dict[str, str]:
    """Write the views of panoramas that are not there yet, with their GPS.

    Args:
        image_dir: folder of the panoramas.
        sizes: of the panoramas, by name.
        folder: for the views, upright photos.
        strict: stop at a panorama that cannot be read.

    Returns:
        Why panoramas cannot be read, by name; they have no views.

    Raises:
        UnreadableImage: if `strict`.
    """
    unreadable = {}
    for name, size in progress([*sizes.items()], "Rendering views of panoramas", "panorama"):
        views = views_of(size)
        paths = [folder / one for one in view_names(name, views)]
        if all(path.exists() for path in paths):
            continue
        try:
            panorama = read_image(image_dir / name)
        except UnreadableImage as error:
            if strict:
                raise
            unreadable[name] = str(error)
            continue
        exif = Image.Exif()
        exif[ORIENTATION] = 1
        exif.get_ifd(GPS).update(gps_tags(image_dir / name))
        for path, pixels in zip(paths, render(panorama, views), strict=True):
            with replacing(path) as temporary:
                Image.fromarray(pixels).save(
                    temporary, format="JPEG", quality=QUALITY, subsampling=0, exif=exif
                )
    return unreadable


def write_rigs(image_dir: Path, sizes: Mapping[str, Size], folder: Path) -> tuple[Path, Path]:
    """Write the views of panoramas and COLMAP's `rig_config.json` of them; drop stale ones.

    Args:
        image_dir: folder of the panoramas.
        sizes: of the panoramas, by name.
        folder: for the files.

    Returns:
        The folder of the views, with no others, and the file.

    Raises:
        UnreadableImage: if a panorama cannot be read.
    """
    images, made_from = folder / "images", folder / provenance.MADE_FROM
    before = provenance.read(made_from)
    known = before.get("panoramas", {}) if before.get("views") == VIEWS else {}
    files = {name: image_dir / name for name in sizes}
    found = provenance.fingerprints(files, known)
    kept = {
        images / view
        for name, size in sizes.items()
        if name in known and known[name][2] == found[name][2]
        for view in view_names(name, views_of(size))
    }
    for path in images.rglob("*"):
        if path.is_file() and path not in kept:
            path.unlink()
    provenance.write(made_from, {"views": VIEWS, "panoramas": found})
    write_views(image_dir, sizes, images)
    rigs = {view[0].name: view for view in map(views_of, sizes.values())}
    with replacing(folder / "rig_config.json") as temporary:
        temporary.write_text(json.dumps([{"cameras": _cameras(one)} for one in rigs.values()]))
    return images, folder / "rig_config.json"


def _cameras(views: list[View]) -> list[dict]:
    """Return the cameras of the rig of views, as COLMAP's file has them."""
    found: list[dict] = []
    for view in views:
        x, y, z, w = view.cam_from_rig.rotation.quat.tolist()
        pose = {"cam_from_rig_rotation": [w, x, y, z], "cam_from_rig_translation": [0.0, 0.0, 0.0]}
        found.append(
            {
                "image_prefix": view.name,
                "camera_model_name": view.camera.model.name,
                "camera_params": view.camera.params.tolist(),
                **(pose if found else {"ref_sensor": True}),
            }
        )
    return found


def results_of_views(results: Path) -> Path:
    """Return the text file of the poses of views, beside that of the poses of panoramas."""
    return results.with_name(f"views_{results.name}")


def write_records(
    frames: Mapping[str, Mapping[str, pycolmap.Rigid3d]],
    records: Mapping[str, dict],
    results: Path,
    unreadable: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, dict]:
    """Write the records of panoramas from those of their views, and return them.

    Args:
        frames: of each panorama the views, with their poses in it.
        records: of the views, see `localization.stage.main`.
        results: text file of poses, next to which the records go.
        unreadable: why panoramas cannot be read.

    Returns:
        A record for each panorama, with its pose, the numbers of all its views and no camera; the
        rest is that of the view with the most inliers, which is its `view`. It is localized if the
        rig is.
    """
    found = {name: _record(views, records) for name, views in frames.items()}
    for name, reason in unreadable.items():  # instead of that its views are missing
        found[name]["reason"] = reason
    with Log(log_file(results), {"records": RECORDS, "panoramas": VIEWS}, overwrite=True) as log:
        for name, record in found.items():
            log.add(name, record)
    poses = {name: pose_of(record) for name, record in found.items()}
    write_poses({name: pose for name, pose in poses.items() if pose is not None}, results, None)
    return found


def _record(views: Mapping[str, pycolmap.Rigid3d], records: Mapping[str, dict]) -> dict:
    """Return the record of a panorama."""
    best = max(views, key=lambda name: (nearness(records[name]), records[name]["num_inliers"]))
    cam_from_rig, record = views[best], records[best]
    totals = {key: sum(records[name][key] for name in views) for key in NUMBERS}
    rig, pose, covariance = record["rig"], pose_of(record), record["covariance"]
    reason = rig["reason"] if rig else record["reason"]
    if pose is not None:
        pose = cam_from_rig.inverse() * pose
    if covariance is not None:
        moved = cam_from_rig.inverse().adjoint()
        covariance = (moved @ np.array(covariance) @ moved.T).tolist()
    return {
        **record,
        **totals,
        **written(pose),
        "view": best,
        "camera": None,
        "localized": reason is None,
        "reason": reason,
        "rig": None,
        "covariance": None if reason else covariance,
    }
