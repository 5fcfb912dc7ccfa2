"""The images of a compact map: a row of a table for each, and another table of their cameras."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from ..localization import intrinsics
from ..utils.cli import InputError, some
from ..utils.parsers import CAMERA_MODELS

WHOLE = 2**31 - 1  # what stands for 1 in rotations, and for the largest distance in centers
ROW = np.dtype([("rotation", "<i4", 3), ("center", "<i4", 3), ("camera", "<u4"), ("end", "<u4")])
MODELS = {pycolmap.CameraModelId.__members__[name].value: name for name in CAMERA_MODELS}


@dataclass(frozen=True)
class Images:
    """The images of a map.

    Args:
        names: sorted.
        rotations: (I, 4) float64, quaternions x, y, z, w, camera from world.
        centers: (I, 3) float64, positions of the cameras.
        cameras: their intrinsics.
        camera: (I,) int64, of each image the index of these.
    """

    names: Sequence[str]
    rotations: np.ndarray
    centers: np.ndarray
    cameras: Sequence[pycolmap.Camera]
    camera: np.ndarray

    @classmethod
    def of(cls, model: pycolmap.Reconstruction, names: Collection[str] | None = None) -> "Images":
        """Return images of a COLMAP model, by default all.

        Raises:
            InputError: for one that it does not have.
        """
        numbers = {image.name: i for i, image in model.images.items()}
        listed = sorted(numbers if names is None else set(names))
        if missing := [name for name in listed if name not in numbers]:
            raise InputError(f"The map has no image {some(missing)}.")
        ids = [numbers[name] for name in listed]
        used = [model.images[i].camera_id for i in ids]
        keys = {i: tuple(intrinsics.to_list(model.cameras[i])) for i in used}
        cameras = {key: model.cameras[i] for i, key in keys.items()}  # equal ones once
        rows = {key: row for row, key in enumerate(cameras)}
        poses = [model.images[i].cam_from_world() for i in ids]
        return cls(
            listed,
            np.array([pose.rotation.quat for pose in poses]),
            np.array([pose.inverse().translation for pose in poses]),
            [*cameras.values()],
            np.array([rows[keys[i]] for i in used]),
        )

    def pack(self, least: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the table (I, 32) uint8, and the step of centers.

        Args:
            least: (3,) that centers are relative to.
            ends: (I,) of each image the end of its visible points.
        """
        table = np.zeros(len(self.names), ROW)
        quaternions = self.rotations / np.linalg.norm(self.rotations, axis=1, keepdims=True)
        quaternions *= np.where(quaternions[:, 3:] < 0, -1, 1)
        parts = quaternions[:, :3] / (1 + quaternions[:, 3:])  # modified Rodrigues parameters
        table["rotation"] = np.rint(parts * WHOLE)
        offsets = self.centers - least
        step = float(np.abs(offsets).max(initial=np.finfo(np.float32).tiny)) / WHOLE
        table["center"] = np.rint(offsets / step).clip(-WHOLE, WHOLE)
        table["camera"], table["end"] = self.camera, ends
        return table.view(np.uint8).reshape(-1, ROW.itemsize), step


def rotations(table: np.ndarray) -> np.ndarray:
    """Return the unit quaternions (N, 4), x, y, z, w, of rows (N,) of the table."""
    parts = table["rotation"] / WHOLE
    square = (parts**2).sum(axis=1, keepdims=True)
    return np.hstack([2 * parts, 1 - square]) / (1 + square)


def _row(parameters: int) -> np.dtype:
    """Return the type of a row of the table of cameras, by the most parameters of one."""
    sizes = [("model", "<u4"), ("width", "<u4"), ("height", "<u4")]
    return np.dtype([*sizes, ("parameters", "<f4", (parameters,))])


def pack_cameras(cameras: Sequence[pycolmap.Camera]) -> np.ndarray:
    """Return the table of cameras (C, 12 + 4 K) uint8, K the most parameters of one."""
    kind = _row(max(len(camera.params) for camera in cameras))
    table = np.zeros(len(cameras), kind)
    for row, camera in zip(table, cameras, strict=True):
        row["model"], row["width"], row["height"] = camera.model.value, camera.width, camera.height
        row["parameters"][: len(camera.params)] = camera.params
    return table.view(np.uint8).reshape(-1, kind.itemsize)


def read_camera(row: np.ndarray) -> pycolmap.Camera:
    """Return the intrinsics in a row (12 + 4 K,) uint8 of the table of cameras.

    Raises:
        ValueError or KeyError: if they are wrong.
    """
    found = row.view(_row((len(row) - 12) // 4))[0]
    model = MODELS[int(found["model"])]
    number = len(pycolmap.Camera(model=model).params_info.split(","))
    parameters = found["parameters"][:number].tolist()
    return intrinsics.from_list([model, found["width"], found["height"], *parameters])
