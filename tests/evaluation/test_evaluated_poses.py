"""Errors of poses that were computed by hand, and those of a run."""

import csv
import json

import numpy as np
import pytest
from command import outcome, refused, run
from pycolmap import Rigid3d, Rotation3d

from hloc_reduce.evaluation import __main__ as evaluation
from hloc_reduce.evaluation import poses
from hloc_reduce.localization.records import RECORDS
from hloc_reduce.utils import cli
from hloc_reduce.utils.parsers import write_poses
from pipelines import aachen


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def rigid(x, degrees=0.0):
    half = np.radians(degrees) / 2
    rotation = Rotation3d(np.array([0, 0, np.sin(half), np.cos(half)]))
    return Rigid3d(rotation, rotation.matrix() @ np.array([-x, 0.0, 0.0]))


@pytest.fixture
def two_lists(tmp_path):
    """True poses of four queries by day, two by night; estimates by base names, one missing."""
    truth = {f"query/day/{i}.jpg": rigid(i) for i in range(4)}
    truth |= {f"query/night/n{i}.jpg": rigid(i) for i in range(2)}
    estimates = {
        "0.jpg": rigid(0.1, 1),
        "1.jpg": rigid(1.4, 1),
        "2.jpg": rigid(2.1, 3),
        "n0.jpg": rigid(0.4, 1),
        "n1.jpg": rigid(8, 170),
    }
    write_poses(truth, tmp_path / "truth.txt", None)
    write_poses(estimates, tmp_path / "poses.txt")
    return tmp_path


@pytest.fixture
def evaluate(two_lists, monkeypatch, capsys):
    """Evaluate a file of estimates of `two_lists`; return what is printed."""

    def evaluate(estimates, *options):
        files = ("--estimates", two_lists / estimates, "--ground_truth", two_lists / "truth.txt")
        run(monkeypatch, evaluation, "poses", *files, "--outputs", two_lists / "o", *options)
        return capsys.readouterr().out

    return evaluate


def test_poses(two_lists, evaluate):
    printed = evaluate("poses.txt")
    # by day 0 within all, 1 and 2 within (0.5 m, 5 deg), 3 missing; by night n0 within all
    assert "25.0 / 75.0 / 75.0" in printed and "50.0 / 50.0 / 50.0" in printed
    # of 0.1, 0.4, 0.1, inf m and 1, 1, 3, inf deg
    assert "day: 4 queries, median errors 0.250 m, 2.000 deg" in printed
    assert printed.splitlines()[-2:] == ["Failures without a pose: 1", "query/day/3.jpg"]
    rows = rows_of(two_lists / "o/errors.csv")
    assert len(rows) == 6 and rows[3]["position_error_m"] == ""
    assert [row["status"] for row in rows] == [*["localized"] * 3, "failed", *["localized"] * 2]
    assert float(rows[1]["position_error_m"]) == pytest.approx(0.4)
    curve = [
        (float(row["value"]), float(row["percent"]))
        for row in rows_of(two_lists / "o/curves.csv")
        if (row["list"], row["error"]) == ("day", "m")
    ]
    np.testing.assert_allclose(curve, [(0.1, 25), (0.1, 50), (0.4, 75)], atol=1e-9)
    assert "position error" in (two_lists / "o/curves.svg").read_text()


@pytest.mark.parametrize(
    ("thresholds", "recall"),
    [(("0.15,2", "1,180"), "16.7 / 66.7"), (("inloc",), "33.3 / 66.7 / 66.7")],
)
def test_recall_at_other_thresholds(evaluate, thresholds, recall):
    assert recall in evaluate("poses.txt", "--thresholds", *thresholds)


def test_whole_names_of_estimates_come_first():
    truth = {name: rigid(0) for name in ("sub/x.jpg", "x.jpg")}
    assert poses.find_estimates({"x.jpg": rigid(1)}, truth).keys() == {"x.jpg"}
    assert poses.find_estimates({"sub/x.jpg": rigid(1)}, truth).keys() == {"sub/x.jpg"}


