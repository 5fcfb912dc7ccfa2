"""Files: atomic writing, checksums, deletion."""

import csv
import filecmp
import hashlib
import os
import shutil
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from .cli import check_file, make_folder

MEGABYTE = 1_000_000  # bytes, in options and tables

_observers: list[Callable[[Path], None]] = []


@contextmanager
def observing(observe: Callable[[Path], None]) -> Iterator[None]:
    """Call a function with the path of each file and folder, before it is written in a block."""
    _observers.append(observe)
    try:
        yield
    finally:
        _observers.remove(observe)


def is_readable(path: Path) -> bool:
    """Return whether this process may read a file."""
    return path.is_file() and os.access(path, os.R_OK)


def announce(path: Path) -> None:
    """Tell observers that a file or folder is about to be written."""
    for observe in _observers:
        observe(path)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path` and move it into place when the block succeeds.

    A file that is replaced by an equal one keeps its time, so that nothing derived gets stale.

    Raises:
        InputError: if there is a folder in its place, or a file in the place of its folder.
    """
    announce(path)
    check_file(path)
    make_folder(path.parent)
    # of a name of its own: an interrupted block may leave its file until Python forgets the block
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        with naming(path):
            yield temporary
        filecmp.clear_cache()  # it compares only sizes and times
        if path.exists() and filecmp.cmp(temporary, path, shallow=False):
            shutil.copystat(path, temporary)
        with temporary.open("rb") as file:
            os.fsync(file.fileno())  # otherwise a power cut may leave an empty file
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add a path to operating system errors that name no file, such as a full disk's."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


def write_csv(rows: list[dict], path: Path, columns: Iterable[str] = ()) -> None:
    """Write rows with the same keys as CSV; None is an empty cell.

    `columns` gives the header if there may be no row.
    """
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(columns) or list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def file_sha256(path: Path) -> str:
    """Return the sha256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def delete(path: Path) -> None:
    """Delete a file or a folder, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
