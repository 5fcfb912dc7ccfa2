"""Reconstruct a map from matches of images of which nothing else is known."""

import argparse
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from . import cli, colmap, logger, stamps
from .cli import InputError
from .confidence import focal_lengths
from .extract_features import list_images
from .io import list_h5_names
from .overlays import drop_overlays
from .paths import strings_as_paths
from .triangulation import STAMP, read_matches, replacing_map

REGISTRATION = "registration.json"  # which images are in the model, and in other parts
# shares of the images that are in the model, below which it is reported in detail, or refused
ENOUGH, LEAST = 0.8, 0.5
NAMED = 10  # images that a message names
# COLMAP would drop parts of fewer than 10 images, or than 8 of 10
MAPPER_OPTIONS = {"random_seed": 0, "num_threads": 1, "min_model_size": 3}
# half of COLMAP's thresholds, where images are missing; a quarter of them gave wrong poses
RELAXED = {
    "init_min_num_inliers": 50,
    "init_min_tri_angle": 8.0,
    "abs_pose_min_num_inliers": 15,
}
FEW = 100  # images of which a second attempt takes little time
VERY_FEW = 30  # images of which some more take little; what comes of them is a matter of luck
SEEDS = (1, 2, 3)
MORE = 1.5  # times as many images tell that one camera took all
MAX_DISTORTION = 1.0  # as COLMAP has it for images that it registers
MANY = 3  # images of a camera from which on EXIF data do not bound its focal length
# images of one viewpoint are closer than this share of their distance to the scene
SAME_VIEWPOINT = 0.03
VIEWPOINTS = 3  # of a model, at least: two do not fix the focal lengths


class NoModelError(InputError):
    """No two images could be reconstructed."""


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
    accept_partial: bool = False,
) -> pycolmap.Reconstruction:
    """Reconstruct poses, intrinsics and points by COLMAP's incremental mapper, and check the model.

    Takes what hloc's `reconstruction.main` takes. The frame and the scale are arbitrary. Images
    whose focal length or distortion no lens has, or whose focal length is far from that of EXIF
    data, are dropped from the model.
    Where images are missing, and of more than 100 images more than a fifth, further attempts
    follow, and the model with the most images is kept: with lower thresholds, and with up to 30
    images with other pairs to begin with. With `camera_mode` AUTO, if at most two thirds are in the
    model and one camera may have taken all images, the mapper is run with one shared camera; that
    model is kept if it has at least 1.5 times as many images.

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
        mapper_options: of pycolmap's IncrementalPipelineOptions; with any there is one attempt.
        overwrite: reconstruct anew.
        accept_partial: return a model of fewer than half of the images, too.

    Returns:
        The model with the most images. Its keypoints are those of the feature file, in the same
        order.

    Raises:
        InputError: when an input is missing, nothing can be reconstructed, or fewer than half of
            the images are in the model, which is kept for a run with `accept_partial`.
    """
    sfm = reconstruct(
        *(sfm_dir, image_dir, pairs, features, matches, camera_mode, verbose),
        *(skip_geometric_verification, min_match_score, image_list, image_options),
        *(mapper_options, overwrite),
    )
    check(sfm_dir, accept_partial)
    return sfm


