"""Add groups of arrays to h5 files such that a killed run loses little work."""

import json
import shutil
import time
import uuid
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import h5py
import numpy as np

from ..utils.cli import InputError, check_file, make_folder
from ..utils.files import announce, replacing
from ..utils.h5 import Unavailable, get_text, iterate_h5_names, open_h5, reading, set_text, write_h5
from . import trace
from .executors import Executor, Item, Results

PIECE_SECONDS = 5.0  # work that a killed run may lose
PIECE_BYTES = 64 * 2**20
SYNC_SECONDS = 120.0  # until files written by other machines must be visible here
FAILURE = "failure"  # group attribute: why its input could not be processed
FAILURES = "failures"  # file attribute: names of the groups that have a FAILURE
QUOTED = 200  # characters of a configuration that a message shows

Arrays = dict[str, np.ndarray]
Attributes = dict[str, dict]  # by the name of an array, or "" for the group itself (texts only)
Group = tuple[str, Arrays, Attributes]  # name, arrays, attributes
Key = TypeVar("Key", bound=Hashable)


class GroupWriter:
    """Adds groups of arrays to an h5 file; a killed run loses only its last seconds of work.

    Groups are first written to pieces beside the file, each moved into place when it is complete;
    leaving the context merges them into the file. Groups of earlier pieces are not computed again,
    and the file itself is complete at any instant. Its header holds the provenance: `conf` and an
    `id` that a file keeps when it is extended, but not when it is recomputed.

    Args:
        path: the h5 file, new or to be extended.
        conf: what determines the arrays.
        overwrite: start anew instead of extending the file.
        compression: h5py's name of a compression filter for all arrays.

    Raises:
        InputError: when the file is broken or has another `conf`.
    """

    def __init__(
        self, path: Path, conf: dict, overwrite: bool = False, compression: str | None = None
    ):
        self.path = path
        self.folder = path.with_name(path.name + ".pieces")
        announce(path)
        announce(self.folder)
        check_file(path)
        make_folder(path.parent)
        if overwrite:
            self._drop_pieces()
            path.unlink(missing_ok=True)
        self.names: set[str] = set()
        self.expected: dict[str, str] = {}  # pieces of other processes, with one group of each
        header = {"conf": json.dumps(conf, sort_keys=True)}
        for part in [path] * path.exists() + self._pieces():
            with open_h5(part) as file:
                _check(file, part, header["conf"])
                header.setdefault("id", get_text(file, "id", uuid.uuid4().hex))
                self.names.update(set(iterate_h5_names(file.id)) - _failed(file))
        header.setdefault("id", uuid.uuid4().hex)
        self.header = header
        self.new_pieces = partial(Pieces, self.folder, header, compression)
        self.added = self.new_pieces()

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def texts(self, key: str) -> dict[str, str]:
        """Return an attribute of the groups that are present and have it, by their names."""
        found: dict[str, str] = {}
        for part in self._pieces() + [self.path] * self.path.exists():
            with open_h5(part) as file:
                for name in iterate_h5_names(file.id):
                    if h5py.h5a.exists(file.id, key.encode(), obj_name=name.encode()):
                        found[name] = get_text(file[name], key, "")
        return found

    def begin(self, name: str, piece: str | None = None) -> None:
        """Mark a group as present: it will be added, or another process has put it in a piece."""
        self.names.add(name)
        if piece is not None:
            self.expected[piece] = name

    def __enter__(self) -> "GroupWriter":
        return self

    def __exit__(self, error: type | None, *_: object) -> None:
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
        """Delete all pieces at once: none is left half deleted, even by a kill."""
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
        """Return all pieces; wait for those that other machines have written."""
        end = time.monotonic() + SYNC_SECONDS
        while missing := self.expected.keys() - {piece.name for piece in self._pieces()}:
            if self.path.exists():
                with open_h5(self.path) as file:  # another writer may have merged them
                    missing = {piece for piece in missing if self.expected[piece] not in file}
            if not missing:
                break
            if time.monotonic() > end:
                raise InputError(
                    f"{len(missing)} pieces written by other machines are not in {self.folder}. "
                    "Is it a shared or synced folder? Run the same command again to resume."
                )
            time.sleep(SYNC_SECONDS / 100)
        return self._pieces()

    def _has_news(self, piece: Path) -> bool:
        """Tell whether a piece has a group, or another failure, that the file lacks."""
        with open_h5(piece) as new, open_h5(self.path) as old:
            known = _failed(old)
            return any(
                name not in old or name in known and failure_of(new, name) != failure_of(old, name)
                for name in iterate_h5_names(new.id)
            )


def resume_or_replace(path: Path, made_from: dict, overwrite: bool = False) -> GroupWriter:
    """Return a writer that resumes an intermediate file, or replaces it if it is stale."""
    try:
        return GroupWriter(path, made_from, overwrite)
    except Unavailable:
        raise
    except InputError:  # stale, or broken
        return GroupWriter(path, made_from, overwrite=True)


