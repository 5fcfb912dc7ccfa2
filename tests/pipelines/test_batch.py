"""Batches: what jobs share, what they leave."""

import shutil
from collections import Counter
from pathlib import Path

import command
from command import table, write

from hloc_reduce import aggregate_features, extract_features, extractors
from hloc_reduce.datasets import scans
from hloc_reduce.descriptors.model import Descriptor
from hloc_reduce.detectors import dog
from hloc_reduce.report import __main__ as report
from pipelines import aachen, inloc
from pipelines.batch import tables


def test_what_jobs_have_in_common_is_done_once(aachen_layout, run_batch, tmp_path, monkeypatch):
    done = Counter()

    def count(module, name):
        original = getattr(module, name)

        def counted(*args, **kwargs):
            done[name] += 1
            return original(*args, **kwargs)

        monkeypatch.setattr(module, name, counted)

    monkeypatch.setattr(extract_features.parallel, "cores", lambda: 1)  # no process detects
    count(dog, "detect")
    count(Descriptor, "forward")
    count(extractors, "resized")
    count(aggregate_features, "main")
    features = ["sift_sv64", "sift", "sift_sv16", "colmap_sift"]
    grid = {"dataset": str(aachen_layout), "feature": features, "matcher": "NN-ratio"}
    outputs = run_batch(grid)
    images = 7
    assert done["detect"] == done["resized"] == images
    assert done["forward"] == images
    assert done["main"] == 1
    folder = outputs / aachen_layout.name
    assert sorted(path.name for path in folder.iterdir()) == sorted([*features, "shared"])
    assert not list(folder.glob("[!s]*/feats*sift.h5"))

    pairs = folder / "shared/vlad_feats-dog-sift_sv64/pairs-query-vlad50.txt"
    for feature in features:
        alone = tmp_path / "alone" / feature
        aachen.main(aachen_layout, alone, feature, retrieval=str(pairs))
        (poses,) = alone.glob("*_hloc_*.txt")
        assert (folder / feature / poses.name).read_text() == poses.read_text()
        assert (folder / feature / "queries.csv").read_text() == (alone / "queries.csv").read_text()

    rows = table(outputs / "jobs.csv")
    assert list(rows[0]) == list(tables.COLUMNS)
    assert [(row["job"], row["list"][:3], row["threshold_m"]) for row in rows[:4]] == [
        ("sift_sv64", "day", "0.25"),
        ("sift_sv64", "day", "0.5"),
        ("sift_sv64", "day", "5.0"),
        ("sift_sv64", "nig", "0.5"),
    ]
    assert len(rows) == len(features) * 2 * 3 and not any(row["error"] for row in rows)
    assert {row["descriptor_bytes"] for row in rows if row["job"] == "sift_sv16"} == {"32"}
    assert table(outputs / "failures.csv") == []
    assert all(feature in run_batch.printed for feature in features)
    assert "shared: extract_features" in run_batch.printed

    states = {path: path.stat().st_mtime_ns for path in folder.rglob("*.h5")}
    done.clear()
    run_batch(grid)
    assert done["detect"] == done["forward"] == 0
    assert states == {path: path.stat().st_mtime_ns for path in folder.rglob("*.h5")}


def test_scans_and_true_poses_are_read_once(inloc_layout, run_batch, tmp_path, monkeypatch, caplog):
    read, original = [], scans.read_scan
    monkeypatch.setattr(scans, "read_scan", lambda path: read.append(path) or original(path))
    truth = inloc_layout / "ground_truth_poses.txt"
    truth.write_text("\n".join(truth.read_text().splitlines()[:2]))
    fewer = write(tmp_path / "fewer.yaml", "model: {name: dog, max_keypoints: 100}")
    features = ["sift_sv16", "colmap_sift", str(fewer)]
    grid = {"dataset": str(inloc_layout), "feature": features}
    outputs = run_batch(grid)
    assert set(Counter(read).values()) == {2} and len(read) == 2 * 4  # for all, and for the fewer
    warnings = [record for record in caplog.records if "lacks 1 of 3" in record.message]
    assert len(warnings) == 1 + len(features)  # of the plan, and of each job as it is run
    for feature in features[1:]:
        alone = outputs.parent / "alone" / Path(feature).stem
        inloc.main(inloc_layout, alone, feature, retrieval=str(next(outputs.rglob("pairs*.txt"))))
        queries = (outputs / inloc_layout.name / alone.name / "queries.csv").read_text()
        assert queries == (alone / "queries.csv").read_text()
    read.clear()
    run_batch({**grid, "feature": [*features, "sift_sv32"]})
    assert not read  # for more features of the same keypoints
    run_batch(grid, options=("--overwrite",))
    assert set(Counter(read).values()) == {2} and len(read) == 2 * 4
    place = shutil.copytree(inloc_layout, tmp_path / "copy" / inloc_layout.name)
    run_batch({"dataset": str(place)}, options=("--overwrite",))  # of another data set


