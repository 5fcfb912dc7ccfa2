"""Write features and matches into a new COLMAP database.

For `colmap mapper` of COLMAP 3.8 and later, GLOMAP and `colmap gui`. The database has keypoints,
matches and verified matches, but no descriptors: nothing needs to be matched again.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import pycolmap

from . import logger
from .mapping import database as databases
from .triangulation import read_matches
from .utils import cli, colmap, options
from .utils.cli import InputError
from .utils.files import replacing
from .utils.h5 import list_h5_names
from .utils.images import list_images
from .utils.match_files import list_pairs
from .utils.parsers import write_pairs
from .utils.paths import strings_as_paths


@strings_as_paths
def main(
    features: Path,
    matches: Path,
    image_dir: Path,
    database: Path,
    camera_mode: colmap.CameraMode = pycolmap.CameraMode.AUTO,
    overwrite: bool = False,
    verbose: bool = False,
) -> Path:
    """Write a COLMAP database of all images of a feature file.

    Args:
        features: feature file.
        matches: match file; pairs with other images are left out.
        image_dir: folder of the images, whose EXIF data give the intrinsics.
        database: the new database.
        camera_mode: which photos share a camera.
        overwrite: replace a file that exists.
        verbose: show COLMAP's log.

    Returns:
        `database`.

    Raises:
        InputError: when an input is missing or broken, no pair is matched, or the file exists.
    """
    cli.check_file(database, "the database")
    if database.exists() and not overwrite:
        raise InputError(f"{database} exists: choose another --database, or --overwrite it.")
    names = list_images(image_dir, list_h5_names(features))
    pairs = list_pairs(matches, names)
    if not pairs:
        raise InputError(f"{matches} has no pair of images of {features}.")
    with (
        replacing(database) as temporary,
        TemporaryDirectory(".tmp", ".", database.parent) as folder,
    ):
        listed, of_pycolmap = Path(folder, "pairs.txt"), Path(folder, "colmap.db")
        write_pairs(pairs, listed)
        keypoints, _, found = read_matches(names, listed, features, matches, None)
        databases.write(
            of_pycolmap,
            image_dir,
            keypoints,
            found,
            camera_mode,
            verbose=verbose,
        )
        verified = colmap.count_verified(of_pycolmap)
        colmap.write_for_all(of_pycolmap, temporary)
        for left in ("-wal", "-shm", "-journal"):  # of the old database: they would change the new
            database.with_name(f"{database.name}{left}").unlink(missing_ok=True)
    logger.info(
        "%d images, %d of %d pairs with verified matches: %s",
        len(names),
        len(verified),
        len(found),
        database,
    )
    return database


def _main() -> None:
    example = (
        "--features outputs/feats-dog-colmap_sift_sv64.h5 --matches outputs/matches.h5 "
        "--image_dir photos --database new.db"
    )
    options.call(main, __doc__, example)


if __name__ == "__main__":
    cli.run(_main)
