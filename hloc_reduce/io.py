"""Images and h5 files, and how files are written so that a killed run loses little."""

import csv
import filecmp
import json
import os
import shutil
import sqlite3
import time
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import h5py
import numpy as np

from . import trace
from .cli import InputError

QUOTED = 200  # characters of a configuration in a message


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


class GroupWriter:
    """Adds groups of arrays to an h5 file; a killed run loses its last seconds of work only.

    Groups gather in memory and go into pieces beside the file, each moved into place when it is
    whole. Leaving the context merges the pieces into the file. What a piece holds is never
    computed again, and the file itself is whole at any instant. A file keeps the `id` that it got
    when it was begun, so that what is derived from it can tell it from one made anew. The names of
    its groups, which may be more than memory can hold, are in a temporary data base on disk.

    Args:
        path: the h5 file, new or to be extended.
        conf: what makes the arrays; kept in the file and refused when it differs.
        overwrite: start anew instead of extending.
        compression: h5py's name of a compression filter for all arrays.

    Raises:
        InputError: when the file is broken or was made with another conf.
    """

    piece_seconds = 5.0
    piece_bytes = 64 * 2**20

    def __init__(
        self, path: Path, conf: dict, overwrite: bool = False, compression: str | None = None
    ):
        self.path = path
        self.conf = json.dumps(conf, sort_keys=True)
        self.compression = compression
        self.pieces = path.with_name(path.name + ".pieces")
        path.parent.mkdir(parents=True, exist_ok=True)
        if overwrite:
            self._drop_pieces()
            path.unlink(missing_ok=True)
        self.names = _Names()
        self.id = uuid.uuid4().hex
        for part in [path] * path.exists() + self._finished():
            with open_h5(part) as file:
                self._check(file, part)
                self.id = file.attrs.get("id", self.id)
                for name in iterate_h5_names(file.id):
                    self.names.add(name)
        self.next_piece = 0
        self.buffer: dict[str, tuple[dict, dict]] = {}
        self.buffer_bytes = 0
        self.flushed = time.monotonic()

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def begin(self, name: str) -> None:
        """Have a group that will be added count as one that is there."""
        self.names.add(name)

    def __enter__(self) -> "GroupWriter":
        return self

    def __exit__(self, error: type | None, *_) -> None:
        self._flush()
        if error is None:
            with trace.span("merge"):
                self._merge()

    def add(self, name: str, arrays: dict[str, np.ndarray], attrs: dict | None = None) -> None:
        """Add a group of arrays; `attrs` maps the name of an array to its attributes."""
        self.buffer[name] = arrays, attrs or {}
        self.names.add(name)
        self.buffer_bytes += sum(array.nbytes for array in arrays.values())
        late = time.monotonic() - self.flushed > self.piece_seconds
        if late or self.buffer_bytes > self.piece_bytes:
            self._flush()

    def _finished(self) -> list[Path]:
        return sorted(self.pieces.glob("[0-9]*.h5"))

    def _drop_pieces(self) -> None:
        """Delete all pieces or, if killed meanwhile, leave none that counts."""
        if self.pieces.exists():
            dropped = self.pieces.with_name(f".{self.pieces.name}.{uuid.uuid4().hex}.tmp")
            self.pieces.rename(dropped)
            shutil.rmtree(dropped, ignore_errors=True)

    def _check(self, file: h5py.File, path: Path) -> None:
        before = file.attrs.get("conf", self.conf)  # hloc's own files say nothing
        if before != self.conf:
            old, new = json.loads(before), json.loads(self.conf)
            keys = [key for key in {**old, **new} if old.get(key) != new.get(key)]
            changes = "; ".join(
                f"{key}: {_quoted(old, key)} before, {_quoted(new, key)} now" for key in keys
            )
            raise InputError(
                f"{path} was made with another configuration ({changes}). "
                "Choose another output or overwrite it."
            )

    def _flush(self) -> None:
        if self.buffer:
            while (piece := self.pieces / f"{self.next_piece:06d}.h5").exists():
                self.next_piece += 1
            with trace.span("write"), replacing(piece) as temporary:
                self._write(temporary)
        self.buffer.clear()
        self.buffer_bytes = 0
        self.flushed = time.monotonic()

    def _write(self, path: Path) -> None:
        with h5py.File(path, "w", libver="latest") as file:
            file.attrs.update({"conf": self.conf, "id": self.id})
            for name, (arrays, attrs) in self.buffer.items():
                group = file.create_group(name)
                for key, array in arrays.items():
                    packed = {}
                    if self.compression and array.size:
                        packed = {"compression": self.compression, "chunks": array.shape}
                    dataset = group.create_dataset(key, data=array, **packed)
                    dataset.attrs.update(attrs.get(key, {}))

    def _merge(self) -> None:
        pieces = self._finished()
        if not pieces and self.path.exists():
            return
        with replacing(self.path) as temporary:
            if self.path.exists():
                shutil.copyfile(self.path, temporary)
            with h5py.File(temporary, "a", libver="latest") as merged:
                merged.attrs.update({"conf": self.conf, "id": self.id})
                for piece in pieces:
                    with open_h5(piece) as file:
                        _copy_missing(file, merged)
        self._drop_pieces()


class _Names:
    """A set of names on disk, in a file without a name in the system's temporary folder."""

    def __init__(self):
        self.database = sqlite3.connect("", isolation_level=None)
        self.database.execute("PRAGMA journal_mode = OFF")
        self.database.execute("CREATE TABLE names (name TEXT PRIMARY KEY) WITHOUT ROWID")

    def add(self, name: str) -> None:
        self._run("INSERT OR IGNORE INTO names VALUES (?)", name)

    def __contains__(self, name: str) -> bool:
        return self._run("SELECT 1 FROM names WHERE name = ?", name) is not None

    def _run(self, command: str, name: str) -> tuple | None:
        try:
            return self.database.execute(command, (name,)).fetchone()
        except sqlite3.OperationalError as error:
            raise InputError(
                f"The names of what is done cannot be kept in the temporary folder ({error}): set "
                "SQLITE_TMPDIR to another one."
            ) from None


def _quoted(conf: dict, key: str) -> str:
    text = str(conf.get(key, "not given"))
    return text if len(text) <= QUOTED else f"{text[:QUOTED]}..."


def _copy_missing(source: h5py.Group, target: h5py.Group) -> None:
    """Copy what a group has and another has not, whole groups at once."""
    for name in source:
        if name not in target:
            source.copy(name, target)
        elif isinstance(source[name], h5py.Group):
            _copy_missing(source[name], target[name])


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