def test_a_report_of_jobs_that_share_points_shows_what_each_retrieved(
    inloc_layout, run_batch, tmp_path, monkeypatch, caplog
):
    fewer = write(tmp_path / "fewer.yaml", "model: {name: dog, max_keypoints: 100}")
    place = {"dataset": str(inloc_layout)}
    outputs = run_batch(
        {**place, "feature": str(fewer), "num_loc": 1}, {**place, "feature": "sift_sv16"}
    )
    folder = outputs / inloc_layout.name
    jobs_of = [folder / "fewer+num_loc1", folder / "sift_sv16"]
    command.run(monkeypatch, report, *jobs_of, "-o", tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    for whole in (folder, outputs):  # without what the jobs share
        command.run(monkeypatch, report, whole, "-o", tmp_path / "whole.html")
        assert (tmp_path / "whole.html").read_text() == page
    assert "There is no" not in caplog.text and "Skipping" not in caplog.text


def test_a_grid_of_matchers_and_storages_in_both_layouts(aachen_layout, inloc_layout, run_batch):
    outputs = run_batch(
        {
            "dataset": str(aachen_layout),
            "feature": "sift_sv16",
            "matcher": ["NN-ratio", "NN-mutual"],
        },
        {"dataset": str(inloc_layout), "feature": "sift_sv16", "storage": ["uint8", "float16"]},
    )
    jobs_of = {path.name for path in (outputs / aachen_layout.name).iterdir()}
    assert jobs_of == {"shared", "sift_sv16", "sift_sv16+NN-mutual"}
    shared = outputs / inloc_layout.name / "shared"
    assert {path.name for path in shared.glob("feats*.h5")} >= {
        "feats-dog-sift_sv16.h5",
        "feats-dog-sift_sv16-uint8.h5",
    }
    sizes = {row["job"]: row["descriptor_bytes"] for row in table(outputs / "jobs.csv")}
    assert sizes["sift_sv16+uint8"] == "16" and sizes["sift_sv16"] == "32"


def test_a_dry_run_shows_the_steps_and_writes_nothing(aachen_layout, run_batch, tmp_path):
    grid = {"dataset": str(aachen_layout), "feature": ["sift", "sift_sv16", "colmap_sift"]}
    outputs = run_batch(grid, options=("--dry_run",))
    assert not outputs.exists()
    lines = [[cell.strip() for cell in line.split("|")] for line in run_batch.printed.splitlines()]
    # 7 images of 5000 keypoints with 14 bytes and 128, 16 and 128 numbers of 2 bytes
    size = f"{7 * 5000 * (3 * 14 + 2 * 272) / 1e6:.1f}"
    assert lines[1] == [
        aachen_layout.name,
        "extract_features",
        "sift, sift_sv16, colmap_sift",
        "7",
        "images",
        size,
    ]
    assert [line[1] for line in lines[2:7]] == [
        "retrieval",
        "match_map",
        "triangulation",
        "match_queries",
        "localization",
    ]
    assert lines[3][3:5] == ["12", "pairs"] and lines[5][3:5] == ["12", "pairs"]

    run_batch({**grid, "feature": "sift"})
    run_batch({**grid, "feature": ["sift", "sift_sv16"]}, options=("--dry_run",))
    lines = [[cell.strip() for cell in line.split("|")] for line in run_batch.printed.splitlines()]
    assert [line[1:4] for line in lines[1:-1]] == [
        ["extract_features", "sift, sift_sv16", "7"],
        *([step, "sift_sv16", n] for step, n in (("match_map", "12"), ("triangulation", "4"))),
        *([step, "sift_sv16", n] for step, n in (("match_queries", "12"), ("localization", "3"))),
    ]
    assert {row["job"] for row in table(outputs / "jobs.csv")} == {"sift"}
    run_batch({**grid, "feature": "sift_sv16"})  # a narrower batch keeps the rows of others
    assert {row["job"] for row in table(outputs / "jobs.csv")} == {"sift", "sift_sv16"}


def test_another_first_feature_retrieves_as_before_and_a_moved_folder_goes_on(
    aachen_layout, run_batch, tmp_path
):
    name = aachen_layout.name
    outputs = run_batch({"dataset": str(aachen_layout), "feature": ["sift_sv16"]})
    before = (outputs / name / "sift_sv16/queries.csv").stat().st_mtime_ns
    run_batch({"dataset": str(aachen_layout), "feature": ["sift_sv64", "sift_sv16"]})
    assert [path.name for path in (outputs / name / "shared").glob("vlad_*")] == [
        "vlad_feats-dog-sift_sv16"
    ]
    outputs.rename(tmp_path / "moved")
    command_line = ("--outputs", tmp_path / "moved")
    run_batch({"dataset": str(aachen_layout), "feature": "sift_sv16"}, options=command_line)
    assert (tmp_path / "moved" / name / "sift_sv16/queries.csv").stat().st_mtime_ns == before
