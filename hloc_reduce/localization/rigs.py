"""Rigs of cameras that are fixed to each other, as COLMAP's files describe them."""

import copy
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from .. import logger
from ..utils import cli
from ..utils.cli import InputError
from ..utils.parsers import check_camera

LENGTHS = {"cam_from_rig_rotation": 4, "cam_from_rig_translation": 3}
NOT_UNIT = 0.01  # a quaternion's length may differ from 1 by rounding

# from frame, the photos that a rig took at one moment, to its photos and their poses in the rig
Frames = Mapping[str, Mapping[str, pycolmap.Rigid3d]]


class RigCamera(NamedTuple):
    """A camera of a rig.

    Args:
        prefix: what the names of its photos begin with.
        cam_from_rig: its pose in the rig.
        camera: intrinsics without a size, None if the file has none.
    """

    prefix: str
    cam_from_rig: pycolmap.Rigid3d
    camera: pycolmap.Camera | None


def read(path: Path) -> list[list[RigCamera]]:
    """Read COLMAP's `rig_config.json`; the reference camera of each rig comes first.

    Raises:
        InputError: if it is missing or broken, or a camera has no pose, or one that is no motion.
    """
    if not path.is_file():
        raise InputError(f"{path} is missing.")
    _check_lengths(path)
    try:
        found = pycolmap.read_rig_config(str(path))
        rigs = [sorted(one.cameras, key=lambda camera: not camera.ref_sensor) for one in found]
    except (RuntimeError, ValueError) as error:
        reason = str(error).replace(f"{path}", "").strip(": ")
        raise InputError(f"{path} is not a rig configuration of COLMAP: {reason}.") from None
    if not any(rigs):
        raise InputError(f"{path} has no rig.")
    prefixes = [camera.image_prefix for rig in rigs for camera in rig]
    if twice := {prefix for prefix in prefixes if prefixes.count(prefix) > 1}:
        raise InputError(f"{path}: several cameras have the image_prefix {min(twice)}.")
    return [[_camera(camera, path) for camera in rig] for rig in rigs]


def _check_lengths(path: Path) -> None:
    """Raise an InputError for poses of too few or too many numbers, which pycolmap does not count.

    What else is wrong with a file, it says.
    """
    try:
        given = [camera for rig in json.loads(path.read_text()) for camera in rig["cameras"]]
        wrong = [
            (camera["image_prefix"], key, number)
            for camera in given
            for key, number in LENGTHS.items()
            if key in camera and len(camera[key]) != number
        ]
    except (ValueError, TypeError, KeyError, AttributeError):
        return
    for prefix, key, number in wrong:
        raise InputError(f"{path}: the {key} of {prefix} has not {number} numbers.")


def _camera(camera: pycolmap.RigConfigCamera, path: Path) -> RigCamera:
    """Check a camera of a file."""
    pose, prefix = camera.cam_from_rig, camera.image_prefix
    if camera.ref_sensor:
        pose = pycolmap.Rigid3d()
    if pose is None:
        raise InputError(
            f"{path}: the camera {prefix} has no cam_from_rig_rotation and no "
            "cam_from_rig_translation."
        )
    length = np.linalg.norm(pose.rotation.quat)
    if not abs(length - 1) <= NOT_UNIT:
        raise InputError(
            f"{path}: the cam_from_rig_rotation of {prefix} is no unit quaternion w, x, y, z: its "
            f"length is {length:.3g}."
        )
    if not np.isfinite(pose.translation).all():
        raise InputError(f"{path}: the cam_from_rig_translation of {prefix} is not finite.")
    rotation = pycolmap.Rotation3d(pose.rotation.quat / length)
    return RigCamera(prefix, pycolmap.Rigid3d(rotation, pose.translation), camera.camera)


def have_baseline(path: Path) -> bool:
    """Tell whether cameras of a rig configuration are apart, so that they tell a scale."""
    return any(camera.cam_from_rig.translation.any() for rig in read(path) for camera in rig)


def cameras_of(path: Path, names: Iterable[str]) -> dict[str, RigCamera]:
    """Return which camera of a rig configuration took each photo, of those that any took.

    Raises:
        InputError: if the file is wrong, or two cameras may have taken a photo, or none any.
    """
    rigs, found = read(path), {}
    names = list(names)
    for name in names:
        took = [camera for rig in rigs for camera in rig if name.startswith(camera.prefix)]
        if len(took) > 1:
            which = " and ".join(camera.prefix for camera in took)
            raise InputError(f"{path}: {name} is a photo of two cameras, {which}.")
        if took:
            found[name] = took[0]
    prefixes = [camera.prefix for rig in rigs for camera in rig]
    if not found:
        raise InputError(
            f"{path}: no photo is of a camera of a rig; their names begin with "
            f"{cli.some(prefixes)}, not as {names[0] if names else 'none'}."
        )
    return found


