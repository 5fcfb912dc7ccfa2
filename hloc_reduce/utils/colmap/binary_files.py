"""Binary files of COLMAP models."""

from array import array
from collections.abc import Callable
from functools import lru_cache
from mmap import ACCESS_READ, mmap
from pathlib import Path
from struct import error as struct_error
from struct import pack, unpack_from
from typing import TypeVar

import numpy as np
import pycolmap

from ..cli import InputError
from ..parsers import CAMERA_MODELS
from .records import Camera, Frame, Image, Pose, Records, Rig, Sensor

KEYPOINT_SIZE = 24  # bytes
POINT_TYPE = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
Parsed = TypeVar("Parsed")


def read(folder: Path) -> Records:
    """Read the records of a binary model. COLMAP may never finish reading a truncated one.

    Raises:
        InputError: naming a file that is truncated or broken.
    """
    cameras = _parse(folder / "cameras.bin", _cameras)
    images = _parse(folder / "images.bin", _images)
    has = {part: (folder / f"{part}.bin").is_file() for part in ("rigs", "frames", "points3D")}
    rigs = _parse(folder / "rigs.bin", _rigs) if has["rigs"] else []
    frames = _parse(folder / "frames.bin", _frames) if has["frames"] else []
    num_elements = _parse(folder / "points3D.bin", _check_points) if has["points3D"] else 0
    return Records(cameras, rigs, frames, images, num_elements, has["points3D"])


def rewrite(folder: Path, output: Path, with_tracks: bool) -> None:
    """Link a model, but write its points without tracks; there are none without points3D.bin."""
    for part in ("cameras", "frames", "images", "rigs"):
        if (folder / f"{part}.bin").is_file():
            (output / f"{part}.bin").symlink_to((folder / f"{part}.bin").resolve())
    points = np.zeros(0, POINT_TYPE)
    if (folder / "points3D.bin").is_file():
        points = _parse(folder / "points3D.bin", _points)
    points["length"] = 0
    (output / "points3D.bin").write_bytes(pack("<Q", len(points)) + points.tobytes())


def explain(folder: Path) -> None:
    """Raise an InputError for what COLMAP cannot read in points3D.bin, if it is known."""
    path = folder / "points3D.bin"
    if path.is_file():
        ids, numbers = np.unique(_parse(path, _points)["id"], return_counts=True)
        if (numbers > 1).any():
            raise InputError(f"{path}: the id {ids[np.argmax(numbers)]} is used twice.")


def count_images(folder: Path) -> int:
    """Return the number of images of a binary model."""
    return _parse(folder / "images.bin", lambda _, number, __: (number, 0))


def _parse(path: Path, parse: Callable[[mmap, int, Path], tuple[Parsed, int]]) -> Parsed:
    """Parse a file, which begins with the number of its records.

    Args:
        path: the file.
        parse: returns what is in it, and the offset after the last record.
    """
    try:
        with path.open("rb") as file:
            data = mmap(file.fileno(), 0, access=ACCESS_READ)
        (number,) = unpack_from("<Q", data)
        parsed, end = parse(data, number, path)
        if end > len(data):
            raise ValueError
    except InputError:
        raise
    except (ValueError, IndexError, struct_error, OverflowError):  # of an empty file, or at its end
        reason = f"{path.name} is truncated"
        raise InputError(f"{path.parent} is not a COLMAP model ({reason}).") from None
    return parsed


def _cameras(data: mmap, number: int, path: Path) -> tuple[list[Camera], int]:
    found, end, names = [], 8, _camera_models()
    for _ in range(number):
        camera_id, model, *sizes = unpack_from("<IiQQ", data, end)
        place = f"{path}, camera {camera_id}"
        if model not in names:
            raise InputError(
                f"{place}: it has model {model}, which pycolmap {pycolmap.__version__} does not "
                "know, or the file is broken."
            )
        name, num_params = names[model]
        camera = pycolmap.Camera(model=name, width=sizes[0], height=sizes[1])
        camera.params = unpack_from(f"<{num_params}d", data, end + 24)
        end += 24 + 8 * num_params
        found.append(Camera(place, camera_id, camera))
    return found, end


