"""Batches in which jobs fail, images are unreadable, or the run is killed."""

import errno
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import command
import pytest
from command import table, write

from hloc_reduce import aggregate_features, extract_features
from hloc_reduce.utils.cli import InputError
from pipelines import aachen

pytestmark = pytest.mark.check


def refuse_tfeat(name):
    if name == "tfeat":
        raise InputError("no tfeat")


def test_a_job_that_fails_does_not_stop_the_others(aachen_layout, run_batch, monkeypatch, caplog):
    monkeypatch.setattr(extract_features, "check_weights", refuse_tfeat)
    grid = {"dataset": [str(aachen_layout), "nowhere"], "feature": ["tfeat", "sift_sv16"]}
    with pytest.raises(SystemExit) as exit:
        run_batch(grid)
    assert exit.value.code == 2
    assert "3 jobs failed" in caplog.records[-1].getMessage()
    rows = table(aachen_layout.parent / "out/jobs.csv")
    errors = [(row["dataset"], row["job"], row["error"]) for row in rows if row["error"]]
    nowhere = f"There is no folder {Path('nowhere').absolute()}."
    assert errors == [
        (aachen_layout.name, "tfeat", "no tfeat"),
        ("nowhere", "tfeat", nowhere),
        ("nowhere", "sift_sv16", nowhere),
    ]
    assert [row["recall_percent"] for row in rows if row["list"].startswith("night")] == [
        "100.0"
    ] * 3
    assert "tfeat failed: no tfeat" in run_batch.printed


def test_a_bug_in_one_job_does_not_stop_the_others(aachen_layout, run_batch, monkeypatch, caplog):
    original = aachen.main

    def broken(*args, **kwargs):
        if kwargs["feature"] == "sift":
            raise ZeroDivisionError("a bug")
        return original(*args, **kwargs)

    monkeypatch.setattr(aachen, "main", broken)
    with pytest.raises(SystemExit):
        run_batch({"dataset": str(aachen_layout), "feature": ["sift", "sift_sv16"]})
    assert any(record.exc_info for record in caplog.records)  # the traceback
    assert (aachen_layout.parent / "out" / aachen_layout.name / "sift_sv16/summary.json").exists()


def test_options_that_a_data_set_has_not(inloc_layout, run_batch, caplog):
    with pytest.raises(SystemExit):
        run_batch({"dataset": str(inloc_layout), "num_covis": 3})
    assert "Unknown option for" in caplog.text and "num_covis" in caplog.text


@pytest.mark.parametrize("layout", ["aachen_layout", "inloc_layout"])
def test_unreadable_images(layout, request, run_batch, tmp_path, caplog):
    place = request.getfixturevalue(layout)
    grid = {"dataset": str(place), "feature": ["sift_sv16", "sift_sv64"]}
    whole = run_batch(grid)
    expected = {path.relative_to(whole): path.read_text() for path in whole.rglob("queries.csv")}
    whole.rename(tmp_path / "whole")

    images = place / "images_upright" if layout == "aachen_layout" else place
    broken = next(path for path in sorted(images.rglob("*.[pj][np]g")) if "query" not in str(path))
    absent = next(path for path in images.rglob("*") if path.name in ("a.png", "a.JPG"))
    content = broken.read_bytes(), absent.read_bytes()
    broken.write_bytes(content[0][:1000])
    absent.unlink()
    for _ in range(2):
        outputs = run_batch(grid)
        rows = table(outputs / "failures.csv")
        assert {(row["image"], row["reason"].rpartition(": ")[2]) for row in rows} == {
            (broken.relative_to(images).as_posix(), "it is not an image, or it is truncated."),
            (absent.relative_to(images).as_posix(), "No such file or directory."),
        }
    summary, queries = command.outcome(outputs / place.name / "sift_sv16")
    name = absent.relative_to(images).as_posix()
    assert queries[name]["num_matches"] == "0" and queries[name]["status"] != "localized"
    with pytest.raises(SystemExit):
        run_batch(grid, options=("--strict",))
    assert "Cannot read 2 images" in caplog.text
    errors = [row["error"] for row in table(outputs / "jobs.csv")]
    assert errors and all(broken.name in one and absent.name in one for one in errors)

    broken.write_bytes(content[0])
    absent.write_bytes(content[1])
    run_batch(grid)
    assert table(outputs / "failures.csv") == []
    assert expected == {
        path.relative_to(outputs): path.read_text() for path in outputs.rglob("queries.csv")
    }


