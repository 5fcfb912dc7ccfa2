"""A COLMAP database of images, their keypoints and their verified matches."""

from pathlib import Path

import numpy as np
import pycolmap

from ..localization.exif import correct, exif_camera
from ..localization.intrinsics import GUESSED_FOCAL
from ..utils import colmap

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
) -> None:
    """Create a COLMAP database with images, and cameras guessed from their EXIF data.

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

    Raises:
        InputError: for an unknown option, or an image that COLMAP skips.
    """
    options = image_options or {}
    if options.get("camera_params"):
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
        first = {image.camera_id: image.name for image in reversed(opened.read_all_images())}
        for camera_id, name in first.items():
            camera, exif = opened.read_camera(camera_id), found[name]
            if name in untold:
                params = camera.params.copy()
                params[camera.focal_length_idxs()] = guess * max(camera.width, camera.height)
                camera.params = params.tolist()
                camera.has_prior_focal_length = False
            elif exif is None or not correct(camera, exif):
                continue
            opened.update_camera(camera)


def write(
    database: Path,
    image_dir: Path,
    keypoints: dict[str, np.ndarray],
    matches: dict[tuple[str, str], np.ndarray],
    unverified: Path | None,
    camera_mode: pycolmap.CameraMode,
    image_options: dict | None = None,
    verbose: bool = False,
) -> None:
    """Write a new database.

    Args:
        database: the file.
        image_dir: folder of the images, whose EXIF data give the intrinsics.
        keypoints: of each image (N, 2), COLMAP's pixels.
        matches: of each pair (M, 2).
        unverified: text file of the pairs to verify by two-view geometry; None to take all matches
            for verified ones.
        camera_mode: which images share a camera.
        image_options: of pycolmap's ImageReaderOptions.
        verbose: show COLMAP's log.

    Raises:
        InputError: for an unknown option, or an image that COLMAP skips.
    """
    import_images(database, image_dir, list(keypoints), camera_mode, image_options)
    verified = {pair: (rows, None if unverified else rows) for pair, rows in matches.items()}
    colmap.write_matches(database, keypoints, verified)
    if unverified:
        colmap.verify_matches(database, unverified, verbose)
