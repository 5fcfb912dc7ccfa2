"""COLMAP databases: images and their cameras, keypoints and matches."""

import errno
import fcntl
import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
import pycolmap

from ..cli import InputError, choose, some
from ..images import check_format, check_readable
from ..locks import has_locks
from ..options import Option

Options = TypeVar("Options")
Pair = tuple[str, str]  # names of images

CAMERA_MODES = {name.lower(): mode for name, mode in pycolmap.CameraMode.__members__.items()}
CAMERA_MODE = Option(
    "camera mode",
    CAMERA_MODES,
    "as in COLMAP; auto: those whose EXIF data have the same make, model, focal length and size, "
    "and tell of no digital zoom and no crop",
    lower=True,
)
# those that photos may have: one of all directions has no focal length
CAMERA_MODELS = [
    name
    for name in pycolmap.CameraModelId.__members__
    if name not in ("INVALID", "EQUIRECTANGULAR")
]
CAMERA_MODEL = Option("camera model", CAMERA_MODELS, "COLMAP's")
CameraMode = Annotated[pycolmap.CameraMode, CAMERA_MODE]
FULL = 2**16  # free bytes, below which COLMAP cannot even open a database


@contextmanager
def open_database(database: Path) -> Iterator[pycolmap.Database]:
    """Open a COLMAP database, without a transaction: on a full disk it would abort the process."""
    with full_disk(database), _open(database) as opened:
        yield opened


def _open(database: Path) -> pycolmap.Database:
    """Open a COLMAP database.

    Raises:
        InputError: when its file system has no locks, without which SQLite does not write.
    """
    try:
        return pycolmap.Database.open(database)
    except RuntimeError:
        if database.exists() and not has_locks(database, fcntl.lockf):
            raise InputError(
                f"The file system of {database} has no locks, which COLMAP's databases need: "
                "choose a folder on a local disk."
            ) from None
        raise


@contextmanager
def full_disk(path: Path) -> Iterator[None]:
    """Raise an OSError if the disk gets full in a block that writes `path`."""

    def check() -> None:
        if shutil.disk_usage(path.parent).free < FULL:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from None

    try:
        yield
    except (RuntimeError, sqlite3.Error):
        check()
        raise
    check()


def write_reference(database: Path, reference: pycolmap.Reconstruction) -> None:
    """Create a COLMAP database with the cameras and images of a model, with their ids."""
    with open_database(database) as opened:
        for camera in reference.cameras.values():
            opened.write_camera(camera, use_camera_id=True)
        for rig in reference.rigs.values():
            opened.write_rig(rig, use_rig_id=True)
        for frame in reference.frames.values():
            opened.write_frame(frame, use_frame_id=True)
        for image in reference.images.values():
            opened.write_image(image, use_image_id=True)


def camera_mode(name: str) -> pycolmap.CameraMode:
    """Return COLMAP's camera mode by its name in lower or upper case, such as per_folder.

    Raises:
        InputError: for an unknown name.
    """
    return CAMERA_MODES[choose("camera mode", name.lower(), CAMERA_MODES)]


def lens_options(model: str, params: str | None = None) -> dict[str, str]:
    """Return pycolmap's options to import photos by a kind of lens; none for COLMAP's default.

    Args:
        model: one of `CAMERA_MODELS`.
        params: its parameters, separated by commas, as COLMAP's `--ImageReader.camera_params`.

    Raises:
        InputError: for an unknown model, or parameters that are not as many positive or finite
            numbers as it has.
    """
    choose("camera model", model, CAMERA_MODELS)
    if params is None:
        return (
            {} if model == pycolmap.ImageReaderOptions().camera_model else {"camera_model": model}
        )
    camera = pycolmap.Camera()
    camera.model = pycolmap.CameraModelId.__members__[model]
    number = len(camera.params_info.split(","))
    try:
        values = [float(value) for value in params.split(",")]
    except ValueError:
        values = []
    is_lens = len(values) == number and np.isfinite(values).all()
    if not is_lens or min(values[i] for i in camera.focal_length_idxs()) <= 0:
        raise InputError(
            f"--camera_params {params}: {model} has {number}, "
            f"{camera.params_info}: numbers with commas between, focal lengths above 0."
        )
    return {"camera_model": model, "camera_params": params}


