"""NVM files of VisualSFM."""

from array import array
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from ..runtime import provenance
from ..utils import colmap
from ..utils.cli import InputError

Lines = Iterator[tuple[int, list[str]]]  # numbers and words


class View(NamedTuple):
    """An image of an NVM file.

    Args:
        name: as it is there.
        focal_length: pixels.
        distortion: the radial one, of measured positions: undistorted is distorted (1 + d r²).
        cam_from_world: its pose.
    """

    name: str
    focal_length: float
    distortion: float
    cam_from_world: pycolmap.Rigid3d


# from an image to its name and camera in a model; None to leave it out
Choose = Callable[[View], tuple[str, pycolmap.Camera] | None]


def views(path: Path) -> list[View]:
    """Return the images of an NVM file.

    Raises:
        InputError: for a broken line.
    """
    with path.open(encoding="utf-8", errors="replace") as file:
        return list(_views(_lines(file), path))


def converted(path: Path, choose: Choose, inputs: list[Path], folder: Path) -> Path:
    """Convert an NVM file into a COLMAP model in `folder`, unless it is there; return the folder.

    Args:
        path: the NVM file.
        choose: the images of the model, see `read`.
        inputs: the files that the model depends on.
        folder: of the model.

    Raises:
        InputError: for a broken file.
    """
    made_from = provenance.of_inputs({}, inputs)
    if not provenance.is_current(folder / provenance.MADE_FROM, made_from):
        (folder / provenance.MADE_FROM).unlink(missing_ok=True)
        colmap.write_model(read(path, choose), folder)
        provenance.write(folder / provenance.MADE_FROM, made_from)
    return folder


def read(path: Path, choose: Choose) -> pycolmap.Reconstruction:
    """Read an NVM file.

    Args:
        path: of the format NVM_V3: lines `name focal qw qx qy qz cx cy cz distortion 0` of images,
            with the rotation camera from world and the centre of the camera, and lines
            `x y z r g b number` of points, each followed by `image keypoint x y` of every image
            that sees the point. Of these, the order in an image is not kept.
        choose: returns the name and the camera of an image.

    Raises:
        InputError: for a broken line.
    """
    model = pycolmap.Reconstruction()
    # arrays, as Aachen has ten million observations
    points, colours, observed, numbers = array("d"), array("B"), array("i"), array("i")
    with path.open(encoding="utf-8", errors="replace") as file:
        lines = _lines(file)
        found = list(_views(lines, path))
        chosen = [choose(view) for view in found]
        keypoints = [array("d") for _ in found]
        for xyz, colour, seen in _points(lines, path, [one is not None for one in chosen]):
            points.extend(xyz)
            colours.extend(colour)
            numbers.append(len(seen))
            observed.extend(seen)
            for index, xy in seen.items():
                keypoints[index].extend(xy)
    for image_id, (view, one) in enumerate(zip(found, chosen, strict=True), 1):
        if one is None:
            continue
        name, camera = one
        camera.camera_id = image_id
        pixels = np.array(keypoints[image_id - 1]).reshape(-1, 2)
        image = pycolmap.Image(name, pixels, camera_id=image_id, image_id=image_id)
        colmap.add_image(model, camera, image, view.cam_from_world)
    images, next_keypoint = iter(observed), [0] * len(found)
    positions = zip(np.reshape(points, (-1, 3)), np.reshape(colours, (-1, 3)), strict=True)
    for number, (xyz, colour) in zip(numbers, positions, strict=True):
        track = pycolmap.Track()
        for index in islice(images, number):
            track.add_element(index + 1, next_keypoint[index])
            next_keypoint[index] += 1
        model.add_point3D(xyz, track, colour)
    return model


def _lines(file: Iterator[str]) -> Lines:
    """Yield the lines that are not empty, after the header."""
    for number, line in enumerate(file, 1):
        if (words := line.split()) and words[0] != "NVM_V3":
            yield number, words


def _views(lines: Lines, path: Path) -> Iterator[View]:
    """Yield the images."""
    for number, words in _counted(lines, path):
        try:
            focal_length, w, x, y, z, *centre, distortion = _floats(words[1:10])
            rotation = pycolmap.Rotation3d(np.array([x, y, z, w]))
            rotation.normalize()
            translation = -(rotation.matrix() @ np.reshape(centre, 3))
        except ValueError:
            raise _wrong(path, number, "an image") from None
        pose = pycolmap.Rigid3d(rotation, translation)
        yield View(words[0], float(focal_length), float(distortion), pose)


def _points(
    lines: Lines, path: Path, is_chosen: list[bool]
) -> Iterator[tuple[np.ndarray, np.ndarray, dict[int, list[float]]]]:
    """Yield position (3,), colour (3,) uint8, and keypoint by chosen image of each point."""
    known = {index for index, chosen in enumerate(is_chosen) if chosen}
    for number, words in _counted(lines, path):
        try:
            values = _floats(words[: 7 + 4 * int(words[6])])
            found = values[7:].reshape(-1, 4)
        except (ValueError, IndexError):
            raise _wrong(path, number, "a point") from None
        seen = {int(image): xy for image, _, *xy in found.tolist() if image in known}
        if len(seen) > 1:
            yield values[:3], values[3:6].clip(0, 255).astype(np.uint8), seen


def _counted(lines: Lines, path: Path) -> Lines:
    """Yield as many lines as the first one says."""
    number, words = next(lines, (0, [""]))
    if not words[0].isdecimal():
        raise _wrong(path, number, "a number of lines")
    for left in range(int(words[0]), 0, -1):
        if (line := next(lines, None)) is None:
            raise InputError(f"{path} ends early: {left} lines are missing.")
        yield line


def _floats(words: list[str]) -> np.ndarray:
    values = np.array(words, float)
    if not np.isfinite(values).all():
        raise ValueError
    return values


def _wrong(path: Path, number: int, what: str) -> InputError:
    return InputError(f"{path}:{number}: not {what} of an NVM_V3 file.")
