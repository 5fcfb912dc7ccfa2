"""How tests run a pipeline as a user does, and what it left."""

import csv
import json
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import h5py
import pytest

from hloc_reduce.runtime.outputs import LOCK
from hloc_reduce.utils import cli
from hloc_reduce.utils.h5 import iterate_h5_names


def run(monkeypatch: pytest.MonkeyPatch, pipeline: ModuleType, *arguments) -> None:
    """Run its command line."""
    monkeypatch.setattr(sys, "argv", [pipeline.__name__, *map(str, arguments)])
    is_package = hasattr(pipeline, "__path__")
    cli.run((import_module(f"{pipeline.__name__}.__main__") if is_package else pipeline)._main)


def refused(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    pipeline: ModuleType,
    *arguments,
) -> str:
    """Run with wrong input: exit code 2, one or two lines, no traceback; return the message."""
    caplog.clear()
    with pytest.raises(SystemExit) as exit:
        run(monkeypatch, pipeline, *arguments)
    assert exit.value.code == 2
    (message,) = [r.getMessage() for r in caplog.records if r.levelname == "ERROR"]
    assert message.count("\n") < 2
    return message


def outcome(outputs: Path) -> tuple[dict, dict[str, dict]]:
    """Return the summary of a run, and the rows of queries.csv by query."""
    with (outputs / "queries.csv").open() as file:
        rows = {row["query"]: row for row in csv.DictReader(file)}
    return json.loads((outputs / "summary.json").read_text()), rows


def table(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def state(folder: Path) -> dict[Path, int]:
    """Return when each file in a folder was written."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != LOCK)
    return {path: path.stat().st_mtime_ns for path in files}


def contents(path: Path) -> dict:
    """Return all data sets of an h5 file with their attributes, and those of the file."""
    with h5py.File(path) as file:
        # but the id, and what has ids of other files
        found = {"": {key: v for key, v in file.attrs.items() if key not in ("id", "conf")}}
        for name in iterate_h5_names(file.id):
            for key, dataset in file[name].items():
                found[f"{name}/{key}"] = dataset[()].tobytes(), dict(dataset.attrs)
    return found


def results(outputs: Path) -> tuple:
    """Return what a run left, but for what says when and where it ran."""
    summary, rows = outcome(outputs)
    for key in ("seconds", "bytes"):
        del summary[key]
    del summary["bytes_per_keypoint"]["feature_file"]  # pieces take more or less space in a file
    poses = (outputs / summary["poses"]).read_text()
    return summary, rows, poses, {path.name: contents(path) for path in outputs.glob("*.h5")}
