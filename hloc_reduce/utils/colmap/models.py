"""COLMAP models: read, check, select images; and the cameras of photos."""

import hashlib
import shutil
from collections.abc import Callable, Collection, Iterable
from functools import lru_cache
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
import pycolmap

from ... import logger
from ..cli import InputError
from ..files import file_sha256, replacing
from ..images import NO_IMAGE, check_format, unreadable
from . import binary_files, text_files
from .records import PARTS, UNIT_TOLERANCE

if TYPE_CHECKING:
    from scipy.sparse import csr_array

NEEDED = ("cameras", "images", "points3D")  # files; models of COLMAP 3.11 and older have no others
QUATERNION_ROUNDING = 1e-5  # quaternions of lengths that far from 1 are as good as unit quaternions
COMPARED_POINTS = 300  # of a model, whose tracks are compared with the images
# which pycolmap raises for broken files
COLMAP_ERRORS = (RuntimeError, ValueError, IndexError, KeyError, OverflowError)
# as COLMAP, binary files are read rather than text
FILE_FORMATS = {".bin": binary_files, ".txt": text_files}


def find_model(path: Path) -> Path:
    """Return the folder of a COLMAP model: `path`, or the only model in it, such as `sparse/0`.

    Raises:
        InputError: when there is none, or several.
    """
    return _find(path)[0]


def fingerprint(path: Path) -> str:
    """Return what tells a COLMAP model, a folder as for `find_model`, from others: 32 letters."""
    files = [file for part in NEEDED for file in sorted(find_model(path).glob(f"{part}.*"))]
    return hashlib.sha256(" ".join(map(file_sha256, files)).encode()).hexdigest()[:32]


def _find(path: Path) -> tuple[Path, ModuleType]:
    """Return the folder of a model, and the module for its files."""
    if not path.is_dir():
        raise InputError(f"There is no COLMAP model folder {path}.")
    if (files := _format(path)) is not None:
        return path, files
    if lacking := _lacking(path):
        raise InputError(f"{path} is not a COLMAP model (it has no {lacking}).")
    folders = sorted(path.iterdir(), key=lambda folder: (len(folder.name), folder.name))
    found = [(folder, files) for folder in folders if (files := _format(folder)) is not None]
    if not found:
        raise InputError(f"{path} is not a COLMAP model (it has no cameras.bin or cameras.txt).")
    if len(found) > 1:
        counts = (f"{folder.name} ({files.count_images(folder)} photos)" for folder, files in found)
        raise InputError(
            f"{path} has {len(found)} COLMAP models: {', '.join(counts)}. Give the folder of one."
        )
    return found[0]


def _format(folder: Path) -> ModuleType | None:
    """Return the module for the files that COLMAP reads in a folder; points may be missing."""
    for parts in (NEEDED, NEEDED[:2]):
        for suffix, files in FILE_FORMATS.items():
            if all((folder / f"{part}{suffix}").is_file() for part in parts):
                return files
    return None


def _lacking(folder: Path) -> str:
    """Return the name of the file without which those in a folder are no model, "" if none."""
    for suffix in FILE_FORMATS:
        is_there = {part: (folder / f"{part}{suffix}").is_file() for part in PARTS}
        if any(is_there.values()):
            return next(f"{part}{suffix}" for part in NEEDED if not is_there[part])
    return ""


def model_files(path: Path) -> list[Path]:
    """Return the files of a COLMAP model, binary or text, sorted.

    Raises:
        InputError: as `find_model`.
    """
    files = find_model(path).iterdir()
    return sorted(file for file in files if file.stem in PARTS and file.is_file())


def read_model(path: Path) -> pycolmap.Reconstruction:
    """Read a COLMAP model, binary or text, with or without rigs, frames and points.

    Rotations are normalized. Where images and points disagree on which keypoints show which points,
    the images are right.

    Args:
        path: folder of the model, or one with no other model in it.

    Raises:
        InputError: when it is missing or broken, or has an invalid image name.
    """
    return read_normalized(path)[0]


