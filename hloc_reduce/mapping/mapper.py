"""COLMAP's incremental mapper, with several attempts."""

import copy
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap

from .. import logger
from ..runtime import parallel
from ..utils import cli, colmap
from ..utils.interrupts import interruptible
from . import database as databases
from .adjustment import adjust, adjusted_error, scale_by_rigs, with_one_camera
from .checks import Inputs, copies, lenses
from .checks.focal_lengths import FEW_IMAGES, SPREAD, SPREAD_OF_FEW, are_alike, of_spread
from .checks.partial import ENOUGH_REGISTERED
from .epipolar import MIN_VERIFIED_MATCHES
from .findings import names_in, without
from .plausibility import Models, focal_length_spread, keep_plausible, size
from .registration import MIN_VIEWPOINTS, NoModelError, Registration, nothing

# half of COLMAP's thresholds, for missing images; a quarter of them gave wrong poses
RELAXED = {
    "init_min_num_inliers": 50,
    "init_min_tri_angle": 8.0,
    "abs_pose_min_num_inliers": 15,
}
# Registering an image without points may take 14 s a try with the matches of networks, and hardly
# adds any that the first attempt does not have; so later attempts do without.
FALLBACK = "structure_less_registration_fallback"
VERY_FEW = 30  # images: several more attempts take little time, and the outcome depends on luck
# Of more images, adjusting all poses takes most of the time. If one camera took them, so that its
# focal length is certain, this is done when a fifth of the images or points are new, instead of
# COLMAP's tenth, and by fewer points, and in the end once by all. Photos of cameras of their own
# may end far from their places (`benchmarks.mappers`, liberty-statue).
RARE_ADJUSTMENTS: dict = {
    "ba_global_frames_ratio": 1.2,
    "ba_global_points_ratio": 1.2,
    "mapper": {"ba_global_ignore_redundant_points3D": True},
}
SEEDS = (1, 2, 3)
MAPPER_PATIENCE = (
    300.0  # seconds of further attempts, after which none begins: most maps take far less
)
MORE_IMAGES = 1.5  # times as many images show that one camera took all
# Images that one camera took fit up to 10 % better with cameras of their own, in nine of twelve
# models whose focal lengths differ by more than SPREAD_OF_FEW. Where one of them was enlarged by
# 8 %, they fit at least 11 % better, in most models over 30 %.
MAX_MISFIT = 0.1
ALMOST_AS_MANY = 0.9  # times as many points with one camera as with several
# Focal length in longer sides from which photos hardly tell a distortion: it may make up for wrong
# poses by a coefficient that no lens has. Without one, true distortions move points little.
NARROW_FOCAL_LENGTH = 2.5
UNDISTORTED = {"ba_refine_extra_params": False}
# what the provenance of a model says of how it was chosen
MODEL_CHOICE = {
    "inferred": databases.INFERRED_CAMERAS,
    "cameras": f"plausible, distortion {lenses.MAX_DISTORTION}, one for {MORE_IMAGES} times as "
    "many images",
    "points": f"{MORE_IMAGES} times as many where focal lengths differ",
    "doubtful": f"from {SPREAD_OF_FEW}, misfit {MAX_MISFIT}, {ALMOST_AS_MANY} times as many points",
    "lenses": "others without the implausible ones, by the best attempt",
    "narrow": f"no distortion from {NARROW_FOCAL_LENGTH} longer sides if it is implausible",
    "spread": SPREAD,
    "viewpoints": MIN_VIEWPOINTS,
    "misplaced": f"0.5 of {MIN_VERIFIED_MATCHES} matches or more, 8 points",
    "copies": f"sharing less than {copies.JOINED_SHARE} of the points expected in "
    f"{copies.MIN_TELLING_POINTS}, any less than {copies.APART_SHARE}",
    "dropped": "findings",
    "adjustments": f"{RARE_ADJUSTMENTS} of one camera and more than {VERY_FEW} images",
}


def attempts_for(number: int) -> list[dict]:
    """Return the changed mapper options of each attempt to reconstruct a number of images."""
    known = hasattr(pycolmap.IncrementalPipelineOptions(), FALLBACK)  # since COLMAP 4
    later: dict = {FALLBACK: False} if known else {}
    attempts: list[dict] = [{}, {"mapper": RELAXED} | later]
    for seed in SEEDS if number <= VERY_FEW else ():
        seeded = {"random_seed": seed} | later
        attempts += [seeded, seeded | {"mapper": RELAXED}]
    return attempts


def with_rare_adjustments(changed: dict) -> dict:
    """Return changed mapper options with `RARE_ADJUSTMENTS`, as far as they do not change these."""
    both = {**RARE_ADJUSTMENTS, **changed}
    if isinstance(given := changed.get("mapper", {}), dict):
        both["mapper"] = {**RARE_ADJUSTMENTS["mapper"], **given}
    return both


