"""pycolmap: what differs between its versions, and its databases."""

import errno
import json
import os
import shutil
import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import lru_cache
from mmap import ACCESS_READ, mmap
from pathlib import Path
from struct import error as struct_error
from struct import unpack_from
from typing import Any

import numpy as np
import pycolmap

from .cli import InputError, Parser, choose, some
from .files import replacing
from .interrupts import interruptible
from .parsers import CAMERA_MODELS, check_names, parse_pairs, write_pairs

pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)
FULL = 2**16  # free bytes, below which COLMAP cannot even open a database


def detect_dog(image: np.ndarray, options: dict) -> tuple[np.ndarray, np.ndarray]:
    """Detect and describe keypoints with COLMAP's SIFT on the CPU, in one thread.

    Args:
        image: (H, W) float32 in [0, 1].
        options: pycolmap's SiftExtractionOptions.

    Returns:
        Keypoints (N, 4) float32: x, y with pixel centres at integers, scale in pixels, orientation
        in degrees from x towards y; and COLMAP's descriptors (N, 128) float32, unit norm.
    """
    extractor: Any = _sift_extractor(json.dumps(options, sort_keys=True))
    if hasattr(extractor, "extract_from_float32_array"):  # pycolmap 4
        found, described = extractor.extract_from_float32_array(image)
        keypoints = np.array(
            [(k.x, k.y, k.compute_scale(), k.compute_orientation()) for k in found], np.float32
        )
        descriptors = described.data.astype(np.float32)
    else:
        keypoints, descriptors = extractor.extract(image)
    x_y, scale, orientation = np.split(keypoints.reshape(-1, 4), [2, 3], axis=1)
    descriptors = descriptors.reshape(-1, 128)
    norm = np.linalg.norm(descriptors, axis=1, keepdims=True)
    # COLMAP's origin is the corner
    return (
        np.concatenate([x_y - 0.5, scale, np.rad2deg(orientation)], axis=1),
        np.divide(descriptors, norm, out=np.zeros_like(descriptors), where=norm > 0),
    )


_thread = threading.local()


def _sift_extractor(options: str) -> "pycolmap.FeatureExtractor":
    """Return an extractor for this thread: COLMAP's have state.

    Only the last one is kept: its pyramid of an image at twice its size takes half a gigabyte.
    """
    if getattr(_thread, "options", None) != options:
        _thread.extractor = _thread.options = None  # free it before another is created
        extraction = _extraction_options(json.loads(options))
        new = hasattr(pycolmap, "FeatureExtractor")  # pycolmap 4
        make = pycolmap.FeatureExtractor.create if new else pycolmap.Sift
        _thread.extractor, _thread.options = make(extraction, pycolmap.Device.cpu), options
    return _thread.extractor


def check_dog_options(options: dict) -> None:
    """Raise an InputError for an unknown option of `detect_dog`."""
    _extraction_options(options)