def are_of(path: Path, names: Iterable[str]) -> bool:
    """Tell whether a camera of a rig configuration took any photo; raise as `read`."""
    prefixes = tuple(camera.prefix for rig in read(path) for camera in rig)
    return any(name.startswith(prefixes) for name in names)


def of_rig(
    path: Path, inferred: Mapping[str, tuple[pycolmap.Camera, str]]
) -> dict[str, tuple[pycolmap.Camera, str]]:
    """Return the intrinsics of photos that a rig configuration tells, as `intrinsics.infer` does.

    Args:
        path: the file.
        inferred: of each photo a camera of its size.

    Raises:
        InputError: for parameters that are no camera's.
    """
    found = {}
    for name, took in cameras_of(path, inferred).items():
        if took.camera is not None:
            camera = copy.deepcopy(took.camera)
            camera.width, camera.height = inferred[name][0].width, inferred[name][0].height
            try:
                if not camera.verify_params():
                    raise ValueError(f"{camera.model.name} has {camera.params_info}")
                check_camera(camera)
            except ValueError as error:
                raise InputError(f"{path}: camera_params of {took.prefix}: {error}.") from None
            found[name] = camera, "rig"
    return found


def frames(path: Path, names: Iterable[str]) -> dict[str, dict[str, pycolmap.Rigid3d]]:
    """Return the frames of a rig configuration that have several photos, see `Frames`.

    Photos of a frame have the same name after the prefixes of their cameras. A frame is called as
    the photo of the reference camera, whether that is there or not.

    Raises:
        InputError: if the file is wrong, or no two photos are of one frame.
    """
    first = {camera.prefix: rig[0].prefix for rig in read(path) for camera in rig}
    found: dict[str, dict[str, pycolmap.Rigid3d]] = {}
    took = cameras_of(path, names)
    if took_none := first.keys() - {camera.prefix for camera in took.values()}:
        logger.warning("No photo is of the cameras %s of %s.", cli.some(sorted(took_none)), path)
    for name, camera in took.items():
        frame = first[camera.prefix] + name.removeprefix(camera.prefix)
        found.setdefault(frame, {})[name] = camera.cam_from_rig
    several = {frame: photos for frame, photos in found.items() if len(photos) > 1}
    if not several:
        example = next(iter(found))
        raise InputError(
            f"{path}: no two photos were taken at one moment: photos of a moment have the same "
            f"name in the folders of their cameras, as {example}."
        )
    return several


def know_all(path: Path, names: Iterable[str]) -> bool:
    """Tell whether a rig configuration has the intrinsics of all photos."""
    took = cameras_of(path, names := [*names])
    return all(name in took and took[name].camera is not None for name in names)


def configurations(path: Path, names: Iterable[str]) -> list[pycolmap.RigConfig]:
    """Return the rigs of a rig configuration as pycolmap takes them, without intrinsics.

    Cameras that took none of the photos, and rigs of a single camera, are left out.

    Raises:
        InputError: as `cameras_of`, or if the reference camera of a rig took none.
    """
    prefixes = {camera.prefix for camera in cameras_of(path, names).values()}
    found = []
    for rig in read(path):
        some = [camera for camera in rig if camera.prefix in prefixes]
        if some and some[0] is not rig[0]:
            raise InputError(
                f"{path}: no photo is of {rig[0].prefix}, the reference camera of {some[0].prefix}."
            )
        cameras = [
            pycolmap.RigConfigCamera(
                ref_sensor=camera is rig[0],
                image_prefix=camera.prefix,
                cam_from_rig=None if camera is rig[0] else camera.cam_from_rig,
            )
            for camera in some
        ]
        found += [pycolmap.RigConfig(cameras=cameras)] if len(cameras) > 1 else []
    return found


def written(rigs: Frames) -> dict[str, dict[str, list[float]]]:
    """Return frames as JSON has them, with the poses as (3, 4) matrices in rows."""
    return {
        frame: {name: pose.matrix().ravel().tolist() for name, pose in poses.items()}
        for frame, poses in rigs.items()
    }
