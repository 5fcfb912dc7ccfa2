"""h5 files. A broken one is a user's error, with a message that names it."""

import json
import os
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from io import FileIO
from pathlib import Path
from typing import overload

import h5py
import numpy as np

from .cli import InputError
from .interrupts import uninterrupted
from .locks import has_locks

MOST_COMPRESSED = 2000  # times its size: more than gzip can compress into a file


class Unavailable(InputError):
    """An h5 file cannot be opened now, but may be whole: nothing should replace it."""


@contextmanager
def open_h5(path: Path) -> Iterator[h5py.File]:
    """Open an h5 file for reading during a block, see `open_file`."""
    with open_file(path) as file, reading(path):
        yield file


def open_file(path: Path) -> h5py.File:
    """Open an h5 file for reading, without locks where the file system has none.

    Raises:
        Unavailable: when another program writes to the file, or it must not be read.
        InputError: when it is missing or broken.
    """
    try:
        locking = None if has_locks(path) else False
        return h5py.File(path, "r", libver="latest", locking=locking)
    except FileNotFoundError as error:
        raise InputError(f"Cannot open {path}: it does not exist.") from error
    except BlockingIOError as error:
        raise Unavailable(
            f"{path} is open for writing in another program: wait until that has closed it."
        ) from error
    except OSError as error:
        if error.errno is not None:
            raise Unavailable(f"Cannot open {path}: {os.strerror(error.errno)}.") from error
        if "already open for write" in str(error):  # by a mark in the file
            raise Unavailable(
                f"{path} is open for writing in another program, or that was killed: wait until it "
                f"has closed the file. If it was killed, mend the file (h5clear -s {path}), or "
                "delete it and run again."
            ) from error
        raise InputError(f"Cannot open {path}: not a whole h5 file.") from error
    except Exception as error:
        if not _is_of_h5py(error):
            raise
        raise InputError(f"Cannot open {path}: not a whole h5 file.") from error


@contextmanager
def reading(path: Path | str) -> Iterator[None]:
    """Turn errors of h5py in a block into one that names the file.

    A damaged file can cause errors of any type.

    Raises:
        InputError: instead of them.
    """
    try:
        yield
    except Exception as error:
        if not _is_of_h5py(error):
            raise
        raise InputError(f"Cannot read {path}: it is corrupted ({_first_line(error)}).") from error


def _is_of_h5py(error: Exception) -> bool:
    """Tell whether h5py raised an error, other than for a name that is not in a file."""
    if isinstance(error, KeyError) and "doesn't exist" in str(error):
        return False
    *_, last = traceback.walk_tb(error.__traceback__)
    return "h5py" in Path(last[0].f_code.co_filename).parts


def _first_line(error: Exception) -> str:
    return next(iter(str(error).strip("'\"").splitlines()), type(error).__name__)


@contextmanager
def write_h5(path: Path) -> Iterator[h5py.File]:
    """Open an h5 file to add to it, or create it; Ctrl-C waits until the block ends.

    Raises:
        OSError: after the block, if the disk was full; HDF5 itself would crash.
    """
    raw_mode, mode = ("r+", "r+") if path.exists() else ("w+", "w")
    with uninterrupted(), FileIO(path, raw_mode) as file:
        disk = _Disk(file)
        with h5py.File(disk, mode, libver="latest") as h5_file:
            yield h5_file
        if disk.error is not None:
            raise disk.error