def _images(data: mmap, number: int, path: Path) -> tuple[list[Image], int]:
    found, end = [], 8
    for _ in range(number):
        image_id, *pose, camera_id = unpack_from("<I7dI", data, end)
        place = f"{path}, image {image_id}"
        end_of_name = data.find(b"\0", end + 64)
        if end_of_name < 0:
            raise ValueError
        name = data[end + 64 : end_of_name]
        try:
            decoded = name.decode()
        except UnicodeDecodeError:
            shown = name.decode(errors="replace")
            raise InputError(f"{place}: the name {shown} is not in UTF-8: rename it.") from None
        (count,) = unpack_from("<Q", data, end_of_name + 1)
        end = end_of_name + 9 + KEYPOINT_SIZE * count
        found.append(Image(place, image_id, tuple(pose), camera_id, decoded, count))
    return found, end


def _rigs(data: mmap, number: int, path: Path) -> tuple[list[Rig], int]:
    found, end = [], 8
    for _ in range(number):
        rig_id, num_sensors = unpack_from("<II", data, end)
        end += 8
        sensors: list[Sensor] = []
        poses: dict[Sensor, Pose] = {}
        for i in range(num_sensors):
            sensors.append(unpack_from("<iI", data, end))
            end += 8
            if i:
                if data[end]:
                    poses[sensors[-1]] = unpack_from("<7d", data, end + 1)
                    end += 56
                end += 1
        found.append(Rig(f"{path}, rig {rig_id}", rig_id, sensors, poses))
    return found, end


def _frames(data: mmap, number: int, path: Path) -> tuple[list[Frame], int]:
    found, end = [], 8
    for _ in range(number):
        frame_id, rig_id, *pose, count = unpack_from("<II7dI", data, end)
        end += 68
        data_ids = []
        for _ in range(count):
            kind, sensor_id, data_id = unpack_from("<iIQ", data, end)
            data_ids.append(((kind, sensor_id), data_id))
            end += 16
        place = f"{path}, frame {frame_id}"
        found.append(Frame(place, frame_id, rig_id, tuple(pose), data_ids))
    return found, end


def _check_points(data: mmap, number: int, path: Path) -> tuple[int, int]:
    """Return the number of elements of all tracks, and check that positions are finite."""
    starts, end = _starts(data, number)
    positions = _anywhere(data, np.dtype("V24"))[starts + 8].view("<f8").reshape(-1, 3)
    finite = np.isfinite(positions).all(axis=1)
    if not finite.all():
        wrong = _anywhere(data, np.dtype("<u8"))[starts[np.argmin(finite)]]
        raise InputError(f"{path}, point {wrong}: its position is not finite.")
    return (end - 8 - POINT_TYPE.itemsize * number) // 8, end


def _points(data: mmap, number: int, path: Path) -> tuple[np.ndarray, int]:
    starts, end = _starts(data, number)
    return _anywhere(data, POINT_TYPE)[starts], end


def _starts(data: mmap, number: int) -> tuple[np.ndarray, int]:
    """Return the offsets of points (P,) int64, and that after the last one."""
    starts, end = array("q"), 8
    add, length = starts.append, _anywhere(data, np.dtype("<u8")).item
    for _ in range(number):  # millions
        add(end)
        end += 51 + 8 * length(end + 43)
    if end > len(data):
        raise ValueError
    return np.array(starts, np.int64), end


def _anywhere(data: mmap, dtype: np.dtype) -> np.ndarray:
    """Return a view of bytes (N,) as values of a type that begin at each of them."""
    return np.ndarray(max(0, len(data) - dtype.itemsize + 1), dtype, data, strides=1)


@lru_cache
def _camera_models() -> dict[int, tuple[str, int]]:
    """Return the names and numbers of parameters of camera models, by their ids."""
    models = {name: pycolmap.CameraModelId.__members__[name] for name in CAMERA_MODELS}
    new = hasattr(pycolmap.Camera, "create_from_model_id")  # pycolmap 4
    make = pycolmap.Camera.create_from_model_id if new else pycolmap.Camera.create
    return {
        int(model): (name, len(make(1, model, 1.0, 1, 1).params)) for name, model in models.items()
    }
