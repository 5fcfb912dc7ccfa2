"""Reconstruct a map from matches of images of which nothing else is known."""

import argparse
import shutil
from collections.abc import Iterable
from pathlib import Path

import pycolmap

from . import cli, colmap, logger, stamps
from .cli import InputError
from .extract_features import list_images
from .io import list_h5_names
from .paths import strings_as_paths
from .triangulation import STAMP, read_matches, replacing_map


@strings_as_paths
def main(
    sfm_dir: Path,
    image_dir: Path,
    pairs: Path,
    features: Path,
    matches: Path,
    camera_mode: pycolmap.CameraMode = pycolmap.CameraMode.AUTO,
    verbose: bool = False,
    skip_geometric_verification: bool = False,
    min_match_score: float | None = None,
    image_list: Path | str | Iterable[str] | None = None,
    image_options: dict | None = None,
    mapper_options: dict | None = None,
    overwrite: bool = False,
) -> pycolmap.Reconstruction:
    """Reconstruct poses, intrinsics and points by COLMAP's incremental mapper.

    Takes what hloc's `reconstruction.main` takes. The frame and the scale are arbitrary.

    Args:
        sfm_dir: the folder of the new COLMAP model; one made from the same inputs is read back.
        image_dir: folder of the images, whose EXIF data give the first guess of the intrinsics.
        pairs: text file of pairs.
        features: feature file.
        matches: match file.
        camera_mode: which images share a camera.
        verbose: show COLMAP's log.
        skip_geometric_verification: take all matches, without two-view geometry.
        min_match_score: take matches of a higher score only.
        image_list: the images, names or a text file of them; default: those of `features`.
        image_options: of pycolmap's ImageReaderOptions.
        mapper_options: of pycolmap's IncrementalPipelineOptions.
        overwrite: reconstruct anew.

    Returns:
        The model of most images. Its keypoints are those of the feature file, in the same order.

    Raises:
        InputError: when an input is missing or nothing can be reconstructed.
    """
    options = {"random_seed": 0, "num_threads": 1, **(mapper_options or {})}
    mapper = colmap.mapper_options(options)
    for path in (pairs, features, matches):
        if not path.is_file():
            raise InputError(f"There is no file {path}.")
    if image_list is None:
        image_list = list_h5_names(features)
    names = list_images(image_dir, image_list)
    chosen = {
        "camera_mode": camera_mode.name,
        "image_options": image_options or {},
        "images": names,
        "skip_geometric_verification": skip_geometric_verification,
        "min_match_score": min_match_score,
    }
    made_from = stamps.stamp({**options, **chosen}, [pairs, features, matches])
    if not overwrite and stamps.is_current(sfm_dir / STAMP, made_from):
        logger.info("The map %s is up to date.", sfm_dir)
        return colmap.read_model(sfm_dir)

    with replacing_map(sfm_dir, made_from) as building:
        database = building / "database.db"
        colmap.import_images(database, image_dir, names, camera_mode, image_options or {})
        keypoints, _, found = read_matches(names, pairs, features, matches, min_match_score)
        verified = {
            pair: (indices, indices if skip_geometric_verification else None)
            for pair, indices in found.items()
        }
        colmap.write_matches(database, keypoints, verified)
        if not skip_geometric_verification:
            colmap.verify_matches(database, pairs, verbose)
        logger.info("Reconstructing...")
        models = colmap.incremental_mapping(
            database, image_dir, building / "models", mapper, verbose
        )
        if not models:
            raise InputError(
                f"COLMAP could not reconstruct the images of {image_dir} from the matches "
                f"{matches}. Do enough of them overlap?"
            )
        models[0].write(building)
        shutil.rmtree(building / "models")
    missing = sorted(set(names) - {image.name for image in models[0].images.values()})
    if missing:
        logger.warning("%d images are not in the map: %s.", len(missing), ", ".join(missing))
    logger.info("The map %s:\n%s", sfm_dir, models[0].summary())
    return models[0]


def _main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python -m hloc_reduce.reconstruction --sfm_dir outputs/sfm "
        "--image_dir photos --pairs pairs.txt --features outputs/feats-dog-colmap_sift_sv64.h5 "
        "--matches outputs/matches.h5",
        formatter_class=cli.HelpFormatter,
    )
    parser.add_argument("--sfm_dir", type=Path, required=True, help="folder of the new model")
    parser.add_argument("--image_dir", type=Path, required=True, help="folder of the images")
    parser.add_argument("--pairs", type=Path, required=True, help="text file of image pairs")
    parser.add_argument("--features", type=Path, required=True, help="feature file")
    parser.add_argument("--matches", type=Path, required=True, help="match file")
    modes = list(pycolmap.CameraMode.__members__)
    parser.add_argument(
        "--camera_mode", default="AUTO", help=f"which images share a camera: {', '.join(modes)}"
    )
    parser.add_argument(
        "--skip_geometric_verification", action="store_true", help="take all matches"
    )
    parser.add_argument("--min_match_score", type=float, help="take matches of a higher score only")
    parser.add_argument("--image_list", type=Path, help="text file of names, one a line")
    parser.add_argument("--verbose", action="store_true", help="show COLMAP's log")
    parser.add_argument("--overwrite", action="store_true", help="reconstruct anew")
    args = parser.parse_args()
    mode = cli.choose("camera mode", args.camera_mode, modes)
    main(**{**vars(args), "camera_mode": pycolmap.CameraMode.__members__[mode]})


if __name__ == "__main__":
    cli.run(_main)
