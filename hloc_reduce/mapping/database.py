"""A COLMAP database of images, their keypoints and their verified matches."""

from collections.abc import Iterable
from itertools import groupby
from pathlib import Path

import numpy as np
import pycolmap

from .. import logger
from ..localization import rigs as rig_files
from ..localization.exif import correct, exif_camera
from ..localization.gate import PERSPECTIVE
from ..localization.intrinsics import GUESSED_FOCAL
from ..utils import colmap

VERIFIED = "_verified.db"  # ends the name of a database beside a match file
GUESSED_FISHEYE = 0.45  # focal length of a fisheye in longer sides: 127 degrees across
# what the provenance of what is made from such a database says of its cameras
INFERRED_CAMERAS = (
    "of zooms, crops and squares: their own; of photos that were made smaller: scaled"
)


def import_images(
    database: Path,
    image_dir: Path,
    names: list[str],
    camera_mode: pycolmap.CameraMode,
    image_options: dict | None = None,
    rigs: Path | None = None,
) -> None:
    """Create a COLMAP database with images, and cameras guessed from their EXIF data.

    Photos of each camera of `rigs` share one camera, with the intrinsics of the file if it has any.

    In the mode AUTO, images with a digital zoom, or of another shape than their EXIF data say, get
    guessed cameras of their own: the focal lengths in EXIF data may be those without the zoom. The
    focal length of a camera whose first image was made smaller is corrected, see `exif.correct`.
    Parameters in `image_options` are taken as they are.

    Args:
        database: the file.
        image_dir: folder of the images.
        names: of the images.
        camera_mode: which images share a camera.
        image_options: of pycolmap's ImageReaderOptions.
        rigs: COLMAP's `rig_config.json`.

    Raises:
        InputError: for an unknown option, an image that COLMAP skips, or a wrong file of rigs.
    """
    options = _guessing(image_options or {})
    if rigs is not None and rig_files.are_of(rigs, names):
        names = _import_rigs(database, image_dir, names, rigs, options)
    if options.get("camera_params"):
        if names:
            colmap.import_images(database, image_dir, names, camera_mode, options)
        return
    found = {name: exif_camera(image_dir / name) for name in names}
    is_auto = camera_mode == pycolmap.CameraMode.AUTO
    untold = {name for name, exif in found.items() if is_auto and exif and not exif.is_original}
    if rest := [name for name in names if name not in untold]:
        colmap.import_images(database, image_dir, rest, camera_mode, options)
    if untold:
        mode = pycolmap.CameraMode.PER_IMAGE
        colmap.import_images(database, image_dir, sorted(untold), mode, options)
    guess = options.get("default_focal_length_factor") or GUESSED_FOCAL
    with colmap.open_database(database) as opened:
        images = [image for image in opened.read_all_images() if image.name in found]
        first = {image.camera_id: image.name for image in reversed(images)}
        for camera_id, name in first.items():
            camera, exif = opened.read_camera(camera_id), found[name]
            if name in untold:
                params = camera.params.copy()
                params[camera.focal_length_idxs()] = guess * max(camera.width, camera.height)
                camera.params = params.tolist()
                camera.has_prior_focal_length = False
            elif (exif is None or not correct(camera, exif)) and camera.model.name in PERSPECTIVE:
                continue
            # a fundamental matrix explains no fisheye, whereas an essential one by a guess does
            camera.has_prior_focal_length |= camera.model.name not in PERSPECTIVE
            opened.update_camera(camera)


def _guessing(options: dict) -> dict:
    """Return options of pycolmap's ImageReaderOptions with the guess of a fisheye."""
    model = str(options.get("camera_model", PERSPECTIVE[0]))
    is_told = {"camera_params", "default_focal_length_factor"} & options.keys()
    if model in PERSPECTIVE or is_told:
        return options
    return {**options, "default_focal_length_factor": GUESSED_FISHEYE}


def _import_rigs(
    database: Path, image_dir: Path, names: Iterable[str], rigs: Path, options: dict
) -> list[str]:
    """Import the photos of the cameras of rigs, and return the other ones."""
    took = rig_files.cameras_of(rigs, names)
    single = pycolmap.CameraMode.SINGLE
    for _, group in groupby(sorted(took, key=lambda name: took[name].prefix), took.get):
        of_camera = [*group]
        import_images(database, image_dir, of_camera, single, options)
        with colmap.open_database(database) as opened:
            ids = {image.name: image.camera_id for image in opened.read_all_images()}
            camera = opened.read_camera(ids[of_camera[0]])
            known = rig_files.of_rig(rigs, {of_camera[0]: (camera, "")})
            for given, _ in known.values():
                given.camera_id, given.has_prior_focal_length = camera.camera_id, True
                opened.update_camera(given)
    return [name for name in names if name not in took]


def fixed_cameras(database: Path, rigs: Path | None) -> set[int]:
    """Return the ids of the cameras of a database whose intrinsics a file of rigs gives."""
    if rigs is None:
        return set()
    with colmap.open_database(database) as opened:
        images = {image.name: image.camera_id for image in opened.read_all_images()}
    took = rig_files.cameras_of(rigs, images)
    return {images[name] for name, one in took.items() if one.camera is not None}


def verified_by(matches: Path) -> Path:
    """Return the database that keeps the verified pairs of a match file."""
    return matches.with_name(f"{matches.stem}{VERIFIED}")


def write(
    database: Path,
    image_dir: Path,
    keypoints: dict[str, np.ndarray],
    matches: dict[tuple[str, str], np.ndarray],
    camera_mode: pycolmap.CameraMode,
    verify: bool = True,
    known: Path | None = None,
    image_options: dict | None = None,
    verbose: bool = False,
    rigs: Path | None = None,
) -> None:
    """Write a new database.

    Args:
        database: the file.
        image_dir: folder of the images, whose EXIF data give the intrinsics.
        keypoints: of each image (N, 2), COLMAP's pixels.
        matches: of each pair (M, 2).
        camera_mode: which images share a camera.
        verify: verify the matches by two-view geometry, instead of taking all for verified ones.
        known: a database, whose pairs are not verified again if they are the same; it may be
            missing.
        image_options: of pycolmap's ImageReaderOptions.
        verbose: show COLMAP's log.
        rigs: COLMAP's `rig_config.json`.

    Raises:
        InputError: for an unknown option, an image that COLMAP skips, or a wrong file of rigs.
    """
    import_images(database, image_dir, list(keypoints), camera_mode, image_options, rigs)
    if rigs is not None:
        found = rig_files.configurations(rigs, keypoints)
        with colmap.open_database(database) as opened:
            pycolmap.apply_rig_config(found, opened)
    if not verify:
        colmap.write_matches(database, keypoints, {pair: (m, m) for pair, m in matches.items()})
        return
    same = {}
    if known is not None and known.exists():
        same = colmap.same_geometries(known, database, keypoints, matches)
    colmap.write_matches(
        database, keypoints, {pair: (m, same.get(pair)) for pair, m in matches.items()}
    )
    if new := [pair for pair in matches if pair not in same]:
        logger.info("Verifying %d pairs...", len(new))
        colmap.verify_matches(database, new, verbose)
