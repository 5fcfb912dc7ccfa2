"""Outputs folders, each of one configuration."""

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
from ..utils.cli import InputError
from ..utils.files import delete, observing, replacing
from . import provenance, trace

LOCK = ".lock"  # in an outputs folder
SHARED = "shared"  # folder of what the jobs of a batch have in common on a data set


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
        with suppress(OSError):  # of a full disk: it is locked all the same
            self.file.truncate(0)
            self.file.write(f"process {os.getpid()} on {platform.node()}")
            self.file.flush()

    def release(self) -> None:
        """Let others have it."""
        if self.file is not None:
            self.file.close()


STAGES = "stages.json"
FILES = "files.json"  # names of what runs wrote in their folder, noted before it is written
WHOLE = ("map.json", "queries.csv", "summary.json")  # say that a run is whole, so deleted first
BOOKKEEPING = {"conf.json", STAGES, FILES, "summary.json", "queries.csv", "trace.json"}
DELETING = {"is": "being deleted"}
NAMED = 3  # differences that a message names
SHORT = 40  # characters of values that it quotes


class RunFolder:
    """An output folder that belongs to one configuration and knows how long its stages took.

    In a `with` block no other run can write to it, and what is written in it is noted.

    Args:
        path: the folder; made if need be.
        conf: what determines the results.
        overwrite: begin anew, with this configuration; what runs wrote in the folder, by its
            record, is deleted first, so that a run that is stopped can go on without `overwrite`.
        inputs: files and folders that the run reads, which are not to be deleted.
        stale: where the configuration is the same, begin anew all the same: what the results
            were made from has changed.
        kept: names of files that stay all the same.

    Attributes:
        written: names of the files and folders that runs wrote in it.

    Raises:
        InputError: when the folder holds results of another configuration, or an input that would
            be deleted, or another run is at work in it.
    """

    def __init__(
        self,
        path: Path,
        conf: dict,
        overwrite: bool,
        inputs: Iterable[Path] = (),
        stale: bool = False,
        kept: Iterable[str] = (),
    ):
        self.path, self._stages_file, self.kept = path, path / STAGES, {*kept}
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

    def _read_written(self) -> set[str]:
        """Return the names of what runs wrote in the folder."""
        noted = provenance.read(self.path / FILES).get("written")
        if noted is None:  # of a run before there was this record
            stages = provenance.read(self._stages_file).values()
            noted = [name for stage in stages for name in stage["wrote"]]
            noted += WHOLE if noted else ()
        names = {str(name) for name in noted}
        return {name for name in names if Path(name).name == name and name not in self.kept}

    def _note(self, path: Path) -> None:
        """Note, before it is written, the file or folder in this one that a path leads to."""
        if not path.resolve().is_relative_to(self.path.resolve()):
            return
        name = path.resolve().relative_to(self.path.resolve()).parts[0]
        if (
            name not in self.written
            and name not in self.kept
            and name not in BOOKKEEPING - {*WHOLE}
        ):
            self.written.add(name)
            provenance.write(self.path / FILES, {"written": sorted(self.written)})

    def delete(self, names: Iterable[str]) -> None:
        """Delete files and folders that runs wrote; those of other names are left alone."""
        for name in [name for name in names if name in self.written]:
            delete(self.path / name)
            self.written.discard(name)

    def _drop_temporaries(self) -> None:
        """Delete what a killed run left: only who has the lock makes these."""
        for name in (*self.written, *BOOKKEEPING):
            for left in self.path.glob(f".{glob.escape(name)}.*tmp"):
                delete(left)

    def _claim(self, conf: dict, overwrite: bool, inputs: Iterable[Path], stale: bool) -> None:
        """Check that the folder is of a configuration, or make it so."""
        path, conf_file = self.path, self.path / "conf.json"
        conf = json.loads(json.dumps(conf))
        before = None
        if conf_file.exists() and not overwrite:
            try:
                before = dict(json.loads(conf_file.read_text()))
            except (ValueError, TypeError):
                raise InputError(f"{conf_file} is broken: use --overwrite.") from None
            changes = _changes(before, conf)
            if before == DELETING or not changes and stale:
                overwrite = True
            elif changes:
                named = " and ".join(f"{key}{which}" for key, which in changes.items())
                raise InputError(
                    f"What {path} was made from differs: {named}. "
                    "Choose other --outputs, one folder for each configuration, or --overwrite."
                )
        if overwrite and conf_file.exists():
            for file in inputs:
                if path.resolve() in file.resolve().parents:
                    raise InputError(f"{file} is in {path}, which is to be made anew: move it.")
            # whoever finds this, because the deletion was cut short, deletes again
            with replacing(conf_file) as temporary:
                temporary.write_text(json.dumps(DELETING))
            self.delete(sorted(self.written, key=lambda name: name not in WHOLE))
            for name in (STAGES, FILES):
                delete(path / name)
        if overwrite or before is None:
            with replacing(conf_file) as temporary:
                temporary.write_text(json.dumps(conf, indent=1))

    def seconds(self) -> dict[str, float]:
        """Return how long each stage took, all runs together."""
        return {
            name: stage["seconds"] for name, stage in provenance.read(self._stages_file).items()
        }

    def bytes(self) -> dict[str, int]:
        """Return how large the files and folders are that each stage wrote."""
        sizes = {name: size for name, (size, _) in self._contents().items()}
        return {
            name: sum(sizes.get(written, 0) for written in stage["wrote"])
            for name, stage in provenance.read(self._stages_file).items()
        }

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure a stage; what a run that failed spent counts too."""
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
        """Write down what a stage spent and wrote since a time when there were other contents."""
        stages = provenance.read(self._stages_file)
        changed = {
            written for written, state in self._contents().items() if contents.get(written) != state
        }
        if changed or name not in stages:  # a look at what is there does not count
            before = stages.get(name, {"seconds": 0.0, "wrote": []})
            spent = before["seconds"] + time.perf_counter() - start
            wrote = sorted(changed.union(before["wrote"]))
            stages[name] = {"seconds": round(spent, 3), "wrote": wrote}
            provenance.write(self._stages_file, stages)

    def _contents(self) -> dict[str, tuple[int, int]]:
        """Return the size and the time of the last change of all that stages wrote, by name."""
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
    """Return the keys whose values differ, each with the entries that differ where it has some."""
    changes = {}
    for key in {**before, **after}:
        old, new = before.get(key), after.get(key)
        if old == new:
            continue
        changes[key] = ""
        if isinstance(old, dict) and isinstance(new, dict):
            names = [name for name in {**old, **new} if old.get(name) != new.get(name)]
            more = ", ..." if len(names) > NAMED else ""
            said = [
                f"{name} {old.get(name, 'not given')} before, {new.get(name, 'not given')} now"
                if len(f"{old.get(name)}{new.get(name)}") < SHORT
                else name
                for name in names[:NAMED]
            ]
            changes[key] = f" ({', '.join(said)}{more})"
    return changes
