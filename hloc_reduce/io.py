"""Images and h5 files, and how files are written so that a killed run loses little."""

import csv
import fcntl
import filecmp
import io
import json
import os
import platform
import shutil
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import h5py
import numpy as np

from . import logger
from .cli import InputError
from .interrupts import uninterrupted

MOST_COMPRESSED = 2000  # times what an h5 file holds is more than gzip can pack into it
LOCK = ".lock"  # in an outputs folder


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path` and move it into place when the block succeeds.

    A file that is replaced by an equal one keeps its time, so that nothing is made anew of it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with naming(path):
            yield temporary
        filecmp.clear_cache()  # which goes by sizes and times
        if path.exists() and filecmp.cmp(temporary, path, shallow=False):
            shutil.copystat(path, temporary)
        with temporary.open("rb") as file:
            os.fsync(file.fileno())  # else a power cut may leave an empty file
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Have an error of the system that names no file, as that of a full disk, name this one."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


class UnreadableImage(InputError):
    """A file that is not there, or no image that can be read."""


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
        for left in folder.glob(".*.tmp"):  # by a killed run: only who has the lock makes these
            shutil.rmtree(left) if left.is_dir() else left.unlink()
        with suppress(OSError):  # of a full disk: it is locked all the same
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
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(columns) or list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def read_image(path: Path, grayscale: bool = False) -> np.ndarray:
    """Read an image as uint8, (H, W) or (H, W, 3) RGB, without applying EXIF's rotation.

    Raises:
        UnreadableImage: when the file is no image that OpenCV can read.
    """
    mode = cv2.IMREAD_GRAYSCALE if grayscale else cv2.IMREAD_COLOR
    try:
        data = np.fromfile(path, np.uint8)
        image = cv2.imdecode(data, mode | cv2.IMREAD_IGNORE_ORIENTATION) if data.size else None
        reason = "it is not an image, or it is truncated" if data.size else "it is empty"
    except OSError as error:
        image, reason = None, error.strerror
    except cv2.error as error:
        image, reason = None, f"OpenCV says that not {error.err}"
    if image is None:
        raise UnreadableImage(f"Cannot read image {path}: {reason}.")
    return image if grayscale else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


@contextmanager
def open_h5(path: Path) -> Iterator[h5py.File]:
    """Open an h5 file for reading; one that is absent or broken raises an InputError."""
    try:
        file = h5py.File(path, "r", libver="latest")
    except Exception as error:
        if not _is_of_h5py(error):
            raise
        reason = "it is not there" if not path.exists() else "not a whole h5 file"
        raise InputError(f"Cannot open {path}: {reason}.") from error
    with file, reading(path):
        yield file


@contextmanager
def reading(path: Path | str) -> Iterator[None]:
    """Have an error of h5py, which may be of any kind if the file is damaged, name the file.

    Raises:
        InputError: in its place.
    """
    try:
        yield
    except Exception as error:
        if not _is_of_h5py(error):
            raise
        raise InputError(f"Cannot read {path}: it is corrupted ({_first_line(error)}).") from error


def _is_of_h5py(error: Exception) -> bool:
    """Tell whether h5py raised an error, but for a name that is not in a file."""
    if isinstance(error, KeyError) and "doesn't exist" in str(error):
        return False
    *_, last = traceback.walk_tb(error.__traceback__)
    return "h5py" in Path(last[0].f_code.co_filename).parts


def _first_line(error: Exception) -> str:
    return next(iter(str(error).strip("'\"").splitlines()), type(error).__name__)


@contextmanager
def write_h5(path: Path) -> Iterator[h5py.File]:
    """Open an h5 file, or a new one, to add to it; Ctrl-C waits until the block ends.

    Raises:
        OSError: after the block, when the disk is full; HDF5 itself would crash.
    """
    modes = ("r+b", "r+") if path.exists() else ("w+b", "w")
    with uninterrupted(), path.open(modes[0], buffering=0) as file:
        disk = _Disk(file)
        with h5py.File(disk, modes[1], libver="latest") as h5_file:
            yield h5_file
        if disk.error is not None:
            raise disk.error


class _Disk:
    """A file for HDF5, which must not see an error: what cannot be written is kept in memory."""

    def __init__(self, file: io.FileIO):
        self.file, self.place = file, 0
        self.error: OSError | None = None
        self.unwritten: list[tuple[int, bytes]] = []  # where, and what

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self.place = offset if whence == os.SEEK_SET else self.file.seek(offset, whence)
        return self.place

    def tell(self) -> int:
        return self.place

    def read(self, size: int) -> bytes:
        data = bytearray(size)
        self.readinto(data)
        return bytes(data)

    def readinto(self, buffer: memoryview) -> int:
        buffer = memoryview(buffer).cast("B")
        self.file.seek(self.place)
        number = self.file.readinto(buffer)
        buffer[number:] = bytes(len(buffer) - number)
        for start, kept in self.unwritten:
            begin = max(start, self.place)
            end = min(start + len(kept), self.place + len(buffer))
            if begin < end:
                buffer[begin - self.place : end - self.place] = kept[begin - start : end - start]
        self.place += len(buffer)
        return len(buffer)

    def write(self, data: memoryview) -> int:
        data, written = memoryview(data).cast("B"), 0
        try:
            self.file.seek(self.place)
            while self.error is None and written < len(data):
                written += self.file.write(data[written:])
        except OSError as error:
            self.error = error
        if written < len(data):
            self.unwritten.append((self.place + written, bytes(data[written:])))
        self.place += len(data)
        return len(data)

    def truncate(self, size: int) -> None:
        try:
            if self.error is None:
                self.file.truncate(size)
        except OSError as error:
            self.error = error

    def flush(self) -> None:
        pass


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
        elif prefix and not holds_data:
            holds_data = True
            yield prefix[:-1]


def get_dataset(file: h5py.File, name: str, key: str) -> h5py.Dataset:
    """Return a data set of an image or a pair in an open h5 file, or raise an InputError."""
    with reading(file.filename):
        group = file.get(name)
        dataset = group.get(key) if isinstance(group, h5py.Group) else None
    if group is None:
        raise InputError(f"{name} is not in the file {file.filename}.")
    if not isinstance(dataset, h5py.Dataset):
        raise InputError(f"{file.filename} is not a file of {key}: {name} has none.")
    return dataset


def get_array(file: h5py.File, name: str, key: str, least: tuple[int, ...]) -> np.ndarray:
    """Read a data set of finite numbers of an image or a pair in an open h5 file.

    Args:
        file: the h5 file.
        name: of the image or pair.
        key: of the data set.
        least: the least size of each of its dimensions.

    Raises:
        InputError: when it is not there or is none of such.
    """
    dataset = get_dataset(file, name, key)
    said = f"{file.filename}: the {key} of {name}"
    with reading(file.filename):
        shape, dtype = dataset.shape or (), dataset.dtype
        claimed = dataset.size * dtype.itemsize if dataset.size else 0
    if claimed > MOST_COMPRESSED * Path(file.filename).stat().st_size:
        raise InputError(f"{said} cannot be read (they claim to be {claimed:,} bytes).")
    if len(shape) != len(least) or any(n < m for n, m in zip(shape, least, strict=True)):
        raise InputError(f"{said} are of the wrong shape {shape}.")
    if dtype.kind not in "iuf":
        raise InputError(f"{said} are no numbers, but {dtype}.")
    try:
        array = dataset[()]
    except Exception as error:
        if not _is_of_h5py(error):
            raise
        raise InputError(f"{said} cannot be read ({_first_line(error)}).") from error
    if array.dtype.kind == "f" and not np.isfinite(array.astype(np.float32)).all():
        raise InputError(f"{said} have numbers that are not finite.")
    return array


def set_text(item: h5py.Group | h5py.Dataset, key: str, text: str) -> None:
    """Set a text attribute of an open h5 file.

    It has a fixed length: HDF5 keeps others in a heap without checksums, and may hang if that is
    damaged.
    """
    item.attrs[key] = np.bytes_(text.encode()) if text else h5py.Empty("S1")


def get_text(item: h5py.Group | h5py.Dataset, key: str, default: str | None = None) -> str | None:
    """Return a text attribute of an open h5 file, or the default where it has none.

    Raises:
        InputError: when the file is damaged.
    """
    with reading(item.file.filename):
        value = item.attrs.get(key, default)
    if isinstance(value, h5py.Empty):
        return ""
    return value.decode(errors="replace") if isinstance(value, bytes) else value


def provenance(file: h5py.File) -> str:
    """Return what tells an open h5 file from others: what made it and when, or its name."""
    conf = get_text(file, "conf", Path(file.filename).name)
    return f"{conf} {get_text(file, 'id', '')}".strip()


def get_matcher(match_file: h5py.File) -> dict:
    """Return the configuration of the matcher's model of a match file, {} if it does not say."""
    try:
        model = json.loads(get_text(match_file, "conf", "{}"))["model"]
    except (ValueError, TypeError, KeyError):
        return {}
    return model if isinstance(model, dict) else {}


def get_keypoints(file: h5py.File, name: str) -> tuple[np.ndarray, float]:
    """Read keypoints (N, 2) float64, pixel centres at integers, and their uncertainty in pixels."""
    keypoints = get_array(file, name, "keypoints", (0, 2))[:, :2].astype(np.float64)
    with reading(file.filename):
        uncertainty = get_dataset(file, name, "keypoints").attrs.get("uncertainty", 1.0)
    if not (np.isscalar(uncertainty) and np.isreal(uncertainty) and 0 < uncertainty < np.inf):
        raise InputError(f"{file.filename}: the uncertainty of {name} is {uncertainty!r}.")
    return keypoints, float(uncertainty)


def get_image_size(file: h5py.File, name: str) -> tuple[int, int]:
    """Read the width and height of an image in an open feature file."""
    width, height = map(int, get_array(file, name, "image_size", (2,))[:2])
    if min(width, height) < 1:
        raise InputError(f"{file.filename}: the image_size of {name} is {width}x{height}.")
    return width, height


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
            with reading(file.filename):
                found = pair in file
            if found:
                return pair, reverse
    return None, False


def get_matches(
    file: h5py.File, name0: str, name1: str, sizes: tuple[int, int] | None = None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Read the matches of a pair, stored in either order.

    Args:
        file: the match file.
        name0: an image.
        name1: another.
        sizes: how many keypoints both have, if that is to be checked.

    Returns:
        matches (M, 2) int64, indices of the keypoints of name0 and name1, and scores (M,), None
        where the file has none.

    Raises:
        InputError: when the pair was not matched, or its matches are of other keypoints.
    """
    pair, reverse = find_pair(file, name0, name1)
    if pair is None:
        raise InputError(f"The pair {name0}, {name1} is not in the match file {file.filename}.")
    matches0 = get_array(file, pair, "matches0", (0,))
    matched = np.flatnonzero(matches0 != -1)
    matches = np.stack([matched, matches0[matched].astype(np.int64)], -1)
    matches = matches[:, ::-1] if reverse else matches
    if sizes is not None:
        _check_matches(file, matches, (name0, name1), sizes)
    with reading(file.filename):
        scored = "matching_scores0" in file[pair]
    if not scored:
        return matches, None
    return matches, get_array(file, pair, "matching_scores0", matches0.shape)[matched]


def _check_matches(
    file: h5py.File, matches: np.ndarray, names: tuple[str, str], sizes: tuple[int, int]
) -> None:
    """Raise an InputError if matches (M, 2) refer to keypoints that images do not have."""
    said = f"{file.filename}: the matches of {names[0]}, {names[1]}"
    if len(matches) and matches.min() < 0:
        raise InputError(
            f"{said} are negative, as hloc's are that have more than 32,767 keypoints: match these "
            "anew."
        )
    for column, (name, size) in enumerate(zip(names, sizes, strict=True)):
        if len(matches) and matches[:, column].max() >= size:
            raise InputError(
                f"{said} were made of other features: {name} has {size} keypoints only."
            )