def test_two_features_of_one_file_name(aachen_layout, run_batch, tmp_path, caplog):
    grids = []
    for folder, dim in (("f1", 64), ("f2", 16)):
        (tmp_path / folder).mkdir()
        text = f"model: {{name: reduced, base: {{name: dog}}, projection: sift_sv{dim}}}"
        feature = write(tmp_path / folder / "my.yaml", text)
        grids.append({"dataset": str(aachen_layout), "feature": str(feature), "num_loc": dim})
    with pytest.raises(SystemExit):
        run_batch(*grids)
    assert "my+num_loc16: feats-my.h5 is the file of two features" in caplog.text
    rows = table(tmp_path / "out/jobs.csv")
    assert {row["job"]: row["descriptor_bytes"] for row in rows} == {
        "my+num_loc64": "128",
        "my+num_loc16": "",
    }


def test_retrieval_that_fails_concerns_its_own_jobs(
    aachen_layout, run_batch, tmp_path, monkeypatch
):
    own = write(tmp_path / "pairs-query-own.txt", "query/day/a.png db/0.png\n")
    grid = {"dataset": str(aachen_layout), "feature": "sift_sv16", "retrieval": ["vlad", str(own)]}

    def broken(*_, **__):
        raise InputError("no VLAD")

    monkeypatch.setattr(aggregate_features, "main", broken)
    with pytest.raises(SystemExit):
        run_batch(grid)
    rows = table(tmp_path / "out/jobs.csv")
    assert {row["job"]: row["error"] for row in rows} == {
        "sift_sv16": "no VLAD",
        "sift_sv16+own": "",
    }


def test_a_full_disk_ends_a_batch(aachen_layout, run_batch, monkeypatch, caplog):
    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "a file")

    monkeypatch.setattr(aachen, "main", full)
    with pytest.raises(SystemExit):
        run_batch({"dataset": str(aachen_layout), "feature": ["sift", "sift_sv16"]})
    (line,) = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
    assert line == "a file: No space left on device."


def test_what_can_be_known_is_refused_before_any_work(
    aachen_layout, inloc_layout, run_batch, caplog
):
    (aachen_layout / "images_upright/query/night/a.png").unlink()
    (aachen_layout / "images_upright/query/night").rmdir()
    next(inloc_layout.rglob("*.mat")).unlink()
    with pytest.raises(SystemExit):
        run_batch(
            {"dataset": [str(aachen_layout), str(inloc_layout)]},
            {"dataset": str(inloc_layout), "ground_truth": "nowhere.txt", "num_loc": 1},
            options=("--dry_run",),
        )
    errors = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
    assert len(errors) == 4 and "3 jobs failed" in errors[3]
    assert "lacks" in errors[0] and "query/night" in errors[0]
    assert "lacks 1 files of scans" in errors[1]


@pytest.mark.long
def test_a_batch_that_is_killed_again_and_again_goes_on(aachen_layout, tmp_path):
    grid = {"dataset": str(aachen_layout), "feature": ["sift_sv64", "sift_sv16", "colmap_sift"]}
    job_file = write(tmp_path / "jobs.yaml", json.dumps({"jobs": [grid]}))

    def run(outputs, limit=None):
        command_line = [sys.executable, "-m", "pipelines.batch", job_file, "--outputs", outputs]
        process = subprocess.Popen(command_line, stderr=-1, stdout=-1, start_new_session=True)
        try:
            process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
        return process.returncode

    start = time.perf_counter()
    assert run(tmp_path / "whole") == 0
    seconds = time.perf_counter() - start
    draw, kills = random.Random(0), 0
    for _ in range(20):
        code = run(tmp_path / "killed", seconds * draw.uniform(0.2, 0.6))
        kills += code == -signal.SIGKILL
        if code == 0:
            shutil.rmtree(tmp_path / "killed")
    assert kills >= 10
    assert run(tmp_path / "killed") == 0
    whole, killed = (
        {
            path.relative_to(tmp_path / name): path.read_text()
            for pattern in ("queries.csv", "*_hloc_*.txt", "pairs*.txt", "failures.csv")
            for path in (tmp_path / name).rglob(pattern)
        }
        for name in ("whole", "killed")
    )
    assert whole == killed and len(whole) == 3 * 4 + 2
    for path in (tmp_path / "whole").rglob("*.h5"):
        other = tmp_path / "killed" / path.relative_to(tmp_path / "whole")
        assert command.contents(path) == command.contents(other)
    assert not [path for path in (tmp_path / "killed").rglob("*.tmp")]
