"""COLMAP databases of a user, read by SQLite: pycolmap would upgrade old ones in place.

Of all versions of COLMAP from 3.0 on: only tables and columns are read that all of them have, and
the type of descriptors where there is one.
"""

import fcntl
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import numpy as np
import pycolmap

from ..cli import InputError
from ..locks import has_locks

MAGIC = b"SQLite format 3\0"
WAL = 2  # the value of the bytes 18 and 19 of a file that has a write-ahead log beside it
LOCK_TIMEOUT_SECONDS = 2.0  # in which another program may release a lock
SIFT = "SIFT"
# COLMAP's types of features; databases of versions before 4 have SIFT only
FEATURE_TYPES = {
    -1: SIFT,
    0: SIFT,
    1: "ALIKED_N16ROT",
    2: "ALIKED_N32",
    3: "LOMA_B",
    4: "LOMA_B128",
}


def log_of(path: Path) -> Path:
    """Return the write-ahead log of a database, which exists while a program writes to it."""
    return path.with_name(f"{path.name}-wal")


class StoredDatabase:
    """A COLMAP database that is open for reading.

    Args:
        path: the file.
        connection: to it.

    Attributes:
        images: id of each image by name.

    Raises:
        InputError: here and in all methods, if the file is broken or not a database of COLMAP.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection):
        self.path, self._connection = path, connection
        self._has_types = any(
            row[1] == "type" for row in self._rows("PRAGMA table_info(descriptors)")
        )
        rows = self._rows(
            "SELECT name, image_id, width, height FROM images JOIN cameras USING (camera_id)"
        )
        self.images: dict[str, int] = {}
        self._sizes: dict[str, tuple[int, int]] = {}
        for name, image_id, width, height in rows:
            self.images[str(name)] = int(image_id)
            self._sizes[str(name)] = int(width), int(height)

    def files(self) -> list[Path]:
        """Return the files of the content: the database, and its log unless that is empty."""
        log = log_of(self.path)
        return [self.path, *([log] if log.exists() and log.stat().st_size else [])]

    def image_size(self, name: str) -> tuple[int, int]:
        """Return the width and height of an image."""
        return self._sizes[name]

    def numbers(self, table: str) -> dict[str, int]:
        """Return the number of "keypoints" or "descriptors" of each image that has any."""
        rows = dict(self._rows(f"SELECT image_id, rows FROM {table} WHERE rows > 0"))
        return {name: rows[i] for name, i in self.images.items() if i in rows}

    def descriptor_type(self) -> str:
        """Return the type of all descriptors, a value of `FEATURE_TYPES`.

        Raises:
            InputError: if there are several types, or an unknown one.
        """
        if not self._has_types:
            return SIFT
        rows = self._rows("SELECT DISTINCT type FROM descriptors WHERE rows > 0")
        found = {FEATURE_TYPES.get(number, f"type {number}") for (number,) in rows} or {SIFT}
        if len(found) > 1:
            raise InputError(
                f"{self.path} has descriptors of several types: {', '.join(sorted(found))}."
            )
        return found.pop()

    def keypoints(self, name: str) -> np.ndarray:
        """Return the keypoints of an image (N, 2, 4 or 6) float32, see `shapes`."""
        found = self._array("keypoints", name, np.float32)
        if found.shape[1] not in (2, 4, 6):
            raise InputError(f"{self.path}: the keypoints of {name} have {found.shape[1]} columns.")
        return found

    def descriptors(self, name: str) -> np.ndarray:
        """Return the descriptors of an image (N, D), bytes: those of floats have four a number."""
        found = self._array("descriptors", name, np.uint8)
        return found if len(found) else np.zeros((0, 128), np.uint8)

    def cameras(self) -> dict[int, pycolmap.Camera]:
        """Return the cameras by their ids, without those of models that pycolmap does not know."""
        found = {}
        asked = "SELECT camera_id, model, width, height, params, prior_focal_length FROM cameras"
        for camera_id, model, width, height, params, is_prior in self._rows(asked):
            with suppress(TypeError, ValueError, RuntimeError):
                found[camera_id] = pycolmap.Camera(
                    camera_id=camera_id,
                    model=pycolmap.CameraModelId(model),
                    width=width,
                    height=height,
                    params=np.frombuffer(params, np.float64),
                    has_prior_focal_length=bool(is_prior),
                )
        return {i: camera for i, camera in found.items() if camera.verify_params()}

    def verified(self) -> dict[tuple[str, str], np.ndarray]:
        """Return the verified matches (M, 2) int of each pair of images that has any."""
        names = {image_id: name for name, image_id in self.images.items()}
        found = {}
        asked = "SELECT pair_id, rows, cols, data FROM two_view_geometries WHERE rows > 0"
        for pair_id, number, width, data in self._rows(asked):
            ids = pycolmap.pair_id_to_image_pair(pair_id)
            if width != 2 or 4 * number * width != len(data or b"") or not names.keys() >= {*ids}:
                raise InputError(
                    f"Cannot read the database {self.path} (the verified matches of the images "
                    f"{ids[0]} and {ids[1]} are broken)."
                )
            first, second = (names[i] for i in ids)
            found[first, second] = np.frombuffer(data, np.uint32).reshape(-1, 2).astype(np.int64)
        return found

    def matched(self) -> list[tuple[str, str]]:
        """Return the pairs of images that were matched, whether they have matches or not.

        COLMAP keeps a row without matches of a pair that has fewer than 15. None are in databases
        whose matches were deleted.
        """
        if not self._rows("SELECT 1 FROM sqlite_master WHERE name = 'matches'"):
            return []
        names = {image_id: name for name, image_id in self.images.items()}
        ids = self._rows("SELECT pair_id FROM matches")
        pairs = [pycolmap.pair_id_to_image_pair(i) for (i,) in ids]
        return [(names[a], names[b]) for a, b in pairs if a in names and b in names]

    def _array(self, table: str, name: str, dtype: type) -> np.ndarray:
        """Return the array of an image in a table; an empty one if there is none."""
        asked = f"SELECT rows, cols, data FROM {table} WHERE image_id = ?"
        rows = self._rows(asked, self.images[name])
        if not rows or not rows[0][0]:
            return np.zeros((0, 2), dtype)
        number, width, data = rows[0]
        if number * width * np.dtype(dtype).itemsize != len(data or b""):
            what = f"the {table} of {name}"
            raise InputError(f"Cannot read the database {self.path} ({what} are truncated).")
        return np.frombuffer(data, dtype).reshape(number, width)

    def _rows(self, asked: str, *values: int) -> list[tuple]:
        with _reading(self.path):
            return self._connection.execute(asked, values).fetchall()


@contextmanager
def open_stored(path: Path) -> Iterator[StoredDatabase]:
    """Open a COLMAP database of a user, which is not changed.

    SQLite may write a -shm file beside one with a write-ahead log that COLMAP left.

    Raises:
        InputError: when it is missing, not a database of COLMAP, or locked by another program.
    """
    if not path.is_file():
        raise InputError(
            f"{path} is a folder: name a COLMAP database in it."
            if path.is_dir()
            else f"There is no COLMAP database {path}."
        )
    with path.open("rb") as file:
        header = file.read(20)
    if header[:16] != MAGIC or len(header) < 20:
        raise InputError(f"{path} is not a COLMAP database: it is not a file of SQLite.")
    # without a log nobody is writing, and an immutable file needs no locks, for which SQLite would
    # create files beside one that may have a log
    alone = WAL in header[18:20] and not log_of(path).exists()
    mode = "immutable=1" if alone else "mode=ro"
    if not has_locks(path, fcntl.lockf):
        mode += "&nolock=1"
    uri = f"{path.resolve().as_uri()}?{mode}"
    with (
        _reading(path),
        closing(sqlite3.connect(uri, uri=True, timeout=LOCK_TIMEOUT_SECONDS)) as connection,
    ):
        yield StoredDatabase(path, connection)


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn errors of SQLite in a block into one that names the file."""
    try:
        yield
    except sqlite3.Error as error:
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF  # without its details
        if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
            raise InputError(
                f"{path} is locked by another program, such as COLMAP: wait until that has ended."
            ) from None
        if "no such" in str(error):
            raise InputError(f"{path} is not a COLMAP database ({error}).") from None
        raise InputError(f"Cannot read the database {path} ({error}).") from None


def shapes(keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the scales in pixels and orientations in degrees of COLMAP's keypoints.

    Args:
        keypoints: (N, 6), x, y and the affine shape by rows; or (N, 4), x, y, scale and orientation
            in radians; or (N, 2), which have neither.

    Returns:
        Both (N,) float32, or None.
    """
    columns = keypoints.T
    if len(columns) == 2:
        return None
    if len(columns) == 4:
        return columns[2], np.rad2deg(columns[3])
    a11, a12, a21, a22 = columns[2:]
    scales = (np.hypot(a11, a21) + np.hypot(a12, a22)) / 2
    return scales, np.rad2deg(np.arctan2(a21, a11))