def reconstruct(
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
    once: bool = False,
) -> pycolmap.Reconstruction:
    """Reconstruct as `main` does, however few images the model has; if `once`, in one attempt.

    Raises:
        InputError: when an input is missing.
        NoModelError: when nothing can be reconstructed.
    """
    options = {**MAPPER_OPTIONS, **(mapper_options or {})}
    colmap.mapper_options(options)  # raises for a wrong one
    for path in (pairs, features, matches):
        if not path.is_file():
            raise InputError(f"There is no file {path}.")
    if image_list is None:
        image_list = list_h5_names(features)
    names = list_images(image_dir, image_list)
    attempts = [] if once or mapper_options else list(_attempts(len(names)))
    chosen = {
        "camera_mode": camera_mode.name,
        "image_options": image_options or {},
        "images": names,
        "skip_geometric_verification": skip_geometric_verification,
        "min_match_score": min_match_score,
        "overlays": "dropped",
        "attempts": [{}, *attempts],
        "cameras": f"plausible, distortion {MAX_DISTORTION}, one for {MORE} times as many images",
        "viewpoints": VIEWPOINTS,
        "once": once,
    }
    made_from = stamps.stamp({**options, **chosen}, [pairs, features, matches])
    is_whole = bool(stamps.read(sfm_dir / REGISTRATION))
    if not overwrite and is_whole and stamps.is_current(sfm_dir / STAMP, made_from):
        logger.info("The map %s is up to date.", sfm_dir)
        return colmap.read_model(sfm_dir)

    with replacing_map(sfm_dir, made_from) as building:
        keypoints, _, found = read_matches(names, pairs, features, matches, min_match_score)
        found = drop_overlays(keypoints, found)
        verified = {
            pair: (indices, indices if skip_geometric_verification else None)
            for pair, indices in found.items()
        }

        def write_database(mode: pycolmap.CameraMode) -> Path:
            database = building / f"database-{mode.name}.db"
            colmap.import_images(database, image_dir, names, mode, image_options or {})
            colmap.write_matches(database, keypoints, verified)
            if not skip_geometric_verification:
                colmap.verify_matches(database, pairs, verbose)
            return database

        database = write_database(camera_mode)
        enough = len(names) if len(names) <= FEW else ENOUGH * len(names)

        def reconstruct_from(database: Path) -> tuple[list[pycolmap.Reconstruction], dict]:
            """Return the largest models of all attempts, and what was dropped from them."""
            given, best = colmap.read_cameras(database), ([], {})
            # no attempt brings in an image that matches no other
            possible = min(enough, len(_matched(database)))
            for number, changed in enumerate([{}, *attempts], start=1):
                own, models_dir = colmap.mapper_options({**options, **changed}), building / "models"
                found = colmap.incremental_mapping(database, image_dir, models_dir, own, verbose)
                shutil.rmtree(models_dir, ignore_errors=True)
                best = max(best, _plausible(found, given), key=lambda both: _size(both[0]))
                logger.info(
                    "Attempt %d of up to %d: %d of %d images reconstructed.",
                    *(number, 1 + len(attempts), _size(best[0])[0], len(names)),
                )
                if _size(best[0])[0] >= possible:
                    break
            return best

        models, dropped = reconstruct_from(database)
        registered, cameras = _size(models)[0], colmap.read_cameras(database)
        alike = camera_mode == pycolmap.CameraMode.AUTO and _are_alike(cameras)
        if alike and attempts and MORE * registered <= len(_matched(database)):
            logger.info("Trying again with one camera for all images.")
            shared = write_database(pycolmap.CameraMode.SINGLE)
            one, one_dropped = reconstruct_from(shared)
            if one and _size(one)[0] >= MORE * registered:
                models, dropped, database, alike = one, one_dropped, shared, False
        if not models:
            raise NoModelError(nothing(image_dir, dropped))
        models[0].write(building)
        parts = _parts(models)
        missing = sorted(set(names) - set(parts[0]))
        state = {
            "images": len(names),
            "parts": parts,
            "missing": missing,
            "unmatched": sorted(set(names) - _matched(database)),
            "implausible": {name: lens for name, lens in dropped.items() if name in missing},
            "alike": alike,
        }
        stamps.write(building / REGISTRATION, state)
        database.rename(building / "database.db")
        for other in building.glob("database-*"):
            other.unlink()
    sfm = colmap.read_model(sfm_dir)
    logger.info("The map %s:\n%s", sfm_dir, sfm.summary())
    return sfm


def _attempts(number: int) -> Iterator[dict]:
    """Yield the options of further attempts at a number of images."""
    yield {"mapper": RELAXED}
    if number <= VERY_FEW:
        for seed in SEEDS:
            yield {"random_seed": seed}
            yield {"random_seed": seed, "mapper": RELAXED}


def _matched(database: Path) -> set[str]:
    """Return the images of a database that have verified matches with another."""
    return {name for pair in colmap.count_verified(database) for name in pair}


def _are_alike(cameras: dict[int, pycolmap.Camera]) -> bool:
    """Tell whether one camera may have taken all images, though each was given its own."""
    alike = {(camera.width, camera.height, *camera.params) for camera in cameras.values()}
    return len(cameras) > len(alike) == 1


