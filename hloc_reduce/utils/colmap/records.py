"""The records of a COLMAP model's files, text or binary, and whether they fit together.

COLMAP's readers answer a broken model by a failed assertion without a file, or read it otherwise
than it is meant. So records are read and checked here first, all but points and keypoints.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
import pycolmap

from ..cli import InputError
from ..parsers import check_camera, check_names

PARTS = ("cameras", "frames", "images", "points3D", "rigs")  # files of a model
# largest ids: COLMAP's databases number pairs of images by theirs, 2**32 - 1 stands for no id
MAX_IMAGE_ID, MAX_ID = 2**31 - 2, 2**32 - 2
UNIT_TOLERANCE = 1e-9  # how far the length of a unit quaternion may be from 1
MIN_QUATERNION_LENGTH = 1e-9  # shorter ones, and longer ones than its inverse, are no rotations

Pose = tuple[float, ...]  # QW QX QY QZ TX TY TZ, camera or rig from world, or camera from rig
Sensor = tuple[int, int]  # type and id


class Camera(NamedTuple):
    """A camera; `place` is the file and its line or the id, as in all records."""

    place: str
    id: int
    camera: pycolmap.Camera


class Rig(NamedTuple):
    """A rig; the first sensor is its reference, the poses are those of others."""

    place: str
    id: int
    sensors: list[Sensor]
    poses: dict[Sensor, Pose]


class Frame(NamedTuple):
    """A frame, the pose of its rig, and the sensor and id of each image and other data in it."""

    place: str
    id: int
    rig_id: int
    pose: Pose
    data: list[tuple[Sensor, int]]


class Image(NamedTuple):
    """An image; its pose does not count in a model with frames."""

    place: str
    id: int
    pose: Pose
    camera_id: int
    name: str
    num_points2D: int


Record = TypeVar("Record", Camera, Rig, Frame, Image)


@dataclass
class Records:
    """What a model has, except for its points and keypoints.

    Args:
        cameras: intrinsics.
        rigs: empty in models of COLMAP 3.11 and older.
        frames: empty in these, too.
        images: names and poses.
        num_elements: of the tracks of all points.
        as_colmap: whether COLMAP reads the files in the same way.
    """

    cameras: list[Camera]
    rigs: list[Rig]
    frames: list[Frame]
    images: list[Image]
    num_elements: int
    as_colmap: bool

    def check(self, folder: Path) -> float:
        """Check that the records fit together.

        Args:
            folder: of the model, for messages.

        Returns:
            How far lengths of quaternions are from 1, at most.

        Raises:
            InputError: naming the record that is wrong.
        """
        cameras, images = _by_id(self.cameras), _by_id(self.images, MAX_IMAGE_ID)
        check_names([image.name for image in self.images], folder)
        names: dict[str, Image] = {}
        for image in self.images:
            if image.camera_id not in cameras:
                raise _absent(image.place, "camera", image.camera_id, "cameras")
            if (first := names.setdefault(image.name, image)) is not image:
                raise InputError(
                    f"{image.place}: {image.name} is in the model twice, first at {first.place}. "
                    "Remove one of them."
                )
        for camera_id in {image.camera_id for image in self.images}:
            place, _, camera = cameras[camera_id]
            try:
                check_camera(camera)
            except ValueError as error:
                raise InputError(f"{place}: not a camera ({error}).") from None
        if self.rigs or self.frames:
            self._check_frames(cameras, images)
        return _distance_from_unit(self._poses())

    def _check_frames(self, cameras: dict[int, Camera], images: dict[int, Image]) -> None:
        """Check that rigs, frames, cameras and images fit together."""
        rigs, frame_of = _by_id(self.rigs), dict[int, Frame]()
        is_camera = int(pycolmap.SensorType.CAMERA)
        for rig in self.rigs:
            for kind, sensor_id in rig.sensors:
                if kind == is_camera and sensor_id not in cameras:
                    raise _absent(rig.place, "camera", sensor_id, "cameras")
        for frame in _by_id(self.frames).values():
            if frame.rig_id not in rigs:
                raise _absent(frame.place, "rig", frame.rig_id, "rigs")
            for (kind, sensor_id), data_id in frame.data:
                if kind != is_camera:
                    continue
                if data_id not in images:
                    raise _absent(frame.place, "image", data_id, "images")
                if (other := frame_of.setdefault(data_id, frame)) is not frame:
                    raise InputError(
                        f"{frame.place}: image {data_id} is in two frames, first at {other.place}."
                    )
                image, rig = images[data_id], rigs[frame.rig_id]
                if image.camera_id != sensor_id:
                    raise InputError(
                        f"{frame.place}: image {data_id} belongs to camera {sensor_id} here, but "
                        f"to camera {image.camera_id} at {image.place}."
                    )
                if (kind, sensor_id) not in {*rig.sensors[:1], *rig.poses}:
                    raise InputError(
                        f"{rig.place}: the rig has no camera {sensor_id}, or no pose of it, but "
                        f"image {data_id} belongs to that camera."
                    )
        for image in self.images:
            if image.id not in frame_of:
                raise InputError(
                    f"{image.place}: image {image.id} is in no frame. A model with rigs needs its "
                    "frames file, too."
                )

    def _poses(self) -> Iterable[tuple[str, Pose]]:
        """Yield the poses that count, and where they are."""
        for one in self.frames or self.images:
            yield one.place, one.pose
        for rig in self.rigs:
            for pose in rig.poses.values():
                yield rig.place, pose


def _by_id(records: Iterable[Record], largest: int = MAX_ID) -> dict[int, Record]:
    """Return records by their ids."""
    found: dict[int, Record] = {}
    for record in records:
        if not 0 <= record.id <= largest:
            raise InputError(
                f"{record.place}: the id {record.id} is not from 0 to {largest}. Renumber all."
            )
        if (first := found.setdefault(record.id, record)) is not record:
            raise InputError(
                f"{record.place}: the id {record.id} is used twice, first at {first.place}."
            )
    return found


def _absent(place: str, what: str, its_id: int, part: str) -> InputError:
    """Return the error for a record that names another one that is not there."""
    return InputError(f"{place}: it has {what} {its_id}, which is not among the {part}.")


def _distance_from_unit(poses: Iterable[tuple[str, Pose]]) -> float:
    """Return how far lengths of quaternions are from 1; raise an InputError if poses are none."""
    places, values = zip(*poses, strict=True) if (poses := list(poses)) else ((), ())
    numbers = np.array(values).reshape(-1, 7)
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(numbers[:, :4], axis=1)
    are_rotations = (lengths > MIN_QUATERNION_LENGTH) & (lengths < 1 / MIN_QUATERNION_LENGTH)
    wrong = ~np.isfinite(numbers).all(axis=1) | ~are_rotations
    if wrong.any():
        place = places[int(np.argmax(wrong))]
        raise InputError(
            f"{place}: not a pose: all numbers must be finite, and QW QX QY QZ must not all be 0."
        )
    return float(np.abs(lengths - 1).max(initial=0))
