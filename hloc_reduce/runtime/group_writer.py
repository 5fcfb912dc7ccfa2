"""How groups of arrays are added to h5 files, so that a run that is stopped loses little."""

import json
import shutil
import sqlite3
import time
import uuid
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import h5py
import numpy as np

from ..utils.cli import InputError
from ..utils.files import announce, replacing
from ..utils.h5 import get_text, iterate_h5_names, open_h5, reading, set_text, write_h5
from . import trace
from .executors import Executor, Item

PIECE_SECONDS = 5.0  # of work that a killed run may lose
PIECE_BYTES = 64 * 2**20
SYNC_SECONDS = 120.0  # until what another machine wrote is to be seen on this one
FAILURE = "failure"  # attribute of a group that stands for what could not be computed, and why
FAILURES = "failures"  # attribute of a file: the names of its groups that have a FAILURE
QUOTED = 200  # characters of a configuration in a message

Arrays = dict[str, np.ndarray]
# the name of a group, its arrays, and from the name of an array, "" for the group itself, whose
# attributes are texts, to its attributes
Group = tuple[str, Arrays, dict[str, dict]]
Key = TypeVar("Key", bound=Hashable)


class GroupWriter:
    """Adds groups of arrays to an h5 file; a killed run loses its last seconds of work only.

    Groups go into pieces beside the file, each moved into place when it is whole. Leaving the
    context merges the pieces into the file. What a piece holds is never computed again, and the
    file itself is whole at any instant. A file keeps the `id` that it got when it was begun, so
    that what is derived from it can tell it from one made anew. The names of its groups, which may
    be more than memory can hold, are in a temporary data base on disk.

    Args:
        path: the h5 file, new or to be extended.
        conf: what makes the arrays; kept in the file and refused when it differs.
        overwrite: start anew instead of extending.
        compression: h5py's name of a compression filter for all arrays.

    Raises:
        InputError: when the file is broken or was made with another conf.
    """

    def __init__(
        self, path: Path, conf: dict, overwrite: bool = False, compression: str | None = None
    ):
        self.path = path
        self.folder = path.with_name(path.name + ".pieces")
        announce(path)
        announce(self.folder)
        path.parent.mkdir(parents=True, exist_ok=True)
        if overwrite:
            self._drop_pieces()
            path.unlink(missing_ok=True)
        self.names = _Names()
        self.expected: dict[str, str] = {}  # pieces of other processes, and a group of each
        header = {"conf": json.dumps(conf, sort_keys=True)}
        for part in [path] * path.exists() + self._pieces():
            with open_h5(part) as file:
                _check(file, part, header["conf"])
                header.setdefault("id", get_text(file, "id", uuid.uuid4().hex))
                failed = _failed(file)
                for name in iterate_h5_names(file.id):
                    if name not in failed:
                        self.names.add(name)
        header.setdefault("id", uuid.uuid4().hex)
        self.header = header
        self.new_pieces = partial(Pieces, self.folder, header, compression)
        self.added = self.new_pieces()

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def begin(self, name: str, piece: str | None = None) -> None:
        """Have a group count as one that is there: it will be added, or is in a piece."""
        self.names.add(name)
        if piece is not None:
            self.expected[piece] = name

    def __enter__(self) -> "GroupWriter":
        return self

    def __exit__(self, error: type | None, *_: object) -> None:
        self.names.database.close()
        self.added.flush()
        if error is None:
            with trace.span("merge"):
                self._merge()

    def add(self, name: str, arrays: Arrays, attrs: dict[str, dict] | None = None) -> None:
        """Add a group of arrays; `attrs` maps the name of an array to its attributes."""
        self.begin(name)
        self.added.add(name, arrays, attrs or {})

    def _pieces(self) -> list[Path]:
        return sorted(self.folder.glob("*.h5"))

    def _drop_pieces(self) -> None:
        """Delete all pieces or, if killed meanwhile, leave none that counts."""
        if self.folder.exists():
            dropped = self.folder.with_name(f".{self.folder.name}.{uuid.uuid4().hex}.tmp")
            self.folder.rename(dropped)
            shutil.rmtree(dropped, ignore_errors=True)

    def _merge(self) -> None:
        pieces = self._await_pieces()
        if self.path.exists() and not any(map(self._has_news, pieces)):
            if pieces:
                self._drop_pieces()
            return
        with replacing(self.path) as temporary:
            if self.path.exists():
                shutil.copyfile(self.path, temporary)
            with write_h5(temporary) as merged:
                _set_header(merged, self.header)
            for piece in pieces:
                with open_h5(piece) as file, write_h5(temporary) as merged:
                    _merge_piece(file, merged)
        self._drop_pieces()

    def _await_pieces(self) -> list[Path]:
        """Return all pieces, when those that other machines wrote are here, too."""
        end = time.monotonic() + SYNC_SECONDS
        while missing := self.expected.keys() - {piece.name for piece in self._pieces()}:
            if self.path.exists():
                with open_h5(self.path) as file:  # into which another writer may have merged them
                    missing = {piece for piece in missing if self.expected[piece] not in file}
            if not missing:
                break
            if time.monotonic() > end:
                raise InputError(
                    f"{len(missing)} pieces that other machines wrote are not in {self.folder}: is "
                    "it shared with them, or synced? The same command goes on from here."
                )
            time.sleep(SYNC_SECONDS / 100)
        return self._pieces()

    def _has_news(self, piece: Path) -> bool:
        """Return whether a piece has what the file has not, or has as another failure."""
        with open_h5(piece) as new, open_h5(self.path) as old:
            known = _failed(old)
            return any(
                name not in old or name in known and failure_of(new, name) != failure_of(old, name)
                for name in iterate_h5_names(new.id)
            )