def read_normalized(path: Path) -> tuple[pycolmap.Reconstruction, bool]:
    """Read a COLMAP model as `read_model`, and tell whether this changed its rotations.

    What an earlier version made from such a model is stale.
    """
    folder, files = _find(path)
    records = files.read(folder)
    distance = records.check(folder)
    try:
        as_colmap = records.as_colmap
        model = pycolmap.Reconstruction(folder) if as_colmap else _read_copy(folder, files)
        agree = _agree(model, records.num_elements)
    except COLMAP_ERRORS:
        files.explain(folder)
        agree = False
    if not agree:
        try:
            model = _read_copy(folder, files, with_tracks=False)
        except COLMAP_ERRORS as error:
            reason = str(error).strip().splitlines()[0]
            raise InputError(f"{folder} is not a COLMAP model ({reason}).") from None
        _warn(folder, _make_tracks(model))
    for record in records.images:
        image = model.images[record.id]
        image.name = record.name
        if image.num_points2D() != record.num_points2D:
            raise text_files.wrong_keypoints(record.place)
    if distance >= UNIT_TOLERANCE:
        _normalize(model)
    return model, distance > QUATERNION_ROUNDING


def _read_copy(
    folder: Path, files: ModuleType, with_tracks: bool = True
) -> pycolmap.Reconstruction:
    """Read a model from files that are written anew."""
    with TemporaryDirectory(prefix="hloc_reduce-") as temporary:
        files.rewrite(folder, Path(temporary), with_tracks)
        return pycolmap.Reconstruction(temporary)


def _normalize(model: pycolmap.Reconstruction) -> None:
    """Make rotations of quaternions without unit length rotations."""
    for frame in model.frames.values():
        frame.rig_from_world = _rigid(frame.rig_from_world)
    for rig in model.rigs.values():
        for sensor, pose in rig.non_ref_sensors.items():
            if pose is not None:
                rig.set_sensor_from_rig(sensor, _rigid(pose))


def _rigid(pose: pycolmap.Rigid3d) -> pycolmap.Rigid3d:
    quaternion = pose.rotation.quat
    rotation = pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion))
    return pycolmap.Rigid3d(rotation, pose.translation)


def _agree(model: pycolmap.Reconstruction, num_elements: int) -> bool:
    """Return whether images and points agree on which keypoints show which points.

    Numbers are compared, and some points: to compare all takes as long as to read a model.
    """
    if model.compute_num_observations() != num_elements:
        return False
    for point_id, point in islice(model.points3D.items(), COMPARED_POINTS):
        for element in point.track.elements:
            if not model.exists_image(element.image_id):
                return False
            image, index = model.images[element.image_id], element.point2D_idx
            if index >= image.num_points2D() or image.point2D(index).point3D_id != point_id:
                return False
    return True


def _make_tracks(model: pycolmap.Reconstruction) -> int:
    """Make the tracks of points without any from the images.

    Returns:
        The number of keypoints whose points are not there: they are made ones without points.
    """
    absent = 0
    for image_id, image in model.images.items():
        for index in image.get_observation_point2D_idxs():
            point_id = image.point2D(index).point3D_id
            if model.exists_point3D(point_id):
                model.points3D[point_id].track.add_element(image_id, index)
            else:
                image.reset_point3D_for_point2D(index)
                absent += 1
    return absent


@lru_cache  # a model is read more than once
def _warn(folder: Path, absent: int) -> None:
    """Say that a model has other tracks now."""
    logger.warning(
        "%s: images and points disagree on which keypoints show which points. The images are taken "
        "as right; %d keypoints whose points are not there are taken as ones without points.",
        folder,
        absent,
    )


def write_part(path: Path, names: Collection[str], output: Path) -> Path:
    """Write a COLMAP model with only some of its images.

    Args:
        path: folder of the model.
        names: the images.
        output: folder of the new model, whose rigs are those of `remove_images`; unchanged files
            keep their times.

    Returns:
        `output`.
    """
    model = read_model(path)
    model = remove_images(model, {image.name for image in model.images.values()} - {*names})
    return write_model(model, output)


def write_model(model: pycolmap.Reconstruction, output: Path) -> Path:
    """Write a COLMAP model into a folder, which is returned; unchanged files keep their times."""
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