class _Disk:
    """A file whose writes never fail, as HDF5 would crash: it keeps unwritten data in memory."""

    def __init__(self, file: FileIO):
        self.file, self.place = file, 0
        self.error: OSError | None = None
        self.unwritten: list[tuple[int, bytes]] = []  # offset and data

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self.place = offset if whence == os.SEEK_SET else self.file.seek(offset, whence)
        return self.place

    def tell(self) -> int:
        return self.place

    def read(self, size: int) -> bytes:
        data = bytearray(size)
        self.readinto(data)
        return bytes(data)

    def readinto(self, buffer: bytearray | memoryview) -> int:
        view = memoryview(buffer).cast("B")
        self.file.seek(self.place)
        number = self.file.readinto(view) or 0
        view[number:] = bytes(len(view) - number)
        for start, kept in self.unwritten:
            begin = max(start, self.place)
            end = min(start + len(kept), self.place + len(view))
            if begin < end:
                view[begin - self.place : end - self.place] = kept[begin - start : end - start]
        self.place += len(view)
        return len(view)

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

    Reads one group at a time; HDF5's own visitor keeps all of them in memory. Links to other files
    are ignored.

    Raises:
        InputError: when a group has several names, so that it could contain itself.
    """
    names: list[bytes] = []
    # not into a function of ours, in which an interrupt would become an error of h5py's
    group.links.iterate(names.append)
    holds_data = False
    for name in names:
        if group.links.get_info(name).type != h5py.h5l.TYPE_HARD:
            continue
        child = h5py.h5o.get_info(group, name)
        if child.type == h5py.h5o.TYPE_GROUP:
            path = f"{prefix}{name.decode()}"
            if child.rc > 1:
                file = h5py.h5f.get_name(group).decode()
                raise InputError(f"{file}: the group {path} has a second name; copy the file.")
            yield from iterate_h5_names(h5py.h5g.open(group, name), f"{path}/")
        elif prefix and not holds_data:
            holds_data = True
            yield prefix[:-1]


def get_dataset(file: h5py.File, name: str, key: str) -> h5py.Dataset:
    """Return a data set of an image or a pair; raise an InputError if it is missing."""
    with reading(file.filename):
        group = file.get(name)
        dataset = group.get(key) if isinstance(group, h5py.Group) else None
    if group is None:
        raise InputError(f"{name} is not in the file {file.filename}.")
    if not isinstance(dataset, h5py.Dataset):
        raise InputError(f"{file.filename} is not a file of {key}: {name} has none.")
    return dataset


def stored_bytes(file: h5py.File, name: str) -> int:
    """Return the size of the data sets of an image or a pair as they are stored, compressed."""
    with reading(file.filename):
        return sum(dataset.id.get_storage_size() for dataset in file[name].values())


def get_array(file: h5py.File, name: str, key: str, least: tuple[int, ...]) -> np.ndarray:
    """Read a data set of finite numbers of an image or a pair.

    Args:
        file: an open h5 file.
        name: group name of the image or pair.
        key: name of the data set.
        least: minimum size of each dimension.

    Raises:
        InputError: when it is missing or has another shape or type.
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

    The text has a fixed length: HDF5 keeps others in a heap without checksums, and may hang if
    that is damaged.
    """
    item.attrs[key] = np.bytes_(text.encode()) if text else h5py.Empty("S1")


@overload
def get_text(item: h5py.Group | h5py.Dataset, key: str) -> str | None: ...
@overload
def get_text(item: h5py.Group | h5py.Dataset, key: str, default: str) -> str: ...
def get_text(item: h5py.Group | h5py.Dataset, key: str, default: str | None = None) -> str | None:
    """Return a text attribute of an open h5 file, or the default if it has none.

    Raises:
        InputError: when the file is damaged.
    """
    with reading(item.file.filename):
        value = item.attrs.get(key, default)
    if isinstance(value, h5py.Empty):
        return ""
    return value.decode(errors="replace") if isinstance(value, bytes) else value


def get_conf(file: h5py.File) -> dict:
    """Return what the contents of an open h5 file are made from, {} if it does not say."""
    try:
        conf = json.loads(get_text(file, "conf") or "{}")
    except ValueError:
        return {}
    return conf if isinstance(conf, dict) else {}


def file_provenance(file: h5py.File) -> str:
    """Return the provenance of an open h5 file: its `conf` and `id`, or else its name."""
    conf = get_text(file, "conf", Path(file.filename).name)
    return f"{conf} {get_text(file, 'id', '')}".strip()
