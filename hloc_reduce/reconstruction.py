"""Reconstruct a map from matches of images without known poses or intrinsics."""

import shutil
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from . import logger
from .localization.confidence import focal_lengths
from .runtime import provenance
from .triangulation import STAMP, add_options, read_matches, replacing_map
from .utils import cli, colmap
from .utils.cli import InputError
from .utils.h5 import list_h5_names
from .utils.images import list_images
from .utils.overlays import drop_overlays
from .utils.paths import strings_as_paths

REGISTRATION = "registration.json"  # which images are in the model, and in other parts
# shares of registered images: a model with fewer is reported in detail, or refused
ENOUGH, LEAST = 0.8, 0.5
NAMED = 10  # images that a message names
# COLMAP would drop parts of fewer than 10 images
MAPPER_OPTIONS = {"random_seed": 0, "num_threads": 1, "min_model_size": 3}
# half of COLMAP's thresholds, for missing images; a quarter of them gave wrong poses
RELAXED = {
    "init_min_num_inliers": 50,
    "init_min_tri_angle": 8.0,
    "abs_pose_min_num_inliers": 15,
}
FEW = 100  # images: further attempts take little time, even for one missing image
VERY_FEW = 30  # images: several more attempts take little time, and the outcome depends on luck
SEEDS = (1, 2, 3)
MORE = 1.5  # times as many images show that one camera took all
SPREAD = 1.2  # ratio of focal lengths above which 1.5 times as many points show it, too
MAX_DISTORTION = 1.0  # COLMAP's limit for images that it registers
MANY = 3  # images of one camera estimate its focal length better than EXIF data do
SAME_VIEWPOINT = 0.03  # of the distance to the scene, between images of one viewpoint
VIEWPOINTS = 3  # at least, of a model: two do not determine the focal lengths


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
    once: bool = False,
    checked: bool = True,
) -> pycolmap.Reconstruction:
    """Reconstruct poses, intrinsics and points with COLMAP's incremental mapper.

    Takes the arguments of hloc's `reconstruction.main`. The frame and the scale of the model are
    arbitrary. Images with an implausible focal length or distortion, or a focal length far from
    their EXIF data, are dropped from the model.
    If images are missing (of more than 100 images, more than a fifth), further attempts follow, and
    the model with the most images is kept: an attempt with lower thresholds and, for up to 30
    images, some with other initial pairs. With `camera_mode` AUTO, if at most two thirds of the
    images are in the model, or focal lengths differ by more than a factor of 1.2, and one camera
    may have taken all of them, the mapper runs with one shared camera. Its model is kept if it has
    at least 1.5 times as many images, or 1.5 times as many points where focal lengths differ.

    Args:
        sfm_dir: folder of the new COLMAP model; a model made from the same inputs is read instead.
        image_dir: folder of the images, whose EXIF data give the initial intrinsics.
        pairs: text file of pairs.
        features: feature file.
        matches: match file.
        camera_mode: which images share a camera.
        verbose: show COLMAP's log.
        skip_geometric_verification: use all matches, without two-view geometry.
        min_match_score: use only matches with a higher score.
        image_list: the images, names or a text file of them; default: those of `features`.
        image_options: of pycolmap's ImageReaderOptions.
        mapper_options: of pycolmap's IncrementalPipelineOptions; if given, there is one attempt.
        overwrite: reconstruct again.
        accept_partial: also return a model of fewer than half of the images.
        once: make one attempt only.
        checked: call `check` on the model.

    Returns:
        The model with the most images. It has the keypoints of the feature file, in the same order.

    Raises:
        InputError: when an input is missing, or fewer than half of the images are in the model,
            which is kept for a run with `accept_partial`.
        NoModelError: when nothing can be reconstructed.
    """
    options = {**MAPPER_OPTIONS, **(mapper_options or {})}
    colmap.mapper_options(options)  # raises for a wrong one
    for path in (pairs, features, matches):
        if not path.is_file():
            raise InputError(f"There is no file {path}.")
    names = list_images(image_dir, list_h5_names(features) if image_list is None else image_list)
    attempts = [{}] if once or mapper_options else _attempts(len(names))
    chosen = {
        "camera_mode": camera_mode.name,
        "image_options": image_options or {},
        "images": names,
        "skip_geometric_verification": skip_geometric_verification,
        "min_match_score": min_match_score,
        "overlays": "dropped",
        "attempts": attempts,
        "cameras": f"plausible, distortion {MAX_DISTORTION}, one for {MORE} times as many images",
        "points": f"{MORE} times as many where focal lengths differ",
        "spread": SPREAD,
        "viewpoints": VIEWPOINTS,
        "once": once,
    }
    made_from = provenance.of_inputs({**options, **chosen}, [pairs, features, matches])
    is_whole = bool(provenance.read(sfm_dir / REGISTRATION))
    if not overwrite and is_whole and provenance.is_current(sfm_dir / STAMP, made_from):
        logger.info("The map %s is up to date.", sfm_dir)
        sfm = colmap.read_model(sfm_dir)
    else:
        with replacing_map(sfm_dir, made_from) as building:
            keypoints, _, found = read_matches(names, pairs, features, matches, min_match_score)
            found = drop_overlays(keypoints, found)
            _Mapper(
                *(building, image_dir, names, image_options or {}, keypoints, found),
                unverified=None if skip_geometric_verification else pairs,
                attempts=[{**options, **changed} for changed in attempts],
                verbose=verbose,
            ).reconstruct(camera_mode)
        sfm = colmap.read_model(sfm_dir)
        logger.info("The map %s:\n%s", sfm_dir, sfm.summary())
    if checked:
        check(sfm_dir, accept_partial)
    return sfm