def parse_options(kind: Callable[[dict], Options], options: dict, what: str) -> Options:
    """Convert a dict to options of pycolmap.

    Args:
        kind: pycolmap's class.
        options: their values by name.
        what: their name in messages.

    Raises:
        InputError: for an unknown option, or a value of another type.
    """
    try:
        return kind(options)
    except (AttributeError, TypeError, RuntimeError, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        raise InputError(f"The {what} options {options} cannot be used ({reason}).") from None


def import_images(
    database: Path,
    image_dir: Path,
    names: list[str],
    camera_mode: pycolmap.CameraMode,
    options: dict,
) -> None:
    """Create a COLMAP database with images, and cameras guessed from their EXIF data.

    Raises:
        InputError: for an unknown option, or an image that COLMAP skips.
    """
    check_readable(image_dir, names, check_format)  # which some versions would read
    with open_database(database):
        pass
    reader = parse_options(pycolmap.ImageReaderOptions, options, "image")
    pycolmap.import_images(database, image_dir, camera_mode, image_names=names, options=reader)
    with open_database(database) as opened:
        imported = {image.name for image in opened.read_all_images()}
    if skipped := [name for name in names if name not in imported]:
        check_readable(image_dir, skipped)
        reason = "they cannot be read"
        if camera_mode in (pycolmap.CameraMode.SINGLE, pycolmap.CameraMode.PER_FOLDER):
            reason += " or differ in size from the images that share their camera"
        raise InputError(
            f"COLMAP skipped {len(skipped)} images in {image_dir}, because {reason}: "
            f"{some(skipped)}."
        )


def write_matches(
    database: Path,
    keypoints: dict[str, np.ndarray],
    matches: Mapping[Pair, tuple[np.ndarray, np.ndarray | pycolmap.TwoViewGeometry | None]],
) -> None:
    """Write the keypoints and matches of images into a COLMAP database.

    Args:
        database: has the images.
        keypoints: (N, 2) in COLMAP's pixels, by image name.
        matches: all and the verified matches (M, 2) of pairs of image names, or their geometry;
            None instead of the verified ones if `verify_matches` will find them.
    """
    with open_database(database) as opened:
        image_ids = {image.name: image.image_id for image in opened.read_all_images()}
        for name, points in keypoints.items():
            opened.write_keypoints(image_ids[name], points.astype(np.float32))
        for (name0, name1), (all_matches, verified) in matches.items():
            ids = image_ids[name0], image_ids[name1]
            opened.write_matches(*ids, all_matches.astype(np.uint32))
            if verified is None:
                continue
            if isinstance(verified, np.ndarray):
                # COLMAP 4.2.1 and later skip geometries with an undefined configuration
                verified = pycolmap.TwoViewGeometry(
                    config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED,
                    inlier_matches=verified.astype(np.uint32),
                )
            opened.write_two_view_geometry(*ids, verified)


def same_geometries(
    known: Path, database: Path, keypoints: dict[str, np.ndarray], matches: dict[Pair, np.ndarray]
) -> dict[Pair, pycolmap.TwoViewGeometry]:
    """Return the geometries of pairs that another database has verified with the same data.

    Args:
        known: the other database.
        database: has the images, with their cameras.
        keypoints: (N, 2) in COLMAP's pixels, by image name.
        matches: (M, 2) of pairs of image names.

    Returns:
        From pair to geometry, of those with the same cameras, keypoints and matches in `known`.
    """
    with open_database(database) as opened:
        wanted = _cameras_of_images(opened)
    found = {}
    with open_database(known) as opened:
        new_name = hasattr(opened, "exists_two_view_geometry")  # not in pycolmap 3.13
        is_verified = "exists_two_view_geometry" if new_name else "exists_inlier_matches"
        cameras = _cameras_of_images(opened)
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        same = {
            name
            for name in ids.keys() & keypoints.keys()
            if cameras[name] == wanted[name]
            and np.array_equal(
                opened.read_keypoints(ids[name])[:, :2], keypoints[name].astype(np.float32)
            )
        }
        for (a, b), rows in matches.items():
            if not {a, b} <= same:
                continue
            pair = ids[a], ids[b]
            # also those without inliers, which take longest
            is_known = getattr(opened, is_verified)(*pair)
            if is_known and np.array_equal(opened.read_matches(*pair), rows):
                found[a, b] = opened.read_two_view_geometry(*pair)
    return found


def _cameras_of_images(opened: pycolmap.Database) -> dict[str, tuple]:
    """Return what a database knows of the camera of each image, but for its id."""
    cameras = {
        one.camera_id: (one.model, one.width, one.height, [*one.params], one.has_prior_focal_length)
        for one in opened.read_all_cameras()
    }
    return {image.name: cameras[image.camera_id] for image in opened.read_all_images()}


def read_cameras(database: Path) -> dict[int, pycolmap.Camera]:
    """Return the cameras of a COLMAP database by their ids."""
    with open_database(database) as opened:
        return {camera.camera_id: camera for camera in opened.read_all_cameras()}


def read_verified(database: Path) -> dict[Pair, np.ndarray]:
    """Return the verified matches (M, 2) int of each pair of images that has any."""
    with open_database(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        geometries = zip(*opened.read_two_view_geometries(), strict=True)
    found = (
        (pycolmap.pair_id_to_image_pair(pair), np.asarray(geometry.inlier_matches, np.int64))
        for pair, geometry in geometries
    )
    return {(names[pair[0]], names[pair[1]]): rows for pair, rows in found if len(rows)}


def count_verified(database: Path) -> dict[Pair, int]:
    """Return the number of verified matches of each pair of images that has any."""
    with open_database(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        counts = zip(*opened.read_two_view_geometry_num_inliers(), strict=True)
    ids = ((pycolmap.pair_id_to_image_pair(pair), int(count)) for pair, count in counts)
    return {(names[pair[0]], names[pair[1]]): count for pair, count in ids if count}
