"""Outputs folders, each for one configuration."""

import fcntl
import glob
import json
import os
import platform
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .. import logger
from ..utils.cli import InputError, make_folder
from ..utils.files import delete, observing
from . import provenance, trace

LOCK = ".lock"  # in an outputs folder
SHARED = "shared"  # folder of the files that the jobs of a batch share on a data set
CONF = "conf.json"
STAGES = "stages.json"
FILES = "files.json"  # names of the files and folders that runs wrote, noted before they write
WRITTEN_LAST = ("map.json", "queries.csv", "summary.json")  # mark a finished run, so deleted first
BOOKKEEPING = {CONF, STAGES, FILES, "summary.json", "queries.csv", "trace.json"}
DELETING = {"is": "being deleted"}  # configuration of a folder whose deletion was interrupted
MAX_NAMED_DIFFERENCES = 3  # in a message
MAX_SHOWN_CHARACTERS = 60  # of values in it
REMEDY = "Choose other --outputs, one folder for each configuration, or --overwrite."


class Lock:
    """A folder that no other run may write to, until `release` or the end of a `with` block.

    The operating system releases the lock when the process ends, however it ends.

    Args:
        folder: created if missing.
        wait: for another run that has locked it.

    Raises:
        InputError: when it is a file, or another run has locked it and `wait` is false.
    """

    def __init__(self, folder: Path, wait: bool = False):
        make_folder(folder)
        self.file = None
        if not os.access(folder, os.W_OK):  # nobody writes to it
            return
        self.file = (folder / LOCK).open("a+")
        try:
            fcntl.flock(self.file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.file.seek(0)
            who = f"Another run is at work in {folder} ({self.file.read()})."
            if not wait:
                self.file.close()
                raise InputError(who) from None
            logger.info("%s Waiting for it.", who)
            fcntl.flock(self.file, fcntl.LOCK_EX)
        except OSError as error:
            logger.warning("%s cannot be locked (%s): start no second run in it.", folder, error)
        with suppress(OSError):  # of a full disk; the folder is locked all the same
            self.file.truncate(0)
            self.file.write(f"process {os.getpid()} on {platform.node()}")
            self.file.flush()

    def __enter__(self) -> "Lock":
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def release(self) -> None:
        """Release the lock."""
        if self.file is not None:
            self.file.close()


class RunFolder:
    """An outputs folder that belongs to one configuration and records what its stages did.

    In a `with` block no other run can write to it, and the names of all files that are written in
    it are recorded.

    Args:
        path: the folder; created if missing.
        conf: what determines the results.
        overwrite: delete everything that earlier runs wrote, according to the folder's record, and
            take this configuration. An interrupted run resumes without `overwrite`.
        inputs: files and folders that the run reads; they must not be deleted.
        stale: delete earlier results even if they have the same configuration.
        kept: names of files that are never deleted.
        remedy: what to do if the folder has another configuration.

    Attributes:
        written: names of the files and folders that runs wrote.

    Raises:
        InputError: when the folder has results of another configuration, an input would be
            deleted, or another run is at work in it.
    """

    def __init__(
        self,
        path: Path,
        conf: dict,
        overwrite: bool,
        inputs: Iterable[Path] = (),
        stale: bool = False,
        kept: Iterable[str] = (),
        remedy: str = REMEDY,
    ):
        self.path, self.kept, self.remedy = path, {*kept}, remedy
        self._lock = Lock(path)
        try:
            self.written = self._read_written()
            self._drop_temporaries()
            self._claim(conf, overwrite, inputs, stale)
        except BaseException:
            self._lock.release()
            raise

    def __enter__(self) -> "RunFolder":
        self._observing = observing(self._note)
        self._observing.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._observing.__exit__(None, None, None)
        self._lock.release()

    def _stages(self) -> dict:
        return provenance.read(self.path / STAGES)

    def _read_written(self) -> set[str]:
        """Return the names of the files and folders that runs wrote."""
        noted = provenance.read(self.path / FILES).get("written")
        if noted is None:  # of a version without this record
            noted = [name for stage in self._stages().values() for name in stage["wrote"]]
            noted += WRITTEN_LAST if noted else ()
        names = {str(name) for name in noted}
        return {name for name in names if Path(name).name == name and name not in self.kept}

    def _note(self, path: Path) -> None:
        """Record the file or folder of this folder that contains `path`, before it is written."""
        if not path.resolve().is_relative_to(self.path.resolve()):
            return
        name = path.resolve().relative_to(self.path.resolve()).parts[0]
        if name not in self.written | self.kept | (BOOKKEEPING - {*WRITTEN_LAST}):
            self.written.add(name)
            provenance.write(self.path / FILES, {"written": sorted(self.written)})

    def delete(self, names: Iterable[str]) -> None:
        """Delete files and folders that runs wrote; others are left alone."""
        for name in [name for name in names if name in self.written]:
            delete(self.path / name)
            self.written.discard(name)

    def _drop_temporaries(self) -> None:
        """Delete the temporary files of a killed run."""
        for name in (*self.written, *BOOKKEEPING):
            for left in self.path.glob(f".{glob.escape(name)}.*tmp"):
                delete(left)

    def _claim(self, conf: dict, overwrite: bool, inputs: Iterable[Path], stale: bool) -> None:
        """Check the configuration of the folder, or delete earlier results and set it."""
        path, conf_file = self.path, self.path / CONF
        conf = json.loads(json.dumps(conf))
        is_new = not conf_file.exists()
        if not is_new and not overwrite:
            try:
                before = dict(json.loads(conf_file.read_text()))
            except (ValueError, TypeError):
                raise InputError(f"{conf_file} is broken: use --overwrite.") from None
            changes = _changes(before, conf)
            overwrite = before == DELETING or stale and not changes
            if changes and not overwrite:
                named = " and ".join(f"{key}{which}" for key, which in changes.items())
                raise InputError(f"What {path} was made from differs: {named}. {self.remedy}")
        if not is_new and overwrite:
            for file in inputs:
                if path.resolve() in file.resolve().parents:
                    raise InputError(f"{file} is in {path}, which --overwrite deletes: move it.")
            # if the deletion is interrupted, the next run completes it
            provenance.write(conf_file, DELETING)
            self.delete(sorted(self.written, key=lambda name: name not in WRITTEN_LAST))
            for name in (STAGES, FILES):
                delete(path / name)
        if is_new or overwrite:
            provenance.write(conf_file, conf)

    def seconds(self) -> dict[str, float]:
        """Return the seconds of each stage, summed over all runs."""
        return {name: stage["seconds"] for name, stage in self._stages().items()}

    def bytes(self) -> dict[str, int]:
        """Return the size of the files and folders that each stage wrote."""
        sizes = {name: size for name, (size, _) in self._contents().items()}
        return {
            name: sum(sizes.get(written, 0) for written in stage["wrote"])
            for name, stage in self._stages().items()
        }

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage, a failed one too, and record what it wrote."""
        contents, start = self._contents(), time.perf_counter()
        try:
            with trace.span(name):
                yield
        except BaseException:
            with suppress(OSError):  # of a full disk: the error in the stage says more
                self._measure(name, contents, start)
            raise
        self._measure(name, contents, start)

    def _measure(self, name: str, contents: dict, start: float) -> None:
        """Record the seconds of a stage and the files that changed during it."""
        stages = self._stages()
        changed = {
            written for written, state in self._contents().items() if contents.get(written) != state
        }
        if changed or name not in stages:  # a run that finds everything done does not count
            before = stages.get(name, {"seconds": 0.0, "wrote": []})
            spent = before["seconds"] + time.perf_counter() - start
            wrote = sorted(changed.union(before["wrote"]))
            stages[name] = {"seconds": round(spent, 3), "wrote": wrote}
            provenance.write(self.path / STAGES, stages)

    def _contents(self) -> dict[str, tuple[int, int]]:
        """Return the size and the last change of each file and folder, by name."""
        contents = {}
        for path in self.path.iterdir():
            if path.name in BOOKKEEPING or path.name.startswith("."):
                continue
            files = [path] if path.is_file() else [p for p in path.rglob("[!.]*") if p.is_file()]
            states = [file.stat() for file in files]
            contents[path.name] = (
                sum(state.st_size for state in states),
                max((state.st_mtime_ns for state in states), default=0),
            )
        return contents


def _changes(before: dict, after: dict) -> dict[str, str]:
    """Return the keys whose values differ, with what differs in them."""
    changes = {}
    for key in {**before, **after}:
        if before.get(key) != after.get(key):
            old, new = (_leaves(one[key]) if key in one else {} for one in (before, after))
            names = [name for name in {**old, **new} if old.get(name) != new.get(name)]
            said = []
            for name in names[:MAX_NAMED_DIFFERENCES]:
                values = f"{old.get(name, 'not given')} before, {new.get(name, 'not given')} now"
                said.append(
                    f"{name} {values}".strip() if len(values) < MAX_SHOWN_CHARACTERS else name
                )
            more = ", ..." if len(names) > MAX_NAMED_DIFFERENCES else ""
            changes[key] = f" ({', '.join(said)}{more})" if any(said) else ""
    return changes


def _leaves(value: object, name: str = "") -> dict[str, object]:
    """Return the values in nested dicts by the names of their keys."""
    if not isinstance(value, dict):
        return {name: value}
    return {key: leaf for name in value for key, leaf in _leaves(value[name], name).items()}
