"""Images and h5 files, and how files are written so that a killed run loses little."""

import csv
import fcntl
import filecmp
import os
import platform
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import h5py
import numpy as np

from . import logger
from .cli import InputError

LOCK = ".lock"  # in an outputs folder


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path` and move it into place when the block succeeds.

    A file that is replaced by an equal one keeps its time, so that nothing is made anew of it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        filecmp.clear_cache()  # which goes by sizes and times
        if path.exists() and filecmp.cmp(temporary, path, shallow=False):
            shutil.copystat(path, temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


class Lock:
    """A folder that no other run may write to.

    The lock is the system's, which ends with the process however that ends.

    Args:
        folder: made if need be.

    Raises:
        InputError: when another run has it.
    """

    def __init__(self, folder: Path):
        folder.mkdir(parents=True, exist_ok=True)
        self.file = None
        if not os.access(folder, os.W_OK):  # then nobody writes to it
            return
        self.file = (folder / LOCK).open("a+")
        try:
            fcntl.flock(self.file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.file.seek(0)
            who = self.file.read()
            self.file.close()
            raise InputError(f"Another run is at work in {folder} ({who}).") from None
        except OSError as error:
            logger.warning("%s cannot be locked (%s): start no second run in it.", folder, error)
        self.file.truncate(0)
        self.file.write(f"process {os.getpid()} on {platform.node()}")
        self.file.flush()

    def release(self) -> None:
        """Let others have it."""
        if self.file is not None:
            self.file.close()


def write_csv(rows: list[dict], path: Path, columns: Iterable[str] = ()) -> None:
    """Write rows that have the same keys, the columns; None is empty.

    Where there may be no row, `columns` names them.
    """
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(columns) or list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def read_image(path: Path, grayscale: bool = False) -> np.ndarray:
    """Read an image as uint8, (H, W) or (H, W, 3) RGB, without applying EXIF's rotation.

    Raises:
        InputError: when the file is no image that OpenCV can read.
    """
    mode = cv2.IMREAD_GRAYSCALE if grayscale else cv2.IMREAD_COLOR
    data = np.fromfile(path, np.uint8) if path.is_file() else np.empty(0, np.uint8)
    image = cv2.imdecode(data, mode | cv2.IMREAD_IGNORE_ORIENTATION) if data.size else None
    if image is None:
        raise InputError(f"Cannot read image {path}.")
    return image if grayscale else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


@contextmanager
def open_h5(path: Path) -> Iterator[h5py.File]:
    """Open an h5 file for reading; one that is absent or broken raises an InputError."""
    try:
        file = h5py.File(path, "r", libver="latest")
    except OSError as error:
        reason = "it is not there" if not path.exists() else "not a whole h5 file"
        raise InputError(f"Cannot open {path}: {reason}.") from error
    with file:
        yield file


def list_h5_names(path: Path) -> list[str]:
    """List the groups of an h5 file that hold data sets, in the order of their names."""
    with open_h5(path) as file:
        return list(iterate_h5_names(file.id))


def iterate_h5_names(group: h5py.h5g.GroupID, prefix: str = "") -> Iterator[str]:
    """Yield the groups below a group that hold data sets, in the order of their names.

    Reads one group at a time: HDF5's own visit of all groups keeps all in memory. Only what the
    file itself holds counts, not links to elsewhere.

    Raises:
        InputError: when a group has several names, and so could be in itself.
    """
    names = []

    def gather(name: bytes, link: h5py.h5l.LinkInfo) -> None:
        if link.type == h5py.h5l.TYPE_HARD:
            names.append(name)

    group.links.iterate(gather, info=True)
    holds_data = False
    for name in names:
        child = h5py.h5o.get_info(group, name)
        if child.type == h5py.h5o.TYPE_GROUP:
            path = f"{prefix}{name.decode()}"
            if child.rc > 1:
                file = h5py.h5f.get_name(group).decode()
                raise InputError(f"{file}: the group {path} has another name, too; copy the file.")
            yield from iterate_h5_names(h5py.h5g.open(group, name), f"{path}/")
        elif not holds_data:
            holds_data = True
            yield prefix[:-1]


def get_dataset(file: h5py.File, name: str, key: str) -> h5py.Dataset:
    """Return a data set of an image or a pair in an open h5 file, or raise an InputError."""
    if name not in file:
        raise InputError(f"{name} is not in the file {file.filename}.")
    if key not in file[name]:
        raise InputError(f"{file.filename} is not a file of {key}: {name} has none.")
    return file[name][key]


def provenance(file: h5py.File) -> str:
    """Return what tells an open h5 file from others: what made it and when, or its name."""
    conf = file.attrs.get("conf", Path(file.filename).name)
    return f"{conf} {file.attrs.get('id', '')}".strip()


def get_keypoints(file: h5py.File, name: str) -> tuple[np.ndarray, float]:
    """Read keypoints (N, 2) float64, pixel centres at integers, and their uncertainty in pixels."""
    dataset = get_dataset(file, name, "keypoints")
    return dataset[:, :2].astype(np.float64), float(dataset.attrs.get("uncertainty", 1.0))


def get_colmap_keypoints(file: h5py.File, name: str) -> tuple[np.ndarray, float]:
    """Read keypoints as `get_keypoints` does, with COLMAP's pixel origin."""
    keypoints, uncertainty = get_keypoints(file, name)
    return to_colmap(keypoints), uncertainty


def to_colmap(keypoints: np.ndarray) -> np.ndarray:
    """Move keypoints (N, 2), pixel centres at integers, to COLMAP's pixel origin, the corner.

    The only place where the half pixel is added.
    """
    return keypoints.astype(np.float64) + 0.5


def names_to_pair(name0: str, name1: str, separator: str = "/") -> str:
    """Return the name of a pair's group in a match file."""
    return separator.join((name0.replace("/", "-"), name1.replace("/", "-")))


def find_pair(file: h5py.File, name0: str, name1: str) -> tuple[str | None, bool]:
    """Return the group of a pair in an open match file (None if absent) and if it is reversed."""
    for separator in "/_":  # the second is hloc's old format
        for reverse in (False, True):
            names = (name1, name0) if reverse else (name0, name1)
            pair = names_to_pair(*names, separator)
            if pair in file:
                return pair, reverse
    return None, False


def get_matches(file: h5py.File, name0: str, name1: str) -> tuple[np.ndarray, np.ndarray]:
    """Read the matches of a pair, stored in either order.

    Returns:
        matches (M, 2) int64, indices of the keypoints of name0 and name1, and scores (M,).

    Raises:
        InputError: when the pair was not matched.
    """
    pair, reverse = find_pair(file, name0, name1)
    if pair is None:
        raise InputError(f"The pair {name0}, {name1} is not in the match file {file.filename}.")
    matches0 = get_dataset(file, pair, "matches0")[()]
    matched = np.flatnonzero(matches0 != -1)
    matches = np.stack([matched, matches0[matched].astype(np.int64)], -1)
    scores = get_dataset(file, pair, "matching_scores0")[()][matched]
    return (matches[:, ::-1] if reverse else matches), scores


def check_matches(matches: np.ndarray, names: tuple[str, str], sizes: tuple[int, int]) -> None:
    """Raise an InputError if matches (M, 2) refer to keypoints that images do not have."""
    if len(matches) and matches.min() < 0:
        raise InputError(
            f"The matches of {names[0]}, {names[1]} are negative, as hloc's are that have more "
            "than 32,767 keypoints: match these anew."
        )
    for column, (name, size) in enumerate(zip(names, sizes, strict=True)):
        if len(matches) and matches[:, column].max() >= size:
            raise InputError(
                f"The matches of {names[0]}, {names[1]} were made of other features: "
                f"{name} has {size} keypoints only."
            )