def _extraction_options(options: dict) -> pycolmap.FeatureExtractionOptions:
    try:
        sift = pycolmap.SiftExtractionOptions(options)
    except (AttributeError, TypeError, RuntimeError, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        raise InputError(f"The DoG options {options} cannot be used ({reason}).") from None
    return pycolmap.FeatureExtractionOptions(sift=sift)


def read_model(path: Path) -> pycolmap.Reconstruction:
    """Read a COLMAP model, binary or text, with or without rigs and frames.

    Raises:
        InputError: when it is missing or broken, or has an invalid image name.
    """
    if not path.is_dir():
        raise InputError(f"There is no COLMAP model folder {path}.")
    check_whole(path)
    try:
        model = pycolmap.Reconstruction(path)
        names = [image.name for image in model.images.values()]
    except Exception as error:  # pycolmap raises RuntimeError, ValueError, IndexError, ...
        reason = str(error).strip().splitlines()[0]
        raise InputError(f"{path} is not a COLMAP model ({reason}).") from None
    check_names(names, path)
    return model


def check_whole(path: Path) -> None:
    """Check that no file of a binary COLMAP model is truncated: COLMAP may never finish reading it.

    Raises:
        InputError: naming a truncated file.
    """
    for name, skip in RECORDS.items():
        file = path / f"{name}.bin"
        if not file.is_file():
            continue
        try:
            with file.open("rb") as opened, mmap(opened.fileno(), 0, access=ACCESS_READ) as data:
                (number,), end = unpack_from("<Q", data, 0), 8
                for _ in range(number):
                    end = skip(data, end)
                if end > len(data):
                    raise ValueError
        except (ValueError, struct_error, OverflowError):  # of an empty file, or at its end
            raise InputError(f"{path} is not a COLMAP model ({file.name} is truncated).") from None


def _skip_camera(data: mmap, start: int) -> int:
    (model,) = unpack_from("<i", data, start + 4)
    if model not in _num_params():
        raise ValueError
    return start + 24 + 8 * _num_params()[model]


def _skip_image(data: mmap, start: int) -> int:
    end_of_name = data.find(b"\0", start + 64)
    if end_of_name < 0:
        raise ValueError
    return end_of_name + 9 + 24 * unpack_from("<Q", data, end_of_name + 1)[0]


def _skip_point(data: mmap, start: int) -> int:
    return start + 51 + 8 * unpack_from("<Q", data, start + 43)[0]


def _skip_frame(data: mmap, start: int) -> int:
    return start + 68 + 16 * unpack_from("<I", data, start + 64)[0]


@lru_cache
def _num_params() -> dict[int, int]:
    """Return the number of parameters of each camera model, by its id."""
    models = [pycolmap.CameraModelId.__members__[name] for name in CAMERA_MODELS]
    new = hasattr(pycolmap.Camera, "create_from_model_id")  # pycolmap 4
    make = pycolmap.Camera.create_from_model_id if new else pycolmap.Camera.create
    return {int(model): len(make(1, model, 1.0, 1, 1).params) for model in models}


# files of a binary COLMAP model -> functions that return the end of the record at an offset
RECORDS = {
    "cameras": _skip_camera,
    "images": _skip_image,
    "points3D": _skip_point,
    "frames": _skip_frame,
}


def write_part(path: Path, names: Collection[str], output: Path) -> Path:
    """Write a COLMAP model with only some of its images.

    Args:
        path: folder of the model.
        names: the images.
        output: folder of the new model; unchanged files keep their times.

    Returns:
        `output`.
    """
    model = read_model(path)
    for image in model.images.values():
        if image.name not in names:
            model.deregister_frame(image.frame_id)
    written = output.with_name(f".{output.name}.tmp")
    shutil.rmtree(written, ignore_errors=True)
    written.mkdir(parents=True)
    try:
        model.write_binary(written)
        for file in written.iterdir():
            with replacing(output / file.name) as temporary:
                shutil.copyfile(file, temporary)
    finally:
        shutil.rmtree(written)
    return output


def add_image(
    model: pycolmap.Reconstruction,
    camera: pycolmap.Camera,
    image: pycolmap.Image,
    cam_from_world: pycolmap.Rigid3d,
) -> None:
    """Add an image with a pose, and its camera if it is new, with its own rig and frame.

    Same as pycolmap's `add_image_with_trivial_frame`, which 3.13 lacks.
    """
    if not model.exists_camera(camera.camera_id):
        model.add_camera(camera)
        rig = pycolmap.Rig(rig_id=camera.camera_id)
        rig.add_ref_sensor(camera.sensor_id)
        model.add_rig(rig)
    frame = pycolmap.Frame(frame_id=image.image_id, rig_id=camera.camera_id)
    frame.add_data_id(image.data_id)
    frame.rig_from_world = cam_from_world
    model.add_frame(frame)
    image.frame_id = frame.frame_id
    model.add_image(image)
    model.register_frame(frame.frame_id)


def point3D_ids(image: pycolmap.Image) -> np.ndarray:
    """Return the 3D point ids of an image's keypoints (N,) int64, -1 for none."""
    return np.array([p.point3D_id if p.has_point3D() else -1 for p in image.points2D], np.int64)


def cam_from_img(camera: pycolmap.Camera, points2D: np.ndarray) -> np.ndarray:
    """Undistort image points (N, 2) in COLMAP's pixels onto the normalized image plane.

    Points that the camera model cannot undistort become infinite.
    """
    if len(points2D) == 0:
        return np.zeros((0, 2))
    points = camera.cam_from_img(np.asarray(points2D, np.float64))
    return np.nan_to_num(np.asarray(points, np.float64), nan=np.inf)


def write_reference(database: Path, reference: pycolmap.Reconstruction) -> None:
    """Create a COLMAP database with the cameras and images of a model, with their ids."""
    with _open(database) as opened:
        for camera in reference.cameras.values():
            opened.write_camera(camera, use_camera_id=True)
        for rig in reference.rigs.values():
            opened.write_rig(rig, use_rig_id=True)
        for frame in reference.frames.values():
            opened.write_frame(frame, use_frame_id=True)
        for image in reference.images.values():
            opened.write_image(image, use_image_id=True)


@contextmanager
def _open(database: Path) -> Iterator[pycolmap.Database]:
    """Open a COLMAP database, without a transaction: on a full disk it would abort the process."""
    with _full_disk(database), pycolmap.Database.open(database) as opened:
        yield opened


@contextmanager
def _full_disk(path: Path) -> Iterator[None]:
    """Raise an OSError if the disk gets full in a block that writes `path`; COLMAP does not."""

    def check() -> None:
        if shutil.disk_usage(path.parent).free < FULL:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from None

    try:
        yield
    except RuntimeError:
        check()
        raise
    check()


def camera_mode(name: str) -> pycolmap.CameraMode:
    """Return COLMAP's camera mode by its name in lower or upper case, such as per_folder.

    Raises:
        InputError: for an unknown name.
    """
    modes = {mode.lower(): value for mode, value in pycolmap.CameraMode.__members__.items()}
    return modes[choose("camera mode", name.lower(), modes)]


def add_camera_mode(parser: Parser) -> None:
    """Add --camera_mode."""
    modes = ", ".join(mode.lower() for mode in pycolmap.CameraMode.__members__)
    parser.add_argument(
        "--camera_mode",
        default="auto",
        help=f"which photos share a camera, as in COLMAP: {modes}; auto, COLMAP's default: those "
        "of the same make, model, focal length and size by EXIF data",
    )


def import_images(
    database: Path,
    image_dir: Path,
    names: list[str],
    camera_mode: pycolmap.CameraMode,
    options: dict,
) -> None:
    """Create a COLMAP database with images, and cameras guessed from their EXIF data.

    Raises:
        InputError: for an unknown option, or an image that COLMAP skips.
    """
    with _open(database):
        pass
    try:
        reader = pycolmap.ImageReaderOptions(options)
    except (AttributeError, TypeError, RuntimeError, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        raise InputError(f"The image options {options} cannot be used ({reason}).") from None
    pycolmap.import_images(database, image_dir, camera_mode, image_names=names, options=reader)
    with _open(database) as opened:
        imported = {image.name for image in opened.read_all_images()}
    if skipped := [name for name in names if name not in imported]:
        reason = "they cannot be read"
        if camera_mode in (pycolmap.CameraMode.SINGLE, pycolmap.CameraMode.PER_FOLDER):
            reason += " or differ in size from the images that share their camera"
        raise InputError(
            f"COLMAP skipped {len(skipped)} images in {image_dir}, because {reason}: "
            f"{some(skipped)}."
        )


def write_matches(
    database: Path,
    keypoints: dict[str, np.ndarray],
    matches: dict[tuple[str, str], tuple[np.ndarray, np.ndarray | None]],
) -> None:
    """Write the keypoints and matches of images into a COLMAP database.

    Args:
        database: has the images.
        keypoints: (N, 2) in COLMAP's pixels, by image name.
        matches: all and the verified matches (M, 2) of pairs of image names; None instead of the
            verified ones if `verify_matches` will find them.
    """
    with _open(database) as opened:
        image_ids = {image.name: image.image_id for image in opened.read_all_images()}
        for name, points in keypoints.items():
            opened.write_keypoints(image_ids[name], points.astype(np.float32))
        for (name0, name1), (all_matches, verified) in matches.items():
            ids = image_ids[name0], image_ids[name1]
            opened.write_matches(*ids, all_matches.astype(np.uint32))
            if verified is None:
                continue
            # COLMAP 4.2.1 and later skip geometries with an undefined configuration
            geometry = pycolmap.TwoViewGeometry(
                config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED,
                inlier_matches=verified.astype(np.uint32),
            )
            opened.write_two_view_geometry(*ids, geometry)


def mapper_options(options: dict) -> pycolmap.IncrementalPipelineOptions:
    """Convert a dict to pycolmap's mapper options.

    Raises:
        InputError: for an unknown option.
    """
    try:
        return pycolmap.IncrementalPipelineOptions(options)
    except (AttributeError, TypeError, RuntimeError, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        raise InputError(f"The mapper options {options} cannot be used ({reason}).") from None


def verify_matches(database: Path, pairs: Path, verbose: bool) -> None:
    """Estimate the two-view geometries of the matches of a database, with hloc's options."""
    options = {"ransac": {"max_num_trials": 20000, "min_inlier_ratio": 0.1, "random_seed": 0}}
    with _log(verbose), _named_by_ids(database, pairs) as pairs_by_ids:
        interruptible(pycolmap.verify_matches, database, pairs_by_ids, options=options)


@contextmanager
def _named_by_ids(database: Path, pairs: Path) -> Iterator[Path]:
    """In a block, name the images of a database by their ids if any name contains spaces.

    COLMAP cannot read a list of pairs with spaces in names. Yields a list that it can read.
    """
    with _open(database) as opened:
        images = opened.read_all_images()
    names = {image.image_id: image.name for image in images}
    if all(name.split() == [name] for name in names.values()):
        yield pairs
        return
    ids = {name: str(image_id) for image_id, name in names.items()}
    by_ids = database.with_name("pairs_by_ids.txt")
    write_pairs(((ids[a], ids[b]) for a, b in parse_pairs(pairs)), by_ids)
    _rename(database, images, {image_id: str(image_id) for image_id in names})
    try:
        yield by_ids
    finally:
        by_ids.unlink()
        _rename(database, images, names)


def _rename(database: Path, images: list[pycolmap.Image], names: dict[int, str]) -> None:
    with _open(database) as opened:
        for image in images:
            image.name = names[image.image_id]
            opened.update_image(image)


def read_cameras(database: Path) -> dict[int, pycolmap.Camera]:
    """Return the cameras of a COLMAP database by their ids."""
    with _open(database) as opened:
        return {camera.camera_id: camera for camera in opened.read_all_cameras()}


def count_verified(database: Path) -> dict[tuple[str, str], int]:
    """Return the number of verified matches of each pair of images that has any."""
    with _open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        counts = zip(*opened.read_two_view_geometry_num_inliers(), strict=True)
    ids = ((pycolmap.pair_id_to_image_pair(pair), int(count)) for pair, count in counts)
    return {(names[pair[0]], names[pair[1]]): count for pair, count in ids if count}


def triangulate_points(
    reference: pycolmap.Reconstruction,
    database: Path,
    image_dir: Path,
    output: Path,
    options: pycolmap.IncrementalPipelineOptions,
    verbose: bool,
) -> pycolmap.Reconstruction:
    """Triangulate the verified matches of a database into `output` with fixed poses.

    Without any match the model is empty; COLMAP 3.13 would raise a ValueError.
    """
    with _open(database) as opened:
        if opened.num_inlier_matches() == 0:
            return pycolmap.Reconstruction()
    with _log(verbose), _full_disk(output):
        inputs = reference, database, image_dir, output
        return interruptible(pycolmap.triangulate_points, *inputs, options=options)


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
    with _log(verbose, pycolmap.logging.Level.FATAL), _full_disk(output):
        inputs = database, image_dir, output
        models = interruptible(pycolmap.incremental_mapping, *inputs, options=options)
    return sorted(models.values(), key=lambda model: model.num_reg_images(), reverse=True)


def infer_camera(image: Path) -> tuple[pycolmap.Camera, bool]:
    """Guess the intrinsics of a photo: SIMPLE_RADIAL, with the focal length of its EXIF data.

    Returns:
        The camera, and whether EXIF data gave the focal length; otherwise it is 1.2 times the
        longer side.

    Raises:
        InputError: when the image cannot be read.
    """
    try:
        camera = pycolmap.infer_camera_from_image(image)
    except Exception:  # RuntimeError or ValueError, depending on the version
        broken, absent = "it is not an image, or it is truncated", "No such file or directory"
        reason = broken if Path(image).exists() else absent
        raise InputError(f"Cannot read image {image}: {reason}.") from None
    return camera, camera.has_prior_focal_length


@contextmanager
def _log(
    verbose: bool, least: pycolmap.logging.Level = pycolmap.logging.Level.WARNING
) -> Iterator[None]:
    """Show COLMAP's log of a block if `verbose`, else messages of at least the level `least`."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.INFO if verbose else least)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


def estimate_pose(
    points2D: np.ndarray, points3D: np.ndarray, camera: pycolmap.Camera, config: dict, seed: int
) -> dict | None:
    """Estimate an absolute pose by PnP + LO-RANSAC and refine it, deterministically.

    Args:
        points2D: (M, 2) image points in COLMAP's pixels.
        points3D: (M, 3) world points.
        camera: the intrinsics.
        config: hloc's dict, with options under "estimation" and "refinement".
        seed: the seed of RANSAC.

    Returns:
        cam_from_world, num_inliers and inlier_mask (M,), or None.
    """
    estimation = {**config.get("estimation", {})}
    estimation["ransac"] = {"random_seed": seed, **estimation.get("ransac", {})}
    if len(points2D) == 0:
        return None
    estimate: Callable[..., dict | None] = pycolmap.estimate_and_refine_absolute_pose
    return estimate(points2D, points3D, camera, estimation, config.get("refinement", {}))