def _attempts(number: int) -> list[dict]:
    """Return the changed mapper options of each attempt to reconstruct a number of images."""
    attempts: list[dict] = [{}, {"mapper": RELAXED}]
    for seed in SEEDS if number <= VERY_FEW else ():
        attempts += [{"random_seed": seed}, {"random_seed": seed, "mapper": RELAXED}]
    return attempts


Models = tuple[list[pycolmap.Reconstruction], dict[str, str]]  # see `_plausible`


@dataclass
class _Mapper:
    """COLMAP's incremental mapper, with several attempts."""

    folder: Path  # of the new model
    image_dir: Path
    names: list[str]
    image_options: dict  # of pycolmap's ImageReaderOptions
    keypoints: dict[str, np.ndarray]  # from image to (N, 2), COLMAP's pixels
    matches: dict[tuple[str, str], np.ndarray]  # from pair to (M, 2)
    unverified: Path | None  # text file of pairs to verify by two-view geometry
    attempts: list[dict]  # of pycolmap's IncrementalPipelineOptions
    verbose: bool

    def reconstruct(self, camera_mode: pycolmap.CameraMode) -> None:
        """Write the best model, its database and its registration."""
        database = self.write_database(camera_mode)
        models, dropped = self.run(database)
        registered, points = _size(models)
        alike = camera_mode == pycolmap.CameraMode.AUTO and _are_alike(database)
        several = len(self.attempts) > 1
        few = several and MORE * registered <= len(_matched(database))
        spread = _spread(models)
        if alike and (few or spread > SPREAD):
            logger.info("Trying again with one camera for all images.")
            shared = self.write_database(pycolmap.CameraMode.SINGLE)
            found, implausible = self.run(shared)
            images, more = _size(found)
            fits = spread > SPREAD and images >= registered and more >= MORE * points
            if found and (images >= MORE * registered or fits):
                models, dropped, database, alike = found, implausible, shared, False
        if not models:
            raise NoModelError(nothing(self.image_dir, dropped))
        models[0].write(self.folder)
        parts = _parts(models)
        missing = sorted(set(self.names) - set(parts[0]))
        state = {
            "images": len(self.names),
            "parts": parts,
            "missing": missing,
            "unmatched": sorted(set(self.names) - _matched(database)),
            "implausible": {name: lens for name, lens in dropped.items() if name in missing},
            "alike": alike,
            "spread": round(_spread(models), 2),
        }
        provenance.write(self.folder / REGISTRATION, state)
        database.rename(self.folder / "database.db")
        for other in self.folder.glob("database-*"):
            other.unlink()

    def write_database(self, mode: pycolmap.CameraMode) -> Path:
        """Write a database of the images and their verified matches."""
        database = self.folder / f"database-{mode.name}.db"
        colmap.import_images(database, self.image_dir, self.names, mode, self.image_options)
        verified = {
            pair: (indices, None if self.unverified else indices)
            for pair, indices in self.matches.items()
        }
        colmap.write_matches(database, self.keypoints, verified)
        if self.unverified:
            colmap.verify_matches(database, self.unverified, self.verbose)
        return database

    def run(self, database: Path) -> Models:
        """Return the plausible models of the best attempt; stop when enough images are in one."""
        cameras, folder = colmap.read_cameras(database), self.folder / "models"
        number = len(self.names)
        enough = number if number <= FEW else ENOUGH * number
        enough = min(enough, len(_matched(database)))  # no attempt registers an unmatched image
        best: Models = [], {}
        for attempt, changed in enumerate(self.attempts, start=1):
            options = colmap.mapper_options(changed)
            found = colmap.incremental_mapping(
                database, self.image_dir, folder, options, self.verbose
            )
            shutil.rmtree(folder, ignore_errors=True)
            best = max(best, _plausible(found, cameras), key=lambda both: _size(both[0]))
            registered = _size(best[0])[0]
            logger.info(
                "Attempt %d of up to %d: %d of %d images reconstructed.",
                *(attempt, len(self.attempts), registered, number),
            )
            if registered >= enough:
                break
        return best