def _plausible(
    models: list[pycolmap.Reconstruction], cameras: dict[int, pycolmap.Camera]
) -> tuple[list[pycolmap.Reconstruction], dict[str, str]]:
    """Drop images of implausible lenses from models, and what only these connect.

    Args:
        models: of COLMAP's mapper.
        cameras: from their ids to those that the mapper began with.

    Returns:
        The models that have points, by size; and from the names of images to what is implausible.
    """
    dropped = {}
    for model in models:
        images = [model.images[i] for i in model.reg_image_ids()]
        shared = Counter(image.camera_id for image in images)
        implausible = {}
        for image in images:
            given = cameras[image.camera_id]
            # many images tell the focal length of their camera better than EXIF data do
            unknown = not given.has_prior_focal_length or shared[image.camera_id] >= MANY
            low, high = focal_lengths(given, unknown)
            focal_length = image.camera.mean_focal_length()
            distortion = image.camera.params[list(image.camera.extra_params_idxs())]
            if not low <= focal_length <= high:
                implausible[image.name] = f"focal length {focal_length:.0f}"
            elif np.abs(distortion).max(initial=0) > MAX_DISTORTION:
                implausible[image.name] = (
                    f"distortion {distortion[np.abs(distortion).argmax()]:.1f}"
                )
            else:
                continue
            model.deregister_frame(image.frame_id)
        if implausible:
            _keep_connected(model)
        dropped |= implausible
    whole = []
    for model in models:
        if min(size(model)) < 2:
            continue
        if (number := count_viewpoints(model)) >= VIEWPOINTS:
            whole.append(model)
            continue
        logger.info(
            "A model of %d photos is not used: %d viewpoints do not fix their focal lengths.",
            *(model.num_reg_images(), number),
        )
    return sorted(whole, key=size, reverse=True), dropped


def count_viewpoints(model: pycolmap.Reconstruction) -> int:
    """Count the viewpoints of a model: a burst of photos from one place is one viewpoint."""
    centres, depths = [], []
    points = {number: point.xyz for number, point in model.points3D.items()}
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        centre = image.cam_from_world().inverse().translation
        seen = [points[p.point3D_id] for p in image.points2D if p.has_point3D()]
        if seen:
            centres.append(centre)
            depths.append(np.median(np.linalg.norm(np.array(seen) - centre, axis=1)))
    number = 0
    centres, depths = np.array(centres).reshape(-1, 3), np.array(depths)
    while len(centres):
        apart = np.linalg.norm(centres - centres[0], axis=1) > SAME_VIEWPOINT * np.minimum(
            depths, depths[0]
        )
        apart[0] = False
        centres, depths, number = centres[apart], depths[apart], number + 1
    return number


def _keep_connected(model: pycolmap.Reconstruction) -> None:
    """Drop all images but those of the largest part that is connected by common points."""
    ids = sorted(model.reg_image_ids())
    row = {image_id: number for number, image_id in enumerate(ids)}
    seen = [
        (row[element.image_id], number)
        for number, point in enumerate(model.points3D.values())
        for element in point.track.elements
    ]
    if not seen:
        return
    image, point = np.array(seen).T
    sees = coo_array((np.ones(len(image)), (image, point)), shape=(len(ids), point.max() + 1))
    sees = sees.tocsr()
    _, label = connected_components(sees @ sees.T, directed=False)
    largest = np.bincount(label).argmax()
    for image_id, part in zip(ids, label, strict=True):
        if part != largest:
            model.deregister_frame(model.images[image_id].frame_id)


def nothing(image_dir: Path, dropped: dict[str, str] | None = None) -> str:
    """Say that no image could be reconstructed, and what to try."""
    if dropped:
        return f"COLMAP could not reconstruct the images of {image_dir}. {_said(dropped)}"
    return (
        f"COLMAP could not reconstruct the images of {image_dir} from {VIEWPOINTS} viewpoints or "
        "more. Do enough of them overlap? Take photos from several places, each overlapping the "
        "one before by about two thirds."
    )


def _said(dropped: dict[str, str]) -> str:
    """Say which images have implausible lenses."""
    lenses = [f"{name} ({lens})" for name, lens in dropped.items()]
    return (
        "These have focal lengths in pixels or distortions that no lens has, or focal lengths far "
        f"from their EXIF data, so their poses are wrong: {cli.some(lenses, NAMED)}."
    )


def size(model: pycolmap.Reconstruction) -> tuple[int, int]:
    """Return how many images and points a model has; the larger of two models is the better."""
    return model.num_reg_images(), model.num_points3D()


def _size(models: list[pycolmap.Reconstruction]) -> tuple[int, int]:
    """Return the size of the first of some models."""
    return size(models[0]) if models else (0, 0)


