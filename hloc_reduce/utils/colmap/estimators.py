"""COLMAP's estimators: two-view geometries, points, models and the pose of a query."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import pycolmap

from ..interrupts import interruptible
from ..parsers import write_pairs
from .databases import Pair, full_disk, open_database, parse_options
from .origin import near_origin

REPROJECTION_LIMITS = (  # options that are the largest reprojection errors of points, in pixels
    ("mapper", "filter_max_reproj_error"),
    ("triangulation", "complete_max_reproj_error"),
    ("triangulation", "merge_max_reproj_error"),
)
MIN_OF_POSE = 4  # matches from which a pose is refined, or that of a rig estimated
_lock = Lock()
_levels: list[int] = []  # those of COLMAP's log before each running block of `_log`


def mapper_options(options: dict, pixel_scale: float = 1.0) -> pycolmap.IncrementalPipelineOptions:
    """Convert a dict to pycolmap's mapper options.

    Args:
        options: their values by name.
        pixel_scale: factor of COLMAP's largest reprojection errors of points; those in `options`
            are taken as they are.

    Raises:
        InputError: for an unknown option.
    """
    parsed = parse_options(pycolmap.IncrementalPipelineOptions, options, "mapper")
    for part, name in REPROJECTION_LIMITS:
        if part not in options or (isinstance(options[part], dict) and name not in options[part]):
            limits = getattr(parsed, part)
            setattr(limits, name, pixel_scale * getattr(limits, name))
    return parsed


def exact(options: pycolmap.BundleAdjustmentOptions) -> pycolmap.BundleAdjustmentOptions:
    """Let a bundle adjustment run until it converges, and return its changed options.

    By COLMAP's limits of the gradient, 1 and more, that of few points ends before it begins.
    """
    holder: Any = getattr(options, "ceres", options)  # versions keep Ceres's options elsewhere
    solver = holder.solver_options
    solver.gradient_tolerance, solver.function_tolerance = 1e-4, 1e-6
    return options


def verify_matches(database: Path, pairs: Iterable[Pair], verbose: bool = False) -> None:
    """Estimate the two-view geometries of pairs of images of a database, with hloc's options."""
    options = {"ransac": {"max_num_trials": 20000, "min_inlier_ratio": 0.1, "random_seed": 0}}
    listed = database.with_name(f"{database.stem}-pairs.txt")
    with _log(verbose), _without_spaces(database) as renamed:
        write_pairs(((renamed[a], renamed[b]) for a, b in pairs), listed)
        try:
            interruptible(pycolmap.verify_matches, database, listed, options=options)
        finally:
            listed.unlink()


@contextmanager
def _without_spaces(database: Path) -> Iterator[dict[str, str]]:
    """In a block, name the images of a database by their ids if any name contains spaces.

    COLMAP cannot read a list of pairs with spaces in names. Yields the names in the block.
    """
    with open_database(database) as opened:
        images = opened.read_all_images()
    names = {image.image_id: image.name for image in images}
    if all(name.split() == [name] for name in names.values()):
        yield {name: name for name in names.values()}
        return
    _rename(database, images, {image_id: str(image_id) for image_id in names})
    try:
        yield {name: str(image_id) for image_id, name in names.items()}
    finally:
        _rename(database, images, names)


def _rename(database: Path, images: list[pycolmap.Image], names: dict[int, str]) -> None:
    with open_database(database) as opened:
        for image in images:
            image.name = names[image.image_id]
            opened.update_image(image)


def triangulate_points(
    reference: pycolmap.Reconstruction,
    database: Path,
    image_dir: Path,
    output: Path,
    options: pycolmap.IncrementalPipelineOptions,
    verbose: bool,
) -> pycolmap.Reconstruction:
    """Triangulate the verified matches of a database with the poses of a model.

    The points are added to the model, which is written to `output` and returned. Without any match
    the model is empty; COLMAP 3.13 would raise a ValueError.
    """
    with open_database(database) as opened:
        if opened.num_inlier_matches() == 0:
            return pycolmap.Reconstruction()
    options.ba_refine_sensor_from_rig = False  # else only the poses of reference sensors stay
    with _log(verbose), full_disk(output):
        with near_origin(reference):
            interruptible(
                pycolmap.triangulate_points,
                reference,
                database,
                image_dir,
                output,
                options=options,
            )
        reference.write_binary(output)
    return reference


def incremental_mapping(
    database: Path,
    image_dir: Path,
    output: Path,
    options: pycolmap.IncrementalPipelineOptions,
    verbose: bool,
) -> list[pycolmap.Reconstruction]:
    """Reconstruct the images of a database with verified matches; the largest model comes first."""
    output.mkdir()
    # the mapper warns at every failed attempt
    with _log(verbose, pycolmap.logging.Level.FATAL), full_disk(output):
        models = interruptible(
            pycolmap.incremental_mapping, database, image_dir, output, options=options
        )
    return sorted(models.values(), key=lambda model: model.num_reg_images(), reverse=True)


def bundle_adjuster(
    sfm: pycolmap.Reconstruction,
    options: pycolmap.BundleAdjustmentOptions,
    config: pycolmap.BundleAdjustmentConfig,
) -> Any:
    """Prepare a bundle adjustment by Ceres, which versions of pycolmap name differently."""
    create = getattr(pycolmap, "create_default_ceres_bundle_adjuster", None)
    return (create or pycolmap.create_default_bundle_adjuster)(options, config, sfm)


