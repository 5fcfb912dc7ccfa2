"""A COLMAP database of images, their keypoints and their verified matches."""

from pathlib import Path

import numpy as np
import pycolmap

from ..utils import colmap


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
    colmap.import_images(database, image_dir, list(keypoints), camera_mode, image_options or {})
    verified = {pair: (rows, None if unverified else rows) for pair, rows in matches.items()}
    colmap.write_matches(database, keypoints, verified)
    if unverified:
        colmap.verify_matches(database, unverified, verbose)