def _parts(models: list[pycolmap.Reconstruction]) -> list[list[str]]:
    """Return the images of each model that no larger one has; COLMAP's models may overlap."""
    parts, seen = [], set()
    for model in models:
        if new := sorted({model.images[i].name for i in model.reg_image_ids()} - seen):
            parts.append(new)
            seen.update(new)
    return parts


def check(sfm_dir: Path, accept_partial: bool) -> None:
    """Report which images are missing in a model.

    Raises:
        InputError: if it has fewer than half of them, unless `accept_partial`.
    """
    state = stamps.read(sfm_dir / REGISTRATION)
    missing, number = state["missing"], state["images"]
    registered = number - len(missing)
    if registered >= ENOUGH * number and len(state["parts"]) == 1:
        if state["alike"]:
            logger.info(
                "EXIF data do not say which images share a camera, so each has its own. If one "
                "camera with a fixed zoom took all, --camera_mode single gives better poses."
            )
        if missing:
            implausible = state["implausible"]
            logger.warning(
                "%d of %d images are not in the map: %s.%s",
                *(len(missing), number, cli.some(missing, NAMED)),
                f" {_said(implausible)}" if implausible else "",
            )
        return
    message = shortfall(sfm_dir / REGISTRATION, **state)
    if registered < LEAST * number and not accept_partial:
        raise InputError(f"{message} To use the map as it is, run again with --accept_partial.")
    logger.warning(message)


def shortfall(
    path: Path,
    images: int,
    parts: list[list[str]],
    missing: list[str],
    unmatched: list[str],
    implausible: dict[str, str],
    alike: bool,
) -> str:
    """Say which images are not in a model, why, and what to try.

    Args:
        path: file with all names.
        images: number of images.
        parts: the images of each part that COLMAP reconstructed, the model first.
        missing: the images that are not in the model.
        unmatched: those that match no other image.
        implausible: from images that were dropped to what is implausible of their lenses.
        alike: each image has a camera of its own, but one may have taken all.
    """
    registered = images - len(missing)
    only = "Only " if registered < ENOUGH * images else ""
    said = [
        f"{only}{registered} of {images} photos are in the map.",
        f"Missing: {cli.some(missing, NAMED)}{f' (all in {path})' * bool(missing[NAMED:])}.",
    ]
    tries = []
    if len(parts) > 1:
        sizes = [str(len(part)) for part in parts]
        said.append(
            f"COLMAP found {len(parts)} parts that do not connect, of {', '.join(sizes[:-1])} and "
            f"{sizes[-1]} photos, and the map is the first"
            + (f"; the second has {cli.some(parts[1], 3)}." if parts[1] != missing else ".")
        )
        tries.append("add photos between the parts, each overlapping the one before by two thirds")
    elif set(missing) - set(unmatched) - set(implausible):
        tries.append("add photos between those in the map and those that are not")
    if unmatched:
        said.append(f"No other photo matches {cli.some(unmatched)}.")
        tries.append("leave out photos of other places, and retake blurred or dark ones")
    if implausible:
        said.append(_said(implausible))
    if alike:
        tries.append("--camera_mode single, if one camera with a fixed zoom took all photos")
    return f"{' '.join(said)} What to try: {'; '.join(tries)}."


def add_camera_mode(parser: argparse.ArgumentParser) -> None:
    """Add --camera_mode."""
    modes = ", ".join(mode.lower() for mode in pycolmap.CameraMode.__members__)
    parser.add_argument(
        "--camera_mode",
        default="auto",
        help=f"which photos share a camera, as in COLMAP: {modes}; auto, COLMAP's default: those "
        "of the same make, model, focal length and size by EXIF data",
    )


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
    add_camera_mode(parser)
    parser.add_argument(
        "--accept_partial",
        action="store_true",
        help="accept a map that has fewer than half of the photos",
    )
    parser.add_argument(
        "--skip_geometric_verification", action="store_true", help="take all matches"
    )
    parser.add_argument("--min_match_score", type=float, help="take matches of a higher score only")
    parser.add_argument("--image_list", type=Path, help="text file of names, one a line")
    parser.add_argument("--verbose", action="store_true", help="show COLMAP's log")
    parser.add_argument("--overwrite", action="store_true", help="reconstruct anew")
    args = parser.parse_args()
    main(**{**vars(args), "camera_mode": colmap.camera_mode(args.camera_mode)})


if __name__ == "__main__":
    cli.run(_main)
