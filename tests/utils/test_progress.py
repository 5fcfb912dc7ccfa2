"""Bars on a terminal, and at most a line a minute elsewhere."""

import ast
import logging
import re
import sys
from pathlib import Path

import pytest

from hloc_reduce import match_features
from hloc_reduce.utils import cli, progress
from hloc_reduce.utils.parsers import write_pairs

ROOT = Path(__file__).parents[2]


@pytest.fixture
def lines(monkeypatch, caplog):
    """The lines that are logged."""
    monkeypatch.setattr(cli.logger, "propagate", True)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    caplog.set_level(logging.INFO)
    return lambda: [r.getMessage() for r in caplog.records]


@pytest.fixture
def pass_time(monkeypatch):
    """Have seconds pass."""
    now = [1000.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])

    def wait(seconds):
        now[0] += seconds

    return wait


def test_a_line_a_minute(lines, pass_time, capsys):
    for _ in progress.progress(range(8000), "Matching", "pair"):
        pass_time(1 / 16)
    assert lines() == [
        "Matching: 960 of 8,000 pairs (12 %), 7 min left",
        "Matching: 1,920 of 8,000 pairs (24 %), 6 min left",
        "Matching: 2,880 of 8,000 pairs (36 %), 5 min left",
        "Matching: 3,840 of 8,000 pairs (48 %), 4 min left",
        "Matching: 4,800 of 8,000 pairs (60 %), 3 min left",
        "Matching: 5,760 of 8,000 pairs (72 %), 2 min left",
        "Matching: 6,720 of 8,000 pairs (84 %), 80 s left",
        "Matching: 7,680 of 8,000 pairs (96 %), 20 s left",
    ]
    assert "\r" not in capsys.readouterr().err


def test_short_work_says_nothing(lines, pass_time, capfd):
    for _ in range(5):  # one loop after the other
        assert list(progress.progress(iter("abc"), "Reading", "file", 3)) == ["a", "b", "c"]
        pass_time(30)
    assert not lines() and capfd.readouterr().err == ""


def test_resumed_work_says_what_is_left(lines, pass_time):
    """The rate is that of what was done by this run."""
    with progress.progress(None, "Localizing", "query", 1000, 400) as shown:
        pass_time(3600)
        shown.set_postfix(loss="0.5", refresh=False)
        shown.update(100)
    assert lines() == ["Localizing: 500 of 1,000 queries (50 %), 5.0 h left, loss 0.5"]


def test_work_of_unknown_length(lines, pass_time):
    for _ in progress.progress(iter(range(3)), "Drawing", "pair"):
        pass_time(61)
    assert lines() == [f"Drawing: {number} pairs" for number in (1, 2, 3)]


def test_a_bar_on_a_terminal(monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    for _ in progress.progress(range(3), "Matching", "pair", 4, 1):
        pass
    assert re.search(r"\rMatching: 100%\|.*\| 4/4 \[.*pair/s\]", capsys.readouterr().err)


def test_a_stage_writes_no_bar_into_a_log_file(scene, lines, capfd):
    pairs = scene.root / "pairs.txt"
    write_pairs([("db/0.jpg", "db/1.jpg")], pairs)
    conf = match_features.confs["NN-ratio"]
    match_features.main(conf, pairs, scene.features, matches=scene.root / "m.h5")
    assert "%|" not in capfd.readouterr().err


def test_every_loop_goes_through_one_place():
    """Nothing else imports tqdm."""
    importing = set()
    for folder in ("confs", "hloc_reduce", "pipelines", "benchmarks"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Import):
                    names = [alias.name for alias in node.names]
                elif isinstance(node, ast.ImportFrom):
                    names = [node.module or ""]
                else:
                    continue
                if any(name.split(".")[0] == "tqdm" for name in names):
                    importing.add(path.relative_to(ROOT).as_posix())
    assert importing == {"hloc_reduce/utils/progress.py"}