@dataclass
class Pieces:
    """Gathers groups in memory and writes them into pieces of an h5 file.

    Args:
        folder: where the pieces go.
        header: file attributes of each piece.
        compression: as in GroupWriter.
    """

    folder: Path
    header: dict[str, str]
    compression: str | None

    def __post_init__(self) -> None:
        self._clear()

    def add(self, name: str, arrays: Arrays, attrs: dict[str, dict]) -> str:
        """Add a group, write a piece if it is due, and return the name of the group's piece."""
        piece = self.piece
        self.groups[name] = arrays, attrs
        self.bytes += sum(array.nbytes for array in arrays.values())
        if time.monotonic() - self.since > PIECE_SECONDS or self.bytes > PIECE_BYTES:
            self.flush()
        return piece

    def flush(self) -> None:
        """Write the gathered groups into a piece."""
        if self.groups:
            with trace.span("write"), replacing(self.folder / self.piece) as temporary:
                self._write(temporary)
        self._clear()

    def _clear(self) -> None:
        self.groups: dict[str, tuple[Arrays, dict]] = {}
        self.bytes, self.since = 0, time.monotonic()
        # sorted by time, and unique to this writer
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
    work: Callable[[Iterable[Item]], Results[tuple[Key, Group]]],
    items: Iterable[Item],
    executor: Executor,
    size: int,
    gpu: bool = False,
) -> Results[tuple[Key, str]]:
    """Run `work` on items and add the groups it yields to files.

    Args:
        writers: by key, the writers of the files.
        work: from items to groups, each with the key of its writer.
        items: what `work` is given; drawn as they are needed.
        executor: where the work is done.
        size: items per chunk, enough to be worth handing to another process.
        gpu: the work uses a GPU if there is one.

    Yields:
        The key of the writer and the name of each group.
    """
    new_pieces = {key: writer.new_pieces for key, writer in writers.items()}
    write = partial(_write_pieces, new_pieces, work)
    with closing(executor.map(write, items, size, gpu)) as added:
        for key, name, piece in added:
            writers[key].begin(name, piece)
            yield key, name


def _write_pieces(
    new_pieces: Mapping[Key, Callable[[], Pieces]],
    work: Callable[[Iterable[Item]], Results[tuple[Key, Group]]],
    items: Iterable[Item],
) -> Results[tuple[Key, str, str]]:
    """Write the groups that work yields into pieces; yield their keys, names and pieces."""
    pieces = {key: new() for key, new in new_pieces.items()}
    try:
        with closing(work(items)) as groups:
            for key, (name, arrays, attrs) in groups:
                yield key, name, pieces[key].add(name, arrays, attrs)
    finally:
        for part in pieces.values():
            part.flush()


def _check(file: h5py.File, path: Path, conf: str) -> None:
    """Raise an InputError if an h5 file was made with another configuration."""
    before = get_text(file, "conf", conf)  # hloc's own files have none
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
    """Return the names of the groups of an h5 file whose input was unreadable, with the reasons."""
    with open_h5(path) as file:
        reasons = {name: failure_of(file, name) for name in sorted(_failed(file))}
    return {name: str(reason) for name, reason in reasons.items() if reason is not None}


def failure_of(file: h5py.File, name: str) -> str | None:
    """Return why the input of a group was unreadable; None if it was not."""
    with reading(file.filename):
        group = file.get(name)
    return None if group is None else get_text(group, FAILURE)


def _set_header(file: h5py.File, header: dict[str, str]) -> None:
    for key, text in header.items():
        set_text(file, key, text)


def _failed(file: h5py.File) -> set[str]:
    try:
        return set(map(str, json.loads(get_text(file, FAILURES, "[]"))))
    except (ValueError, TypeError) as error:
        raise InputError(f"Cannot read {file.filename}: it is corrupted ({error}).") from error


def _set_failed(file: h5py.File, names: set[str]) -> None:
    if names or FAILURES in file.attrs:
        set_text(file, FAILURES, json.dumps(sorted(names)))


def _merge_piece(piece: h5py.File, merged: h5py.File) -> None:
    """Add the groups of a piece that a file lacks or has as failures."""
    failed, again = _failed(merged), _failed(piece)
    for name in {name for name in failed if name in piece}:
        del merged[name]
        if name not in again:
            failed.remove(name)
    failed |= {name for name in again if name not in merged}
    _copy_missing(piece, merged)
    _set_failed(merged, failed)


def merge(output: Path, sources: Sequence[Path], without: Collection[str] = ()) -> None:
    """Write the groups of h5 files into one, with the header of the first file.

    Args:
        output: the new file, which may be one of the sources.
        sources: the files; of groups with the same name the first counts.
        without: names of groups of the first file that are left out.
    """
    with replacing(output) as temporary:
        with open_h5(sources[0]) as first:
            dropped = {name for name in without if name in first}
            if not dropped:
                shutil.copyfile(sources[0], temporary)
            else:
                with write_h5(temporary) as merged:
                    for name in iterate_h5_names(first.id):
                        if name not in dropped:
                            first.copy(name, merged, name)
                    merged.attrs.update(first.attrs)
                    _set_failed(merged, _failed(first) - dropped)
        for source in sources[1:]:
            with open_h5(source) as file, write_h5(temporary) as merged:
                _copy_missing(file, merged)


def _copy_missing(source: h5py.Group, target: h5py.Group) -> None:
    """Copy the members of a group that another lacks, whole groups at once."""
    for name in source:
        if name not in target:
            source.copy(name, target)
        elif isinstance(source[name], h5py.Group):
            _copy_missing(source[name], target[name])