def resume_or_replace(path: Path, made_from: dict) -> GroupWriter:
    """Return a writer that resumes an intermediate file, or starts it anew if it is stale."""
    try:
        return GroupWriter(path, made_from)
    except InputError:  # made from something else, or broken
        return GroupWriter(path, made_from, overwrite=True)


@dataclass
class Pieces:
    """Gathers groups in memory and writes them into pieces of an h5 file.

    Args:
        folder: of the pieces.
        header: attributes of each.
        compression: as of GroupWriter.
    """

    folder: Path
    header: dict[str, str]
    compression: str | None

    def __post_init__(self) -> None:
        self._clear()

    def add(self, name: str, arrays: Arrays, attrs: dict[str, dict]) -> str:
        """Add a group, write a piece if it is time to, and return the name of the group's piece."""
        piece = self.piece
        self.groups[name] = arrays, attrs
        self.bytes += sum(array.nbytes for array in arrays.values())
        if time.monotonic() - self.since > PIECE_SECONDS or self.bytes > PIECE_BYTES:
            self.flush()
        return piece

    def flush(self) -> None:
        """Write what was gathered into a piece."""
        if self.groups:
            with trace.span("write"), replacing(self.folder / self.piece) as temporary:
                self._write(temporary)
        self._clear()

    def _clear(self) -> None:
        self.groups: dict[str, tuple[Arrays, dict]] = {}
        self.bytes, self.since = 0, time.monotonic()
        # in the order of time, and of one writer only
        self.piece = f"{time.time_ns():020d}-{uuid.uuid4().hex[:8]}.h5"

    def _write(self, path: Path) -> None:
        with write_h5(path) as file:
            _set_header(file, self.header)
            _set_failed(file, {n for n, (_, a) in self.groups.items() if FAILURE in a.get("", ())})
            for name, (arrays, attrs) in self.groups.items():
                group = file.create_group(name)
                for key, text in attrs.get("", {}).items():
                    set_text(group, key, text)
                for key, array in arrays.items():
                    packed = {}
                    if self.compression and array.size:
                        packed = {"compression": self.compression, "chunks": array.shape}
                    dataset = group.create_dataset(key, data=array, **packed)
                    dataset.attrs.update(attrs.get(key, {}))


