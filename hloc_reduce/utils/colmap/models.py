"""COLMAP models: read, check, select images; and the cameras of photos."""

import shutil
from collections.abc import Collection, Iterable
from functools import lru_cache
from mmap import ACCESS_READ, mmap
from pathlib import Path
from struct import error as struct_error
from struct import unpack_from
from typing import TYPE_CHECKING

import numpy as np
import pycolmap

from ..cli import InputError
from ..files import replacing
from ..images import NO_IMAGE, check_format, unreadable
from ..parsers import CAMERA_MODELS, check_names

if TYPE_CHECKING:
    from scipy.sparse import csr_array

PARTS = ("cameras", "frames", "images", "points3D", "rigs")  # files of a model


def model_files(path: Path) -> list[Path]:
    """Return the files of a COLMAP model, binary or text, sorted."""
    return sorted(file for file in path.iterdir() if file.stem in PARTS and file.is_file())


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