def covariance(sfm: pycolmap.Reconstruction, adjuster: Any) -> pycolmap.BACovariance | None:
    """Return the covariance of all that a `bundle_adjuster` estimates, None if it is singular."""
    options = pycolmap.BACovarianceOptions()
    options.params = pycolmap.BACovarianceOptionsParams.ALL
    with _log(False, pycolmap.logging.Level.FATAL):
        return pycolmap.estimate_ba_covariance(options, sfm, adjuster)


@contextmanager
def _log(
    verbose: bool, least: pycolmap.logging.Level = pycolmap.logging.Level.WARNING
) -> Iterator[None]:
    """Show COLMAP's log of a block if `verbose`, else messages of at least the level `least`.

    Blocks that show the same may overlap; the log is as before when the last one ends.
    """
    with _lock:
        _levels.append(pycolmap.logging.minloglevel)
        pycolmap.logging.minloglevel = int(pycolmap.logging.Level.INFO if verbose else least)
    try:
        yield
    finally:
        with _lock:
            level = _levels.pop()
            if not _levels:
                pycolmap.logging.minloglevel = level


def estimate_pose(
    points2D: np.ndarray, points3D: np.ndarray, camera: pycolmap.Camera, config: dict, ransac: dict
) -> dict | None:
    """Estimate an absolute pose by PnP + LO-RANSAC and refine it, deterministically.

    Args:
        points2D: (M, 2) image points in COLMAP's pixels.
        points3D: (M, 3) world points.
        camera: the intrinsics.
        config: hloc's dict, with options under "estimation" and "refinement".
        ransac: options of RANSAC, whose `random_seed` is 0 otherwise; those in `config` take
            precedence.

    Returns:
        cam_from_world, num_inliers and inlier_mask (M,), or None.
    """
    estimation = {**config.get("estimation", {})}
    estimation["ransac"] = {"random_seed": 0, **ransac, **estimation.get("ransac", {})}
    if len(points2D) == 0:
        return None
    estimate: Callable[..., dict | None] = pycolmap.estimate_and_refine_absolute_pose
    return estimate(points2D, points3D, camera, estimation, config.get("refinement", {}))


def refine_pose(
    cam_from_world: pycolmap.Rigid3d,
    points2D: np.ndarray,
    points3D: np.ndarray,
    inliers: np.ndarray,
    camera: pycolmap.Camera,
    refinement: dict,
) -> pycolmap.Rigid3d | None:
    """Refine an absolute pose by its inliers (M,) bool, and the intrinsics if the options say so.

    Args:
        cam_from_world: the pose.
        points2D: (M, 2) image points in COLMAP's pixels.
        points3D: (M, 3) world points.
        inliers: (M,) bool.
        camera: the intrinsics, which change in place.
        refinement: options of pycolmap's AbsolutePoseRefinementOptions.
    """
    if inliers.sum() < MIN_OF_POSE:
        return None
    refine: Callable[..., dict | None] = pycolmap.refine_absolute_pose
    found = refine(cam_from_world, points2D, points3D, inliers, camera, refinement)
    return None if found is None else found["cam_from_world"]


def estimate_rig_pose(
    points2D: np.ndarray,
    points3D: np.ndarray,
    camera_of: np.ndarray,
    cams_from_rig: Sequence[pycolmap.Rigid3d],
    cameras: Sequence[pycolmap.Camera],
    max_error: float,
) -> pycolmap.Rigid3d | None:
    """Estimate the pose of a rig, rig from world, by GP3P + LO-RANSAC, deterministically.

    Args:
        points2D: (M, 2) image points in COLMAP's pixels.
        points3D: (M, 3) world points.
        camera_of: (M,) index of the camera of each.
        cams_from_rig: the pose of each camera in the rig.
        cameras: their intrinsics.
        max_error: RANSAC's inlier threshold in pixels.
    """
    if len(points2D) < MIN_OF_POSE:
        return None
    ransac = {"max_error": max_error, "random_seed": 0}
    estimate: Callable[..., dict | None] = pycolmap.estimate_generalized_absolute_pose
    found = estimate(points2D, points3D, camera_of, cams_from_rig, cameras, ransac)
    return None if found is None else found["rig_from_world"]


def refine_rig_pose(
    rig_from_world: pycolmap.Rigid3d,
    points2D: np.ndarray,
    points3D: np.ndarray,
    inliers: np.ndarray,
    camera_of: np.ndarray,
    cams_from_rig: Sequence[pycolmap.Rigid3d],
    cameras: Sequence[pycolmap.Camera],
    refinement: dict,
) -> pycolmap.Rigid3d | None:
    """Refine the pose of a rig by its inliers (M,) bool, see `estimate_rig_pose`, `refine_pose`."""
    refine: Callable[..., dict | None] = pycolmap.refine_generalized_absolute_pose
    given = points2D, points3D, inliers, camera_of, cams_from_rig, cameras
    found = refine(rig_from_world, *given, refinement)
    return None if found is None else found["rig_from_world"]