def fill(
    writers: Mapping[Key, GroupWriter],
    work: Callable[[Iterable[Item]], Iterator[tuple[Key, Group]]],
    items: Iterable[Item],
    executor: Executor,
    size: int,
    gpu: bool = False,
) -> Iterator[tuple[Key, str]]:
    """Add the groups that work makes of items to files, wherever an executor does it.

    Args:
        writers: of the files.
        work: as of `executors`, yields groups, each with the key of its writer.
        items: as of `Executor.map`.
        executor: does the work.
        size: as of `Executor.map`.
        gpu: as of `Executor.map`.

    Yields:
        For each group the key of its writer and its name.
    """
    new_pieces = {key: writer.new_pieces for key, writer in writers.items()}
    write = partial(_write_pieces, new_pieces, work)
    with closing(executor.map(write, items, size, gpu)) as added:
        for key, name, piece in added:
            writers[key].begin(name, piece)
            yield key, name


def _write_pieces(
    new_pieces: Mapping[Key, Callable[[], Pieces]],
    work: Callable[[Iterable[Item]], Iterator[tuple[Key, Group]]],
    items: Iterable[Item],
) -> Iterator[tuple[Key, str, str]]:
    """Write the groups that work makes of items, and yield their keys, names and pieces."""
    pieces = {key: new() for key, new in new_pieces.items()}
    try:
        with closing(work(items)) as groups:
            for key, (name, arrays, attrs) in groups:
                yield key, name, pieces[key].add(name, arrays, attrs)
    finally:
        for part in pieces.values():
            part.flush()


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


def _check(file: h5py.File, path: Path, conf: str) -> None:
    """Raise an InputError if an h5 file was made with another configuration."""
    before = get_text(file, "conf", conf)  # hloc's own files say nothing
    if before != conf:
        try:
            old, new = dict(json.loads(before)), json.loads(conf)
        except (ValueError, TypeError):
            raise InputError(
                f"{path} was made by another program: choose another output."
            ) from None
        keys = [key for key in {**old, **new} if old.get(key) != new.get(key)]
        changes = "; ".join(
            f"{key}: {_quoted(old, key)} before, {_quoted(new, key)} now" for key in keys
        )
        raise InputError(
            f"{path} was made with another configuration ({changes}). "
            "Choose another output or overwrite it."
        )


def _quoted(conf: dict, key: str) -> str:
    text = str(conf.get(key, "not given"))
    return text if len(text) <= QUOTED else f"{text[:QUOTED]}..."


def failures(path: Path) -> dict[str, str]:
    """Return the groups of an h5 file that stand for what could not be computed, and why."""
    with open_h5(path) as file:
        reasons = {name: failure_of(file, name) for name in sorted(_failed(file))}
    return {name: str(reason) for name, reason in reasons.items() if reason is not None}


def failure_of(file: h5py.File, name: str) -> str | None:
    """Return why a group of an open h5 file could not be computed; None where it was."""
    with reading(file.filename):
        group = file.get(name)
    return None if group is None else get_text(group, FAILURE)


def _set_header(file: h5py.File, header: dict[str, str]) -> None:
    for key, text in header.items():
        set_text(file, key, text)


def _failed(file: h5py.File) -> set[str]:
    try:
        return set(map(str, json.loads(get_text(file, FAILURES) or "[]")))
    except (ValueError, TypeError) as error:
        raise InputError(f"Cannot read {file.filename}: it is corrupted ({error}).") from error


def _set_failed(file: h5py.File, names: set[str]) -> None:
    if names or FAILURES in file.attrs:
        set_text(file, FAILURES, json.dumps(sorted(names)))


def _merge_piece(piece: h5py.File, merged: h5py.File) -> None:
    """Add what a piece has and a file has not, or has as a failure."""
    failed, again = _failed(merged), _failed(piece)
    for name in {name for name in failed if name in piece}:
        del merged[name]
        if name not in again:
            failed.remove(name)
    failed |= {name for name in again if name not in merged}
    _copy_missing(piece, merged)
    _set_failed(merged, failed)


def _copy_missing(source: h5py.Group, target: h5py.Group) -> None:
    """Copy what a group has and another has not, whole groups at once."""
    for name in source:
        if name not in target:
            source.copy(name, target)
        elif isinstance(source[name], h5py.Group):
            _copy_missing(source[name], target[name])