def _matched(database: Path) -> set[str]:
    """Return the images of a database that have verified matches with another."""
    return {name for pair in colmap.count_verified(database) for name in pair}


def _are_alike(database: Path) -> bool:
    """Tell whether one camera may have taken all images, although each has its own."""
    cameras = colmap.read_cameras(database).values()
    return len(cameras) > len({(c.width, c.height, *c.params) for c in cameras}) == 1


def _spread(models: list[pycolmap.Reconstruction]) -> float:
    """Return the ratio of the largest and the smallest focal length in the largest model, or 1."""
    cameras = {image.camera_id for image in models[0].images.values()} if models else ()
    focal_lengths = [models[0].cameras[i].mean_focal_length() for i in cameras]
    return max(focal_lengths) / min(focal_lengths) if focal_lengths else 1.0


def _plausible(
    models: list[pycolmap.Reconstruction], cameras: dict[int, pycolmap.Camera]
) -> Models:
    """Drop images with implausible lenses from models, and images that only these connect.

    Args:
        models: of COLMAP's mapper.
        cameras: from id to the initial camera.

    Returns:
        The models that have points, the largest first; and from the name of each dropped image to
        what is implausible.
    """
    dropped: dict[str, str] = {}
    for model in models:
        images = [model.images[i] for i in model.reg_image_ids()]
        shared = Counter(image.camera_id for image in images)
        implausible = {}
        for image in images:
            camera_id = image.camera_id
            lens = _implausible(model.cameras[camera_id], cameras[camera_id], shared[camera_id])
            if lens is not None:
                implausible[image.name] = lens
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
            "A model of %d photos is not used: %d viewpoints do not determine focal lengths.",
            *(model.num_reg_images(), number),
        )
    return sorted(whole, key=size, reverse=True), dropped


def _implausible(camera: pycolmap.Camera, initial: pycolmap.Camera, number: int) -> str | None:
    """Say what is implausible about the refined camera of a number of images, if anything."""
    low, high = focal_lengths(initial, not initial.has_prior_focal_length or number >= MANY)
    focal_length = camera.mean_focal_length()
    if not low <= focal_length <= high:
        return f"focal length {focal_length:.0f}"
    distortion = max(camera.params[list(camera.extra_params_idxs())], key=abs, default=0.0)
    return f"distortion {distortion:.1f}" if abs(distortion) > MAX_DISTORTION else None


def count_viewpoints(model: pycolmap.Reconstruction) -> int:
    """Count the viewpoints of a model: a burst of photos from one place is one viewpoint."""
    points = {number: point.xyz for number, point in model.points3D.items()}
    left: list[tuple[np.ndarray, float]] = []  # centres of images, and distances of their points
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        centre = image.projection_center()
        seen = [points[p.point3D_id] for p in image.points2D if p.has_point3D()]
        if seen:
            left.append((centre, float(np.median(np.linalg.norm(np.array(seen) - centre, axis=1)))))
    number = 0
    while left:
        number, (first, distance) = number + 1, left[0]
        left = [
            (centre, other)
            for centre, other in left[1:]
            if np.linalg.norm(centre - first) > SAME_VIEWPOINT * min(distance, other)
        ]
    return number