def remove_images(
    model: pycolmap.Reconstruction, names: Collection[str]
) -> pycolmap.Reconstruction:
    """Remove images from a model, with the points that fewer than two others see.

    COLMAP removes all images of a frame at once. So if a rig took some of `names` together with
    other images, each image of the model that is returned has a rig and a frame of its own.

    Args:
        model: changed, unless a rig took some of `names` together with others.
        names: the images.

    Returns:
        `model`, or a changed copy of it.
    """
    posed = [image for image in model.images.values() if image.has_pose]
    removed = {image.frame_id for image in posed if image.name in names}
    if any(image.frame_id in removed and image.name not in names for image in posed):
        model = with_cameras(model, lambda i: model.cameras[model.images[i].camera_id])
    for image in list(model.images.values()):
        if image.name in names and image.has_pose:
            model.deregister_frame(image.frame_id)
    return model


def with_cameras(
    model: pycolmap.Reconstruction, camera_of: Callable[[int], pycolmap.Camera]
) -> pycolmap.Reconstruction:
    """Copy the images, points and tracks of a model, with other cameras.

    Args:
        model: the model; each image of the copy has a rig and a frame of its own.
        camera_of: returns the camera of an image, by the id of the image.
    """
    made = pycolmap.Reconstruction()
    for image_id in model.reg_image_ids():
        image, camera = model.images[image_id], camera_of(image_id)
        keypoints = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        new = pycolmap.Image(image.name, keypoints, camera_id=camera.camera_id, image_id=image_id)
        add_image(made, camera, new, image.cam_from_world())
    for point in model.points3D.values():
        point_id = made.add_point3D(point.xyz, point.track, point.color)
        made.points3D[point_id].error = point.error
    return made


def observed(
    model: pycolmap.Reconstruction, image: pycolmap.Image
) -> tuple[np.ndarray, np.ndarray]:
    """Return the keypoints (M, 2) of an image that show points, and these points (M, 3)."""
    seen = [point for point in image.points2D if point.has_point3D()]
    points2D = np.array([point.xy for point in seen]).reshape(-1, 2)
    return points2D, np.array([model.points3D[p.point3D_id].xyz for p in seen]).reshape(-1, 3)


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
    found = np.full(image.num_points2D(), -1, np.int64)
    for i in image.get_observation_point2D_idxs():
        found[i] = image.point2D(i).point3D_id
    return found


def visibility(ids_of_images: Iterable[np.ndarray]) -> "csr_array":
    """Return how many keypoints of each image show each point (I, P) int32, a sparse matrix.

    Its columns are the points that any image shows, by ascending id.

    Args:
        ids_of_images: for each of one or more images the points of its keypoints (N,), -1 for none.
    """
    from scipy.sparse import coo_array

    points = [ids[ids >= 0] for ids in ids_of_images]
    rows = np.repeat(np.arange(len(points)), [len(ids) for ids in points])
    _, columns = np.unique(np.concatenate(points), return_inverse=True)
    shape = len(points), columns.max(initial=-1) + 1
    return coo_array((np.ones(len(rows), np.int32), (rows, columns)), shape).tocsr()


def cam_from_img(camera: pycolmap.Camera, points2D: np.ndarray) -> np.ndarray:
    """Undistort image points (N, 2) in COLMAP's pixels onto the normalized image plane.

    Points that the camera model cannot undistort become infinite.
    """
    if len(points2D) == 0:
        return np.zeros((0, 2))
    points = camera.cam_from_img(np.asarray(points2D, np.float64))
    return np.nan_to_num(np.asarray(points, np.float64), nan=np.inf)


def infer_camera(image: Path) -> tuple[pycolmap.Camera, bool]:
    """Guess the intrinsics of a photo: SIMPLE_RADIAL, with the focal length of its EXIF data.

    Returns:
        The camera, and whether EXIF data gave the focal length; otherwise it is 1.2 times the
        longer side.

    Raises:
        UnreadableImage: when the image cannot be read.
    """
    check_format(image)  # which some versions of COLMAP would read
    try:
        camera = pycolmap.infer_camera_from_image(image)
    except Exception:  # RuntimeError or ValueError, depending on the version
        raise unreadable(image, NO_IMAGE) from None
    return camera, camera.has_prior_focal_length
