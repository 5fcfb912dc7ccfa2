"""Aachen Day-Night v1.0, whose model is an NVM file of VisualSFM."""

from array import array
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import ClassVar

import numpy as np
import pycolmap

from ..runtime import provenance
from ..utils import colmap
from ..utils.cli import InputError
from ..utils.parsers import parse_query_list
from . import SOURCE
from .aachen import MODEL_FOLDER, Aachen

NVM = "3D-models/aachen_cvpr2018_db.nvm"
INTRINSICS = "3D-models/database_intrinsics.txt"
Lines = Iterator[tuple[int, list[str]]]  # numbers and words


class AachenV1(Aachen):
    """Aachen Day-Night v1.0, or any place in its layout: as v1.1, but for the model.

    The database of hloc's converter is not needed.
    """

    results: ClassVar[str] = "Aachen"
    source: ClassVar[str] = f"{SOURCE} (Aachen Day-Night)."

    def _missing_model(self) -> list[Path]:
        return [path for path in (self.nvm, self.intrinsics) if not path.is_file()]

    @classmethod
    def recognizes(cls, root: Path) -> bool:
        """Tell whether a folder has the NVM file, and not the model of v1.1, too."""
        return (root / NVM).is_file() and not (root / MODEL_FOLDER).exists()

    @property
    def nvm(self) -> Path:
        """The model of the map images."""
        return self.root / NVM

    @property
    def intrinsics(self) -> Path:
        """The intrinsics of the map images, in a list as that of queries."""
        return self.root / INTRINSICS

    def map_names(self) -> list[str]:
        """Read the names of the map images."""
        with self.nvm.open(encoding="utf-8", errors="replace") as file:
            return sorted(name for name, _ in _poses(_lines(file), self.nvm))

    def reference(self, folder: Path) -> Path:
        """Convert the model into a COLMAP model in `folder`, unless it is there; return the folder.

        Raises:
            InputError: for a broken file.
        """
        made_from = provenance.of_inputs({}, [self.nvm, self.intrinsics])
        if not provenance.is_current(folder / provenance.MADE_FROM, made_from):
            (folder / provenance.MADE_FROM).unlink(missing_ok=True)
            colmap.write_model(read_nvm(self.nvm, self.intrinsics), folder)
            provenance.write(folder / provenance.MADE_FROM, made_from)
        return folder


def read_nvm(path: Path, intrinsics: Path) -> pycolmap.Reconstruction:
    """Read an NVM file with the intrinsics of its images.

    Args:
        path: of the format NVM_V3: lines `name focal qw qx qy qz cx cy cz distortion 0` of images,
            with the rotation camera from world and the centre of the camera, and lines
            `x y z r g b number` of points, each followed by `image keypoint x y` of every image
            that sees the point. Of these, the order in an image is not kept.
        intrinsics: list of names and cameras.

    Raises:
        InputError: for a broken line, or an image without intrinsics.
    """
    cameras = dict(parse_query_list(intrinsics))
    # arrays, as Aachen has ten million observations
    points, colours, observed, numbers = array("d"), array("B"), array("i"), array("i")
    with path.open(encoding="utf-8", errors="replace") as file:
        lines = _lines(file)
        poses = list(_poses(lines, path))
        keypoints = [array("d") for _ in poses]
        for xyz, colour, seen in _points(lines, path, len(poses)):
            points.extend(xyz)
            colours.extend(colour)
            numbers.append(len(seen))
            observed.extend(seen)
            for index, xy in seen.items():
                keypoints[index].extend(xy)
    model = pycolmap.Reconstruction()
    for image_id, (name, pose) in enumerate(poses, 1):
        if name not in cameras:
            raise InputError(f"{intrinsics} lacks {name}, which is in {path.name}.")
        camera = cameras[name]
        camera.camera_id = image_id
        pixels = np.array(keypoints[image_id - 1]).reshape(-1, 2)
        image = pycolmap.Image(name, pixels, camera_id=image_id, image_id=image_id)
        colmap.add_image(model, camera, image, pose)
    images, next_keypoint = iter(observed), [0] * len(poses)
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


def _poses(lines: Lines, path: Path) -> Iterator[tuple[str, pycolmap.Rigid3d]]:
    """Yield the name and the pose, camera from world, of each image."""
    for number, words in _counted(lines, path):
        try:
            name, _, *values = words[:9]
            w, x, y, z, *centre = _floats(values)
            rotation = pycolmap.Rotation3d(np.array([x, y, z, w]))
            rotation.normalize()
            translation = -(rotation.matrix() @ np.reshape(centre, 3))
        except ValueError:
            raise _wrong(path, number, "an image") from None
        yield name, pycolmap.Rigid3d(rotation, translation)


def _points(
    lines: Lines, path: Path, num_images: int
) -> Iterator[tuple[np.ndarray, np.ndarray, dict[int, list[float]]]]:
    """Yield position (3,), colour (3,) uint8, and keypoint by image of each point."""
    for number, words in _counted(lines, path):
        try:
            values = _floats(words[: 7 + 4 * int(words[6])])
            found = values[7:].reshape(-1, 4)
        except (ValueError, IndexError):
            raise _wrong(path, number, "a point") from None
        seen = {int(image): xy for image, _, *xy in found.tolist() if 0 <= image < num_images}
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