def test_poses_of_a_pipeline_are_evaluated_as_in_its_summary(
    aachen_layout, tmp_path, monkeypatch, capsys
):
    outputs = tmp_path / "o"
    given = ("--dataset", aachen_layout, "--outputs", outputs, "--feature", "colmap_sift_sv16")
    run(monkeypatch, aachen, *given)
    capsys.readouterr()
    summary, expected = outcome(outputs)
    (logs,) = outputs.glob("*_logs.jsonl")
    truth = aachen_layout / "queries/ground_truth_poses.txt"
    files = ("--estimates", logs, "--ground_truth", truth, "--outputs", tmp_path / "e")
    run(monkeypatch, evaluation, "poses", *files)
    printed = capsys.readouterr().out
    assert "50.0 / 50.0 / 50.0" in printed and "100.0 / 100.0 / 100.0" in printed
    for name, of_list in summary["lists"].items():
        medians = [of_list[f"median_{key}"] for key in ("position_error_m", "rotation_error_deg")]
        said = "{}: {} queries, median errors {:.3f} m, {:.3f} deg"
        assert said.format(name.split("_")[0], of_list["queries"], *medians) in printed
    assert printed.endswith("Failures with a fallback pose: 1\nquery/day/grey.png\n")
    for row in rows_of(tmp_path / "e/errors.csv"):
        for key in ("status", "position_error_m", "rotation_error_deg"):
            assert row[key] == expected[row["query"]][key]


def test_fallbacks_only(two_lists, evaluate):
    """What a run leaves that localized nothing."""
    record = {"localized": False, "qvec": [1, 0, 0, 0], "tvec": [0, 0, 0]}
    lines = [{"records": RECORDS}, ["query/day/0.jpg", record]]
    (two_lists / "p_logs.jsonl").write_text("\n".join(map(json.dumps, lines)) + "\n")
    printed = evaluate("p_logs.jsonl")
    assert "0.0 / 0.0 / 0.0" in printed and "Failures with a fallback pose: 1" in printed
    assert (two_lists / "o/curves.csv").read_text() == "list,error,value,percent\n"


def test_exact_poses_and_unknown_names(two_lists, evaluate, monkeypatch, caplog, recwarn):
    """On a logarithmic axis there is no 0."""
    lines = (two_lists / "truth.txt").read_text()
    (two_lists / "exact.txt").write_text(lines + lines.splitlines()[0].replace("day/0", "day/O"))
    monkeypatch.setattr(cli.logger, "propagate", True)
    assert "day: 4 queries, median errors 0.000 m, 0.000 deg" in evaluate("exact.txt")
    assert "1 estimates are of other queries: query/day/O.jpg." in caplog.text
    assert not list(recwarn)


@pytest.fixture
def message(two_lists, monkeypatch, caplog):
    """Evaluate wrong input of `two_lists`; return the message."""

    def message(*options, estimates="poses.txt", truth="truth.txt"):
        files = ("--estimates", two_lists / estimates, "--ground_truth", two_lists / truth)
        return refused(monkeypatch, caplog, evaluation, "poses", *files, *options)

    return message


@pytest.mark.parametrize("thresholds", [["0.25"], ["aachen", "0,1"]])
def test_wrong_thresholds(message, thresholds):
    assert "aachen, inloc or pairs" in message("--thresholds", *thresholds)


def test_wrong_files_of_poses(two_lists, message):
    assert "in another file" in message("--ground_truth", two_lists / "truth.txt")
    assert "Cannot read" in message(estimates="absent.txt")
    assert "poses.txt is a file" in message("--outputs", two_lists / "poses.txt/o")
    write_poses({"a/day/0.jpg": rigid(0), "b/0.jpg": rigid(0)}, two_lists / "more.txt", None)
    assert "could be of" in message(truth="more.txt")
    (two_lists / "empty.txt").touch()
    assert "has no pose" in message(truth="empty.txt")


POSE = "0.jpg 1 0 0 0 0 0 0\n"


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("other.txt", POSE.replace("0.jpg", "x.jpg"), "no pose of a query"),
        # base names of two lists in one file: the second one is not taken for the first
        ("twice.txt", POSE * 2, "twice.txt:2: 0.jpg is listed twice"),
        ("nan.txt", "0.jpg 1 0 0 0 nan 0 0\n", "nan.txt:1: not a pose"),
        ("logs.jsonl", "{}\n", "run the localization again"),
    ],
)
def test_wrong_estimates(two_lists, message, name, text, expected):
    (two_lists / name).write_text(text)
    assert expected in message(estimates=name)
