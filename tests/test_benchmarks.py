"""What the benchmarks of the documentation say to those who lack a run, or hloc."""

import json
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from hloc_reduce.utils.cli import InputError

ROOT = Path(__file__).parents[1]
SUMMARY = {
    "feature": "sift",
    "bytes_per_keypoint": {"descriptor": 256, "keypoints": 6000, "images": 6},
    "map_images": 3,
    "queries": 3,
    "map_points3D": 3871,
    "seconds": {"extract_features": 3.0, "match_features": 1.1},
    "lists": {"night_time": {"localized": 2, "queries": 3, "mean_inliers": 51.6}},
}


def table(*paths):
    command = [sys.executable, ROOT / "benchmarks/summaries.py", *paths]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=60)


def test_what_is_no_finished_run_is_left_out(tmp_path):
    run, report = tmp_path / "sift", tmp_path / "report.html"
    run.mkdir()
    (run / "summary.json").write_text(json.dumps(SUMMARY))
    report.write_text("<html>")
    shown = table(run, report)
    assert shown.returncode == 0 and f"Left out, no finished runs: {report}." in shown.stderr
    assert shown.stdout.splitlines()[2:] == [
        "| sift | 256 | night | 2 of 3 |  |  | 52 | 1,000 | 3,871 | 0.50 | 4 |"
    ]
    old = {**SUMMARY, "bytes_per_keypoint": {"descriptor": 256, "keypoints": 6000}}
    (run / "summary.json").write_text(json.dumps(old))
    assert "| 52 |  | 3,871 |" in table(run).stdout
    alone = table(report)
    assert alone.returncode == 2 and f"no summary.json in {report}" in alone.stderr


def test_recall_in_centimetres_counts_localized_queries_only(tmp_path):
    rows = [
        ("a.jpg", "night_time", "localized", 0.004, 0.1),
        ("b.jpg", "night_time", "localized", 0.03, 0.1),
        ("c.jpg", "night_time", "localized", 0.001, 2.5),  # turned too far
        ("d.jpg", "night_time", "fallback", 0.001, 0.1),
        ("e.jpg", "day_time", "failed", "", ""),
    ]
    header = ("query", "list", "status", "position_error_m", "rotation_error_deg")
    lines = [",".join(map(str, row)) for row in (header, *rows)]
    (tmp_path / "queries.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "summary.json").write_text(json.dumps(SUMMARY))
    shown = table(tmp_path, "--centimetres", "1", "5")
    assert "| 25.0 / 50.0 |" in shown.stdout.splitlines()[2]


def test_places_are_columns(tmp_path):
    for place, feature in (("town", "sift"), ("mill", "sift"), ("town", "sift+uint8")):
        (tmp_path / place / feature).mkdir(parents=True)
        summary = SUMMARY | {"dataset": f"datasets/{place}"}
        (tmp_path / place / feature / "summary.json").write_text(json.dumps(summary))
    shown = table(*sorted(tmp_path.glob("*/*")), "--places").stdout.splitlines()
    assert shown[0] == "| bytes | feature | mill, night | town, night |"
    assert shown[2:] == [
        "| 256 | sift | 52 (2 of 3) | 52 (2 of 3) |",
        "| 256 | sift+uint8 |  | 52 (2 of 3) |",
    ]


def test_without_hloc_the_comparison_says_what_to_install(monkeypatch):
    monkeypatch.setattr("hloc_reduce.utils.hloc.is_installed", lambda: False)
    stages_of = runpy.run_path(str(ROOT / "benchmarks/against_hloc.py"))["stages_of"]
    with pytest.raises(InputError, match="hloc is not installed: pip install"):
        stages_of("hloc")
