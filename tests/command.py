"""How tests run a pipeline as a user does."""

import csv
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

from hloc_reduce import cli


def run(monkeypatch: pytest.MonkeyPatch, pipeline: ModuleType, *arguments) -> None:
    """Run its command line."""
    monkeypatch.setattr(sys, "argv", [pipeline.__name__, *map(str, arguments)])
    cli.run(pipeline._main)


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
