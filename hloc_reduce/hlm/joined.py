"""Several compact maps of one place as one map."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from ..localization import intrinsics
from ..utils.cli import InputError
from .points import Coordinates
from .reader import CompactMap

# what the files of one map have in common, and what messages call it
SAME = {"feature": "feature", "conf": "configuration of the feature", "matcher": "matcher"}
SAME |= {"retrieval": "retrieval", "projection": "projection", "frame": "frame"}


class JoinedNames(Sequence[str]):
    """The names of images with that of their file in front.

    Args:
        parts: the names in each file, by the name of the file.
    """

    def __init__(self, parts: dict[str, Sequence[str]]):
        self._parts = [*parts.items()]
        self._ends = np.cumsum([len(names) for names in parts.values()])

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __getitem__(self, row):  # type: ignore[no-untyped-def]
        """Return the name of a row, or the names (list) of a slice."""
        if isinstance(row, slice):
            return [self[i] for i in range(*row.indices(len(self)))]
        row = range(len(self))[row]
        number = int(np.searchsorted(self._ends, row, side="right"))
        file, names = self._parts[number]
        return f"{file}/{names[row - int(self._ends[number])]}"

    def __iter__(self) -> Iterator[str]:
        for file, names in self._parts:
            yield from (f"{file}/{name}" for name in names)


class JoinedPoints(Coordinates):
    """The coordinates of the points of several maps, numbered one map after the other.

    Args:
        parts: the maps.
    """

    def __init__(self, parts: Sequence[CompactMap]):
        self._parts = [part.points for part in parts]
        self.ends = np.cumsum([len(points) for points in self._parts])

    def __len__(self) -> int:
        return int(self.ends[-1])

    def split(self, points: np.ndarray) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """Return the index of each map with some of the points, which these are, and its own."""
        of_map = np.searchsorted(self.ends, points, side="right")
        starts = np.concatenate([[0], self.ends])
        used = [(i, np.flatnonzero(of_map == i)) for i in np.unique(of_map).tolist()]
        return [(i, rows, points[rows] - starts[i]) for i, rows in used]

    def __getitem__(self, points: np.ndarray) -> np.ndarray:
        """Return the coordinates (K, 3) float64 of points (K,)."""
        found = np.empty((len(points), 3))
        for i, rows, own in self.split(points):
            found[rows] = self._parts[i][own]
        return found

    def all(self) -> np.ndarray:
        """Return the coordinates (P, 3) float64 of all points."""
        return np.concatenate([part.all() for part in self._parts])


class JoinedMap(CompactMap):
    """Several compact maps as one: images of all are retrieved together.

    The name of an image begins with that of its file, without its suffix.

    Args:
        paths: the files.

    Raises:
        InputError: when they do not belong together; and as `CompactMap` does.
    """

    def __init__(self, paths: Sequence[Path]):
        self.path, parts = paths[0], [CompactMap(path) for path in paths]
        self._parts = {part.path.stem: part for part in parts}
        if len(self._parts) < len(parts):
            raise InputError(f"Files of one map need different names: {_listed(paths)}.")
        first = parts[0]
        for other in parts[1:]:
            _check(first, other)
        for name in (*SAME, "storage", "dim", "vocabulary", "made_from", "_key", "_attrs"):
            setattr(self, name, getattr(first, name))
        self._suffix = getattr(first, "_suffix", None)
        turns = {part._turns for part in parts}
        self._turns = turns.pop() if len(turns) == 1 else 0
        self.cameras = first.cameras
        for other in parts[1:]:
            self.cameras = intrinsics.merged(self.cameras, other.cameras)
        self.doubts = [*dict.fromkeys(doubt for part in parts for doubt in part.doubts)]
        self.names = JoinedNames({file: part.names for file, part in self._parts.items()})
        self.points = self._points = JoinedPoints(parts)

    def _find(self, name: str) -> tuple[int, CompactMap, str]:
        """Return the index of the file of an image, the file, and its name there."""
        file, _, own = name.partition("/")
        if file not in self._parts:
            raise InputError(f"No file of the map has the image {name}.")
        return [*self._parts].index(file), self._parts[file], own

    def __contains__(self, name: str) -> bool:
        file, _, own = name.partition("/")
        return file in self._parts and own in self._parts[file]

    def visible(self, name: str) -> np.ndarray:
        """Return the points (M,) int64 that an image shows, ascending."""
        i, part, own = self._find(name)
        return part.visible(own) + int(self._points.ends[i]) - len(part.points)

    def camera_number(self, name: str) -> int:
        """Return the number of the camera of an image."""
        i, part, own = self._find(name)
        before = [other.num_cameras for other in self._parts.values()][:i]
        return sum(before) + part.camera_number(own)

    def camera(self, name: str) -> pycolmap.Camera:
        """Return the intrinsics of an image."""
        _, part, own = self._find(name)
        return part.camera(own)

    def pose(self, name: str) -> pycolmap.Rigid3d:
        """Return the pose of an image, camera from world."""
        _, part, own = self._find(name)
        return part.pose(own)

    def views(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions (I, 3) and the optical axes (I, 3) of all images."""
        positions, axes = zip(*(part.views() for part in self._parts.values()), strict=True)
        return np.concatenate(positions), np.concatenate(axes)

    def global_descriptors(self) -> np.ndarray:
        """Return those of the images (I, G) float32, see `CompactMap.global_descriptors`."""
        return np.concatenate([part.global_descriptors() for part in self._parts.values()])

    def retrieve(self, descriptor: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Find the images that are most similar to a photo, see `CompactMap.retrieve`."""
        found, start = [], 0
        for part in self._parts.values():
            rows, similarity = part.retrieve(descriptor, number)
            found.append((rows + start, similarity))
            start += len(part.names)
        rows, similarity = (np.concatenate(values) for values in zip(*found, strict=True))
        best = np.argsort(-similarity, kind="stable")[:number]
        return rows[best], similarity[best]

    def _stored(self, points: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, dict]]:
        parts, found = [*self._parts.values()], None
        for i, rows, own in self._points.split(points):
            [stored] = parts[i]._stored(own)[0].values()
            if found is None:
                found = np.empty((len(stored), len(points)), stored.dtype)
            found[:, rows] = stored
        if found is None:
            return parts[0]._stored(points)
        return {self._key: found}, {self._key: self._attrs}

    def check_names(self) -> None:
        """Refuse images of the same name, see `CompactMap.check_names`."""
        for part in self._parts.values():
            part.check_names()


def opened(paths: Path | Sequence[Path]) -> CompactMap:
    """Open a compact map of one file or several.

    Raises:
        InputError: as `CompactMap` and `JoinedMap` do.
    """
    if isinstance(paths, Path):
        return CompactMap(paths)
    return CompactMap(paths[0]) if len(paths) == 1 else JoinedMap(paths)


def _check(first: CompactMap, other: CompactMap) -> None:
    """Raise an InputError for files that are not of one map."""
    both = _listed([first.path, other.path])
    for name, called in SAME.items():
        if getattr(first, name) != getattr(other, name):
            raise InputError(f"{both} are not of one map: they differ in the {called}.")
    attrs = first._attrs, other._attrs
    alike = first.storage == other.storage and attrs[0].keys() == attrs[1].keys()
    if not (alike and all(np.array_equal(attrs[0][key], attrs[1][key]) for key in attrs[0])):
        raise InputError(f"{both} are not of one map: they store descriptors differently.")
    if not np.array_equal(_words(first), _words(other)):
        raise InputError(
            f"{both} have different vocabularies of global descriptors: write parts of one map, "
            "with --image_list and the same --max_mb."
        )
    told = first.made_from is not None and first.made_from == other.made_from
    if first.frame.origin is None and not told:
        raise InputError(
            f"{both} may have different frames: they have no common place on Earth, and do not say "
            "that they are parts of one map."
        )


def _words(part: CompactMap) -> np.ndarray:
    """Return the vocabulary of a map, which is empty if it has none."""
    return np.zeros((0, 0), np.float32) if part.vocabulary is None else part.vocabulary


def _listed(paths: Sequence[Path]) -> str:
    """Return paths as words."""
    return " and ".join(map(str, paths))
