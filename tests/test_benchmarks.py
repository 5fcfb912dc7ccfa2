"""Rows that benchmarks write, and the documentation that is made from them."""

import csv
import json
import re
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import yaml

from benchmarks import accuracy, against_hloc, render, rows
from hloc_reduce.utils.cli import InputError
from pipelines.batch import jobs
from pipelines.batch.jobs import Job

ROOT = Path(__file__).parents[1]


@pytest.fixture
def results(tmp_path, monkeypatch):
    monkeypatch.setattr(rows, "RESULTS", tmp_path / "results")
    return tmp_path / "results"


def row(feature, **cells):
    return {"place": "mill", "feature": feature, "inliers": 3} | cells


def test_a_row_replaces_one_of_the_same(results):
    rows.add("accuracy", [row("sift"), row("mkd")])
    rows.add("accuracy", [row("sift", inliers=4.0, recall=None), row("sift", storage="uint8")])
    found = rows.read("accuracy")
    assert [(each["feature"], each["storage"], each["inliers"]) for each in found] == [
        ("mkd", "", "3"),
        ("sift", "", "4"),
        ("sift", "uint8", "3"),
    ]
    assert rows.select(found, feature="sift", storage="uint8") == found[2:]
    assert found[0]["recall"] == ""
    assert not rows.read("maps")


def test_a_row_says_who_measured_it():
    how = rows.how(2.5, cores=2)
    assert how["seconds"] == 2.5 and how["machine"].endswith(", 2 cores")
    assert how["commit"] and how["command"].startswith("python -m ")


def test_localized_queries_count_by_their_errors():
    errors = [(0.004, 0.1), (0.03, 0.1), (0.001, 2.5), (float("inf"), float("inf"))]
    found = rows.localization(errors, [10, 20, 30, 0], localized=3)
    assert (found["queries"], found["localized"], found["inliers"]) == (4, 3, 15)
    # the third one is turned too far
    assert [found[f"within_{limit}cm"] for limit in rows.CENTIMETRES] == [1, 1, 2, 2]
    assert found["median_cm"] == pytest.approx(0.4) and found["largest_cm"] == pytest.approx(3)
    nothing = rows.localization([(float("inf"),) * 2], [0], localized=0)
    assert nothing["median_cm"] is nothing["largest_cm"] is None


def test_rows_of_a_finished_run(tmp_path, results):
    summary = {
        "bytes_per_keypoint": {"descriptor": 8, "keypoints": 6000, "images": 6},
        "map_images": 3,
        "map_points3D": 3871,
        "map_bytes": 2_500_000,
        "seconds": {"extract_features": 3.0, "match_map": 1.0, "localization": 0.5},
        "lists": {"night_time": {"localized": 1, "queries": 2}},
    }
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    with (tmp_path / "queries.csv").open("w", newline="") as file:
        header = "query,list,status,position_error_m,rotation_error_deg,num_inliers"
        writer = csv.DictWriter(file, header.split(","))
        writer.writeheader()
        for line in (
            "a.jpg,night_time,localized,0.004,0.1,51",
            "b.jpg,night_time,fallback,0.001,0.1,3",
            "c.jpg,day_time,failed,,,0",
        ):
            writer.writerow(dict(zip(header.split(","), line.split(","), strict=True)))
    job = Job(
        dataset=Path("datasets/mill"),
        feature="colmap_sift_sv32",
        matcher="NN-ratio",
        storage="uint2",
        num_loc=20,
    )
    rows.add("accuracy", [accuracy.what(job) | cells for cells in accuracy.measured(tmp_path)])
    (found,) = rows.read("accuracy")
    expected = {"place": "mill", "list": "night", "storage": "uint2", "variant": "num_loc20"}
    expected |= {"queries": "2", "within_1cm": "1", "inliers": "27", "keypoints": "1000"}
    expected |= {"points": "3871", "mb": "2.5", "seconds": "1.5", "bytes": "8"}
    assert expected.items() <= found.items()
    assert rows.select(rows.read("accuracy"), **accuracy.what(job))


def test_pages_show_what_the_rows_say(monkeypatch):
    monkeypatch.chdir(ROOT)
    for page in render.PAGES:
        text = Path(page).read_text()
        assert render.rendered(text) == text, f"{page}: run python -m benchmarks.render"


@pytest.mark.skipif(
    find_spec("matplotlib") is None
    or f"matplotlib=={version('matplotlib')}\n" not in (ROOT / "constraints.txt").read_text(),
    reason="figures are drawn by the matplotlib of constraints.txt",
)
@pytest.mark.parametrize("name", render.FIGURES)
def test_figures_show_what_the_rows_say(name, monkeypatch):
    monkeypatch.chdir(ROOT)
    number = re.compile(r"-?\d+\.\d+")
    committed, drawn = Path(name).read_text(), render.figure(name)
    assert number.sub("", committed) == number.sub("", drawn), "run python -m benchmarks.render"
    values = [np.array(number.findall(text), float) for text in (committed, drawn)]
    np.testing.assert_allclose(*values, atol=0.01, err_msg="run python -m benchmarks.render")


def test_without_hloc_the_comparison_says_what_to_install(monkeypatch):
    monkeypatch.setattr("hloc_reduce.utils.hloc.is_installed", lambda: False)
    with pytest.raises(InputError, match="hloc is not installed: pip install"):
        against_hloc.stages_of("hloc")


def test_jobs_without_rows_are_written_as_they_were_read(tmp_path):
    read = jobs.read(Path(__file__).parents[1] / "results/accuracy.yaml")[1]
    path = tmp_path / "missing.yaml"
    path.write_text(yaml.safe_dump({"jobs": [accuracy._options(job) for job in read]}))
    assert jobs.read(path)[1] == read