@dataclass
class Mapper:
    """COLMAP's incremental mapper, with several attempts."""

    folder: Path  # of the new model
    image_dir: Path
    names: list[str]
    image_options: dict  # of pycolmap's ImageReaderOptions
    keypoints: dict[str, np.ndarray]  # from image to (N, 2), COLMAP's pixels
    matches: dict[tuple[str, str], np.ndarray]  # from pair to (M, 2)
    verify: bool  # by two-view geometry
    known: Path  # database whose pairs are not verified again, if it is there
    attempts: list[dict]  # of pycolmap's IncrementalPipelineOptions
    once: bool  # make the first attempt only, unless images fit with one camera
    verbose: bool
    rigs: Path | None = None  # COLMAP's rig_config.json, whose poses and intrinsics are exact
    seconds: float = field(default=0.0, init=False)  # spent on further attempts
    left_out: int = field(default=0, init=False)  # attempts that were not made for lack of time

    def reconstruct(self, camera_mode: pycolmap.CameraMode) -> None:
        """Write the best model, its database and its registration."""
        database = self.write_database(camera_mode)
        models, dropped = self.run(database, self.once)
        is_auto = camera_mode == pycolmap.CameraMode.AUTO and self.rigs is None
        alike = is_auto and are_alike(colmap.read_cameras(database).values())
        if alike and (shared := self._with_one_camera(models, database)):
            (models, dropped), database = shared
            alike = False
        if not models:
            raise NoModelError(nothing(self.image_dir, dropped, self.left_out))
        models[0].write(self.folder)
        parts = _parts(models)
        missing = sorted(set(self.names) - set(parts[0]))
        registration = Registration(
            images=len(self.names),
            parts=parts,
            missing=missing,
            unmatched=sorted(set(self.names) - _matched(database)),
            dropped=without(dropped, parts[0]),
            alike=alike,
            spread=round(focal_length_spread(models), 2),
            attempts_left_out=self.left_out,
        )
        registration.write(self.folder)
        if alike and not of_spread(registration.spread, registration.images):
            logger.info(
                "EXIF data do not say which images share a camera, so each has its own. If one "
                "camera with a fixed zoom took all, --camera_mode single --overwrite gives better "
                "poses."
            )
        database.rename(self.folder / "database.db")
        for other in self.folder.glob("database-*"):
            other.unlink()

    def _with_one_camera(
        self, models: list[pycolmap.Reconstruction], database: Path
    ) -> tuple[Models, Path] | None:
        """Return models with one camera for all images, and their database, if they are better."""
        registered, points = _size(models)
        # a photo may have been dropped for its own focal length
        spread = focal_length_spread(models, with_dropped=True)
        several = len(self.attempts) > 1 and not self.once
        few = several and MORE_IMAGES * registered <= len(_matched(database))
        fits = SPREAD_OF_FEW < spread <= SPREAD and _fits_one_camera(models[0])
        if not (few or fits or spread > SPREAD):
            return None
        logger.info("Trying again with one camera for all images.")
        shared = self.write_database(pycolmap.CameraMode.SINGLE)
        found = self.run(shared, self.once and not fits)
        images, more = _size(found[0])
        enough = (
            more >= MORE_IMAGES * points
            if spread > SPREAD
            else fits and more >= ALMOST_AS_MANY * points
        )
        if found[0] and (images >= MORE_IMAGES * registered or (images >= registered and enough)):
            return found, shared
        return None

    def write_database(self, mode: pycolmap.CameraMode) -> Path:
        """Write a database of the images and their verified matches."""
        path = self.folder / f"database-{mode.name}.db"
        databases.write(
            path,
            self.image_dir,
            self.keypoints,
            self.matches,
            mode,
            verify=self.verify,
            known=self.known,
            image_options=self.image_options,
            verbose=self.verbose,
            rigs=self.rigs,
        )
        return path

    def run(self, database: Path, once: bool) -> Models:
        """Return the plausible models of the best attempt; stop when enough images are in one."""
        if _largest_group(database) < MIN_VIEWPOINTS:
            logger.info("No %d images have verified matches that connect them.", MIN_VIEWPOINTS)
            return [], []
        took = colmap.read_cameras(database)
        known = partial(
            Inputs,
            cameras=took,
            verified=colmap.read_verified(database),
            matched=self.matches.keys(),
        )
        exact = {"ba_refine_sensor_from_rig": False} if self.rigs else {}
        fixed = databases.fixed_cameras(database, self.rigs)
        number = len(self.names)
        are_rare = number > VERY_FEW and len(took) == 1
        enough = number if number <= FEW_IMAGES else ENOUGH_REGISTERED * number
        enough = min(enough, len(_matched(database)))  # no attempt registers an unmatched image

        def attempted(changed: dict, alone: bool = True) -> Models:
            adjusted = with_rare_adjustments(changed) if are_rare else changed
            options = colmap.mapper_options(adjusted | exact)
            options.constant_cameras = fixed
            with TemporaryDirectory(dir=self.folder) as folder:
                # the mapper opens it for writing
                own = database if alone else Path(shutil.copy(database, folder))
                found = colmap.incremental_mapping(
                    own, self.image_dir, Path(folder) / "models", options, self.verbose
                )
            for model in found if are_rare else ():
                adjust(model, options)
            for model in found if self.rigs else ():
                scale_by_rigs(model, fixed.intersection(model.cameras))
            cameras = [camera for model in found for camera in _cameras(model)]
            is_narrow = any(_is_narrow(camera) for camera in cameras)
            is_distorted = any(lenses.is_distorted(camera) for camera in cameras)
            models, dropped = keep_plausible([known(model) for model in found])
            if not (is_narrow and is_distorted) or UNDISTORTED.items() <= changed.items():
                return models, dropped
            logger.info("Trying again without distortion.")
            others = attempted({**changed, **UNDISTORTED}, alone)
            return max((models, dropped), others, key=lambda found: _size(found[0]))

        attempts = self.attempts[:1] if once else self.attempts
        tried: list[tuple[Models, dict]] = []
        for found, changed in zip(self._in_turn(attempted, attempts), attempts, strict=False):
            tried.append((found, changed))
            best, options = max(tried, key=lambda both: _size(both[0][0]))
            registered = _size(best[0])[0]
            logger.info(
                "Attempt %d of up to %d: %d of %d images reconstructed.",
                len(tried),
                len(attempts),
                registered,
                number,
            )
            if registered >= enough:
                break
        models, dropped = best
        implausible = names_in(dropped, "lenses")
        if models and implausible:
            # a photo with an implausible lens has bent the model of the others
            logger.info("Trying again without %s.", cli.some(sorted(implausible)))
            names = [name for name in self.names if name not in implausible]
            others, more = attempted({**options, "image_names": names})
            if _size(others)[0] >= _size(models)[0]:
                return others, dropped + more
        return best

    def _in_turn(self, attempted: Callable[..., Models], attempts: list[dict]) -> Iterator[Models]:
        """Yield the models of attempts in turn, while there is time for further ones.

        After the first, as many are made at once as there are cores.
        """
        cores, number = parallel.cores(), len(attempts)
        for first in (0, *range(1, number, cores)):
            if first and self.seconds > MAPPER_PATIENCE:
                self.left_out += number - first
                logger.warning(
                    "%d of %d attempts are left out, as further ones took %.0f s.",
                    number - first,
                    number,
                    self.seconds,
                )
                return
            batch = attempts[first : first + cores] if first else attempts[:1]
            last = first + len(batch)
            which = f"attempt {last}" if len(batch) == 1 else f"attempts {first + 1} to {last}"
            logger.info("COLMAP's mapper makes %s of up to %d...", which, number)
            start = time.monotonic()
            attempt = partial(attempted, alone=len(batch) == 1)
            yield from interruptible(list, parallel.ordered("attempt", attempt, batch))
            self.seconds += time.monotonic() - start if first else 0


