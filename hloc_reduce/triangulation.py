"""Triangulate a map from matches of images whose poses are known."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated

import numpy as np
import pycolmap

from . import logger
from .localization.projection import median_photo_scale
from .mapping.checks import sizes
from .mapping.epipolar import agreeing
from .runtime import provenance
from .runtime.group_writer import failures
from .utils import cli, colmap, options
from .utils.cli import InputError
from .utils.feature_files import get_colmap_keypoints, get_image_size
from .utils.files import announce
from .utils.h5 import open_h5
from .utils.match_files import get_matches
from .utils.options import Option
from .utils.parsers import parse_retrieval
from .utils.paths import strings_as_paths
from .utils.progress import progress

WRITTEN_BY_HLOC = {"database.db", *(f"{part}.bin" for part in colmap.PARTS)}

Pair = tuple[str, str]
# from pair to all matches and the verified ones, both (M, 2); None for COLMAP to verify
Verified = dict[Pair, tuple[np.ndarray, np.ndarray | None]]


@strings_as_paths
def main(
    sfm_dir: Path,
    reference_model: Annotated[Path, Option(flags=("--reference_sfm_model", "--reference_model"))],
    image_dir: Path,
    pairs: Path,
    features: Path,
    matches: Path,
    skip_geometric_verification: bool = False,
    estimate_two_view_geometries: bool = False,
    min_match_score: float | None = None,
    verbose: bool = False,
    mapper_options: dict | None = None,
    overwrite: bool = False,
) -> pycolmap.Reconstruction:
    """Triangulate the matches that agree with the epipolar geometry of the known poses.

    Takes the arguments of hloc's `triangulation.main`.

    Args:
        sfm_dir: folder of the new COLMAP model; a model made from the same inputs is read instead.
        reference_model: COLMAP model with the cameras and poses of all images of the pairs. A
            camera whose photos were all resized in the same way is scaled to them.
        image_dir: folder of the images, which give the points their colours.
        pairs: text file of image pairs.
        features: feature file.
        matches: match file.
        skip_geometric_verification: use all matches, unverified.
        estimate_two_view_geometries: verify with geometries that COLMAP estimates from the matches,
            not with the known poses.
        min_match_score: use only matches with a higher score.
        verbose: show COLMAP's log.
        mapper_options: of pycolmap's IncrementalPipelineOptions. By default the largest
            reprojection errors are 4 pixels, or larger in proportion if the median longer side
            exceeds 1,600 pixels.
        overwrite: replace an existing model.

    Returns:
        The map. It has the keypoints of the feature file, in the same order.

    Raises:
        InputError: when an input is missing, photos do not have the size of their cameras, see
            `mapping.checks.sizes`, or no point can be triangulated.
    """
    options = {"random_seed": 0, "num_threads": 1, **(mapper_options or {})}
    colmap.mapper_options(options)  # raises for a wrong one
    reference_model = colmap.find_model(reference_model)
    reference, normalized = colmap.read_normalized(reference_model)
    for path in (pairs, features, matches):
        if not path.is_file():
            raise InputError(f"There is no file {path}.")
    photos = _photo_sizes(reference, features)
    resized, unfit = sizes.compare(reference, photos)
    scaled = sizes.scale_cameras(reference, resized)
    pixel_scale = median_photo_scale(image.camera for image in reference.images.values())
    mapper = colmap.mapper_options(options, pixel_scale)
    verification = {
        "skip_geometric_verification": skip_geometric_verification,
        "estimate_two_view_geometries": estimate_two_view_geometries,
        "min_match_score": min_match_score,
    }
    chosen: dict = {key: value for key, value in verification.items() if value}
    chosen |= {"normalized": True} if normalized else {}
    if pixel_scale > 1:
        chosen["pixel_scale"] = pixel_scale
    if resized:
        chosen["camera_sizes"] = {str(one): list(size) for one, size in resized.items()}
    inputs = [*colmap.model_files(reference_model), pairs, features, matches]
    made_from = provenance.of_inputs({**options, **chosen}, inputs)
    if not overwrite and provenance.is_current(sfm_dir / provenance.MADE_FROM, made_from):
        logger.info("The map %s is up to date.", sfm_dir)
        return colmap.read_model(sfm_dir)
    if unfit:
        raise InputError(f"{len(unfit)} of {len(photos)} photos {sizes.complaint(unfit)}.")
    if scaled:
        logger.info("Cameras of the model are scaled to their photos: %s.", cli.some(scaled))

    with replacing_map(sfm_dir, made_from, reference_model) as building:
        database = building / "database.db"
        _write_database(database, reference, pairs, features, matches, verification, verbose)
        logger.info("Triangulating...")
        reconstruction = colmap.triangulate_points(
            reference, database, image_dir, building, mapper, verbose
        )
        if reconstruction.num_points3D() == 0:
            raise InputError(
                f"The map is empty: COLMAP triangulated no point from the matches {matches}. "
                "Do the poses belong to these images, of this size, and do the pairs overlap?"
            )
        if resized:
            sizes.check_scaled(reconstruction)
    logger.info("The map %s:\n%s", sfm_dir, reconstruction.summary())
    _warn_of_images_without_points(reconstruction)
    return reconstruction


def _warn_of_images_without_points(reconstruction: pycolmap.Reconstruction) -> None:
    images = reconstruction.images.values()
    if alone := sorted(image.name for image in images if image.num_points3D == 0):
        logger.warning(
            "%d of %d photos have no point in the map, so no query is localized with them: %s.",
            len(alone),
            len(images),
            cli.some(alone),
        )


@contextmanager
def replacing_map(
    sfm_dir: Path, made_from: dict, reference_model: Path | None = None
) -> Iterator[Path]:
    """Give a folder for a new COLMAP model; it replaces `sfm_dir` when the block succeeds.

    Raises:
        InputError: when `sfm_dir` is `reference_model` or holds anything but a triangulated map.
    """
    sfm_dir = sfm_dir.resolve()
    inside = {path.name for path in sfm_dir.iterdir()} if sfm_dir.is_dir() else set()
    of_hloc = "database.db" in inside and inside <= WRITTEN_BY_HLOC
    is_reference = reference_model is not None and sfm_dir == reference_model.resolve()
    if inside and provenance.MADE_FROM not in inside and not of_hloc or is_reference:
        raise InputError(
            f"{sfm_dir} is not a map that this program or hloc triangulated, so it is not "
            "replaced. Choose another folder."
        )
    cli.check_folder(sfm_dir)
    announce(sfm_dir)
    building = sfm_dir.with_name(f".{sfm_dir.name}.tmp")
    shutil.rmtree(building, ignore_errors=True)
    building.mkdir(parents=True)
    try:
        yield building
        provenance.write(building / provenance.MADE_FROM, made_from)
    except BaseException:
        shutil.rmtree(building, ignore_errors=True)
        raise
    replaced = sfm_dir.with_name(f".{sfm_dir.name}.old.tmp")
    shutil.rmtree(replaced, ignore_errors=True)
    if sfm_dir.exists():
        sfm_dir.replace(replaced)
    building.replace(sfm_dir)
    shutil.rmtree(replaced, ignore_errors=True)


def _write_database(
    database: Path,
    reference: pycolmap.Reconstruction,
    pairs: Path,
    features: Path,
    matches: Path,
    verification: dict,
    verbose: bool,
) -> None:
    """Write a database of the images of a model and of their verified matches.

    What was read of these is no longer in memory when COLMAP reads the database.
    """
    colmap.write_reference(database, reference)
    names = [image.name for image in reference.images.values()]
    least = verification["min_match_score"]
    keypoints, uncertainty, found = read_matches(names, pairs, features, matches, least)
    verified = _verify(verification, reference, keypoints, uncertainty, found)
    colmap.write_matches(database, keypoints, verified)
    if any(part is None for _, part in verified.values()):
        colmap.verify_matches(database, found, verbose)


def read_matches(
    names: list[str], pairs: Path, features: Path, matches: Path, min_match_score: float | None
) -> tuple[dict[str, np.ndarray], dict[str, float], dict[Pair, np.ndarray]]:
    """Read the keypoints of images and the matches of pairs of them, each unordered pair once.

    Args:
        names: the images.
        pairs: text file of pairs.
        features: feature file.
        matches: match file.
        min_match_score: use only matches with a higher score.

    Returns:
        From image to keypoints (N, 2), COLMAP's pixels; from image to their uncertainty in pixels;
        and from pair to matches (M, 2).

    Raises:
        InputError: when something is missing, or a pair names another image.
    """
    keypoints: dict[str, np.ndarray] = {}
    uncertainty: dict[str, float] = {}
    found: dict[Pair, np.ndarray] = {}
    with open_h5(features) as file:
        for name in progress(names, "Reading keypoints", "image"):
            keypoints[name], uncertainty[name] = get_colmap_keypoints(file, name)
    with open_h5(matches) as file:
        for name0, names1 in parse_retrieval(pairs).items():
            for name1 in names1:
                for name in (name0, name1):
                    if name not in keypoints:
                        raise InputError(f"{pairs}: image {name} is not in the reference model.")
                if name0 == name1 or (name0, name1) in found or (name1, name0) in found:
                    continue
                numbers = len(keypoints[name0]), len(keypoints[name1])
                indices, scores = get_matches(file, name0, name1, numbers)
                if min_match_score:
                    if scores is None:
                        raise InputError(f"{matches}: the pair {name0}, {name1} has no scores.")
                    indices = indices[scores > min_match_score]
                found[name0, name1] = indices
    return keypoints, uncertainty, found


def _photo_sizes(reference: pycolmap.Reconstruction, features: Path) -> dict[str, sizes.Size]:
    """Return the sizes of the photos of a model, as far as a feature file has them."""
    found, unreadable = {}, failures(features)
    with open_h5(features) as file:
        for image in reference.images.values():
            if image.name not in unreadable:
                with suppress(InputError):  # features of other programs may have none
                    found[image.name] = get_image_size(file, image.name)
    return found


def _verify(
    verification: dict,
    reference: pycolmap.Reconstruction,
    keypoints: dict[str, np.ndarray],
    uncertainty: dict[str, float],
    matches: dict[Pair, np.ndarray],
) -> Verified:
    """Return for each pair all matches and the verified ones, as the arguments of `main` ask."""
    if verification["skip_geometric_verification"]:
        return {pair: (indices, indices) for pair, indices in matches.items()}
    if verification["estimate_two_view_geometries"]:
        return {pair: (indices, None) for pair, indices in matches.items()}
    return _verify_by_poses(reference, keypoints, uncertainty, matches)


def _verify_by_poses(
    reference: pycolmap.Reconstruction,
    keypoints: dict[str, np.ndarray],
    uncertainty: dict[str, float],
    matches: dict[Pair, np.ndarray],
) -> Verified:
    """Return for each pair all matches, and those close to the epipolar lines of known poses."""
    agree = agreeing(reference.images.values(), keypoints, matches, uncertainty)
    verified: Verified = {
        pair: (indices, indices[agree[pair]]) for pair, indices in matches.items()
    }
    ratios = [valid.mean() for valid in agree.values() if len(valid)]
    if ratios:
        logger.info(
            "Matches on epipolar lines: mean %.1f %%, median %.1f %%, min %.1f %%, max %.1f %%.",
            *(100 * np.array([np.mean(ratios), np.median(ratios), min(ratios), max(ratios)])),
        )
    return verified


def _main() -> None:
    example = (
        "--sfm_dir outputs/sfm --reference_model 3D-models/aachen_v_1_1 --image_dir images "
        "--pairs pairs.txt --features outputs/feats-dog-colmap_sift_sv64.h5 "
        "--matches outputs/matches.h5"
    )
    options.call(main, __doc__, example)


if __name__ == "__main__":
    cli.run(_main)