def _keep_connected(model: pycolmap.Reconstruction) -> None:
    """Keep only the largest set of images that common points connect."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

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
    sees = coo_array((np.ones(len(image)), (image, point)), (len(ids), point.max() + 1)).tocsr()
    _, label = connected_components(sees @ sees.T, directed=False)
    largest = np.bincount(label).argmax()
    for image_id, part in zip(ids, label, strict=True):
        if part != largest:
            model.deregister_frame(model.images[image_id].frame_id)


def nothing(image_dir: Path, dropped: dict[str, str] | None = None) -> str:
    """Say that no image could be reconstructed, and what to try."""
    advice = (
        "Do enough of them overlap? Take photos from several places, each overlapping the one "
        "before by about two thirds."
    )
    hint = _lenses(dropped) if dropped else advice
    return (
        f"COLMAP could not reconstruct the images of {image_dir} from {VIEWPOINTS} viewpoints or "
        f"more. {hint}"
    )


def _lenses(dropped: dict[str, str]) -> str:
    """Say which images have implausible lenses."""
    lenses = [f"{name} ({lens})" for name, lens in dropped.items()]
    return (
        "These have focal lengths in pixels or distortions that no lens has, or focal lengths far "
        f"from their EXIF data, so their poses are wrong: {cli.some(lenses, NAMED)}."
    )


def size(model: pycolmap.Reconstruction) -> tuple[int, int]:
    """Return the numbers of images and points of a model, by which models are compared."""
    return model.num_reg_images(), model.num_points3D()


def _size(models: list[pycolmap.Reconstruction]) -> tuple[int, int]:
    """Return the size of the first model."""
    return size(models[0]) if models else (0, 0)


def _parts(models: list[pycolmap.Reconstruction]) -> list[list[str]]:
    """Return the images of each model that no larger one has: COLMAP's models may overlap."""
    parts: list[list[str]] = []
    for model in models:
        names = {model.images[i].name for i in model.reg_image_ids()}
        if new := sorted(names.difference(*parts)):
            parts.append(new)
    return parts


def check(sfm_dir: Path, accept_partial: bool) -> None:
    """Report which images are missing from a model.

    Raises:
        InputError: if it has fewer than half of the images, unless `accept_partial`.
    """
    state = provenance.read(sfm_dir / REGISTRATION)
    missing, number, spread = state["missing"], state["images"], state.pop("spread", 1.0)
    registered = number - len(missing)
    if registered >= ENOUGH * number and len(state["parts"]) == 1:
        if state["alike"] and spread > SPREAD:
            logger.warning(
                "The map may be wrong: its photos have the same size, but their estimated focal "
                "lengths differ by a factor of %.2f. If one camera with a fixed zoom took all, run "
                "again with --camera_mode single; otherwise add photos from more viewpoints.",
                spread,
            )
        elif state["alike"]:
            logger.info(
                "EXIF data do not say which images share a camera, so each has its own. If one "
                "camera with a fixed zoom took all, --camera_mode single gives better poses."
            )
        if missing:
            implausible = state["implausible"]
            logger.warning(
                "%d of %d images are not in the map: %s.%s",
                *(len(missing), number, cli.some(missing, NAMED)),
                f" {_lenses(implausible)}" if implausible else "",
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
        unmatched: the images without verified matches.
        implausible: from each dropped image to what is implausible about its lens.
        alike: each image has its own camera, but one camera may have taken all.
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
        tries.append(
            "add photos between those in the map and those that are not, and leave out photos of "
            "other places"
        )
    if unmatched:
        said.append(f"No other photo matches {cli.some(unmatched)}.")
        tries.append("leave out photos of other places, and retake blurred or dark ones")
    if implausible:
        said.append(_lenses(implausible))
    if alike:
        tries.append("--camera_mode single, if one camera with a fixed zoom took all photos")
    return f"{' '.join(said)} What to try: {'; '.join(tries)}."


def _main() -> None:
    parser = cli.Parser(
        __doc__,
        "--sfm_dir outputs/sfm --image_dir photos --pairs pairs.txt "
        "--features outputs/feats-dog-colmap_sift_sv64.h5 --matches outputs/matches.h5",
    )
    add_options(parser)
    colmap.add_camera_mode(parser)
    parser.add_argument(
        "--accept_partial",
        action="store_true",
        help="accept a map that has fewer than half of the photos",
    )
    parser.add_argument("--image_list", type=Path, help="text file of names, one per line")
    args = parser.parse_args()
    main(**{**vars(args), "camera_mode": colmap.camera_mode(args.camera_mode)})


if __name__ == "__main__":
    cli.run(_main)