def _cameras(model: pycolmap.Reconstruction) -> list[pycolmap.Camera]:
    """Return the camera of each image of a model."""
    return [model.cameras[model.images[i].camera_id] for i in model.reg_image_ids()]


def _is_narrow(camera: pycolmap.Camera) -> bool:
    """Tell whether a camera has a narrow view."""
    return camera.mean_focal_length() > NARROW_FOCAL_LENGTH * max(camera.width, camera.height)


def _matched(database: Path) -> set[str]:
    """Return the images of a database that have verified matches with another."""
    return {name for pair in colmap.count_verified(database) for name in pair}


def _largest_group(database: Path) -> int:
    """Return the size of the largest set of images that verified matches connect, 0 without any."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pairs = np.array([*colmap.count_verified(database)]).reshape(-1, 2)
    if not len(pairs):
        return 0
    names, ends = np.unique(pairs, return_inverse=True)
    rows, columns = ends.reshape(-1, 2).T
    graph = coo_array((np.ones(len(pairs)), (rows, columns)), (len(names),) * 2)
    _, group = connected_components(graph, directed=False)
    return int(np.bincount(group).max())


def _fits_one_camera(model: pycolmap.Reconstruction) -> bool:
    """Tell whether the images of a model fit nearly as well with one camera as with their own."""
    if model.num_reg_images() > FEW_IMAGES:
        return False
    own = adjusted_error(copy.deepcopy(model))
    return own >= (1 - MAX_MISFIT) * adjusted_error(with_one_camera(model))


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
