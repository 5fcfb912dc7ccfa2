"""Job files, and batches: what jobs share, what fails, what is left behind."""

import csv
import errno
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import command
import pytest

from hloc_reduce import aggregate_features, extract_features, extractors
from hloc_reduce.datasets import scans
from hloc_reduce.descriptors.model import Descriptor
from hloc_reduce.detectors import dog
from hloc_reduce.evaluation import published
from hloc_reduce.localization.confidence import Gate
from hloc_reduce.report import __main__ as report
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from pipelines import aachen, batch, inloc
from pipelines.batch import jobs, tables
from pipelines.batch.jobs import Job
from pipelines.batch.shared import Shared


def write(path, text):
    path.write_text(text)
    return path


def table(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def names(found):
    return [f"{job.dataset.name}/{job.name}" for job in found]


def test_a_grid_with_exclusions(tmp_path):
    file = write(
        tmp_path / "some.yaml",
        """
        jobs:
          - dataset: [data/a, data/b]
            feature: [sift, {descriptor: [sift, mkd], scheme: sv, dim: [64, 16]}]
          - {dataset: data/a, feature: sift, matcher: [NN-ratio, NN-mutual], num_loc: 3}
        exclude:
          - {dataset: "*b", feature: ["sift_sv*", mkd_sv16]}
        """,
    )
    outputs, found = jobs.read(file)
    assert outputs == Path("outputs/some")
    assert names(found) == [
        *("a/sift", "a/sift_sv64", "a/sift_sv16", "a/mkd_sv64", "a/mkd_sv16", "b/sift"),
        *("b/mkd_sv64", "a/sift+num_loc3", "a/sift+NN-mutual+num_loc3"),
    ]
    assert found[-1].numbers == {"num_loc": 3} and found[0].numbers == {}
    assert list(jobs.by_dataset(found)) == [Path("data/a").absolute(), Path("data/b").absolute()]


def test_the_gate_of_jobs(tmp_path):
    text = "jobs: [{dataset: a, feature: sift, min_confidence: [8, 12.5], min_inliers: [8, 20]}]"
    found = jobs.read(write(tmp_path / "a.yaml", text))[1]
    assert names(found)[3] == "a/sift+min_confidence12.5+min_inliers20"
    assert found[3].gate == Gate(12.5, 20)
    assert jobs.read(write(tmp_path / "a.yaml", "jobs: [{dataset: a}]"))[1][0].gate == Gate()
    text = "jobs: [{dataset: a, min_confidence: [8.0, 9]}]\nexclude: [{min_confidence: 8}]"
    assert len(jobs.read(write(tmp_path / "a.yaml", text))[1]) == 1


def test_a_job_that_is_listed_twice_is_one(tmp_path):
    text = "jobs: [{dataset: a, feature: [sift, sift]}, {dataset: [a], feature: sift}]"
    assert names(jobs.read(write(tmp_path / "a.yaml", text))[1]) == ["a/sift"]


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "a job file is a mapping of outputs, jobs, exclude, not None"),
        ("jobs: []", "there is no job"),
        ("jobs: [{feature: sift}]", "a grid of jobs names no dataset"),
        ("jobs: [{dataset: a, features: sift}]", "Unknown key of a grid of jobs 'features'"),
        ("jobs: [{dataset: a, feature: sft}]", "Unknown feature 'sft'. The nearest .* sift,"),
        ("jobs: [{dataset: a, feature: {descriptor: sift, dim: 64}}]", "has no scheme"),
        ("jobs: [{dataset: a, matcher: NN}]", "Unknown matcher 'NN'"),
        ("jobs: [{dataset: a, storage: int4}]", "Unknown storage 'int4'"),
        ("jobs: [{dataset: a, num_loc: 0}]", "num_loc is 0: at least 1"),
        ("jobs: [{dataset: a, num_loc: many}]", "num_loc is 'many': an integer is needed"),
        ("jobs: [{dataset: a, min_inliers: 8.5}]", "min_inliers is 8.5: an integer is needed"),
        ("jobs: [{dataset: a, min_confidence: -1}]", "must be finite and at least 0"),
        ("jobs: [{dataset: 3}]", "dataset is 3: a name is needed"),
        ("jobs: [{dataset: a}]\nexclude: [{job: a}]", "Unknown key of an entry of exclude 'job'"),
        ("jobs: [{dataset: [x/a, y/a]}]", "y/a and .*x/a would have the same folder"),
        ("jobs: [{dataset: a, num_loc: 2, retrieval: [x/b, y/b]}]", "two jobs .* differ in retri"),
        ("jobs: [{dataset: a, feature: [], num_loc: 3}]", "feature of a grid of jobs has no value"),
        ("jobs: [{dataset: a}]\nexclude: [{feature: mdk}]", "no job is excluded by"),
        ("outputs: [a]\njobs: [{dataset: a}]", "outputs is a folder, not"),
        ("jobs: !!python/object/apply:os.getcwd []", "cannot be read"),
        ("jobs: [", "cannot be read"),
    ],
)
def test_what_is_no_job_file(text, message, tmp_path):
    path = write(tmp_path / "jobs.yaml", text)
    with pytest.raises(InputError, match=message) as error:
        jobs.read(path)
    assert str(error.value).startswith(str(path))


def test_the_job_files_of_the_tables_have_all_features_of_the_paper(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where they are not
    for place in ("aachen", "inloc"):
        files = [Path("confs/jobs") / f"{place}_table{number}.yaml" for number in range(1, 5)]
        found = [job.feature for file in files for job in jobs.read(file)[1]]
        assert sorted(found) == sorted(published.localization())
    assert names(jobs.read(Path("demo.yaml"))[1])[0] == "demo_town/sift_sv64"


@pytest.fixture
def run_batch(tmp_path, monkeypatch, capsys):
    """Runs the batch of a grid in this process and returns its outputs and what it printed."""
    monkeypatch.setattr(cli.logger, "propagate", True)  # for caplog

    def run(*grids, options=()):
        job_file = write(tmp_path / "jobs.yaml", json.dumps({"jobs": list(grids)}))
        arguments = (job_file, "--outputs", tmp_path / "out", "--executor", "serial", *options)
        try:
            command.run(monkeypatch, batch, *arguments)
        finally:
            run.printed = capsys.readouterr().out
        return tmp_path / "out"

    return run


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
    count(extractors, "read_image")
    count(aggregate_features, "main")
    features = ["sift_sv64", "sift", "sift_sv16", "colmap_sift"]
    grid = {"dataset": str(aachen_layout), "feature": features, "matcher": "NN-ratio"}
    outputs = run_batch(grid)
    images = 7
    assert done["detect"] == done["read_image"] == images
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
        *(("sift_sv64", "day", "0.5"), ("sift_sv64", "day", "5.0"), ("sift_sv64", "nig", "0.5")),
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


def refuse_tfeat(name):
    if name == "tfeat":
        raise InputError("no tfeat")


def test_a_bug_in_one_job_does_not_stop_the_others(aachen_layout, run_batch, monkeypatch, caplog):
    original = aachen.main

    def broken(*args, **kwargs):
        if args[2] == "sift":
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
    assert "Cannot read image" in caplog.text
    assert {row["error"][:17] for row in table(outputs / "jobs.csv")} == {"Cannot read image"}

    broken.write_bytes(content[0])
    absent.write_bytes(content[1])
    run_batch(grid)
    assert table(outputs / "failures.csv") == []
    assert expected == {
        path.relative_to(outputs): path.read_text() for path in outputs.rglob("queries.csv")
    }


def test_a_dry_run_shows_the_steps_and_writes_nothing(aachen_layout, run_batch, tmp_path):
    grid = {"dataset": str(aachen_layout), "feature": ["sift", "sift_sv16", "colmap_sift"]}
    outputs = run_batch(grid, options=("--dry_run",))
    assert not outputs.exists()
    lines = [[cell.strip() for cell in line.split("|")] for line in run_batch.printed.splitlines()]
    # 7 images of 5000 keypoints with 14 bytes and 128, 16 and 128 numbers of 2 bytes
    size = f"{7 * 5000 * (3 * 14 + 2 * 272) / 1e6:.1f}"
    assert lines[1] == [
        *(
            aachen_layout.name,
            "extract_features",
            "sift, sift_sv16, colmap_sift",
            "7",
            "images",
            size,
        )
    ]
    assert [line[1] for line in lines[2:7]] == [
        *("retrieval", "match_map", "triangulation", "match_queries", "localization")
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

    def broken(*_):
        raise InputError("no VLAD")

    monkeypatch.setattr(aggregate_features, "main", broken)
    with pytest.raises(SystemExit):
        run_batch(grid)
    rows = table(tmp_path / "out/jobs.csv")
    assert {row["job"]: row["error"] for row in rows} == {
        "sift_sv16": "no VLAD",
        "sift_sv16+own": "",
    }


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


def test_a_job_without_a_list_of_another(aachen_layout, tmp_path):
    found = {"recall_percent": [50.0], "thresholds_m_deg": [[0.25, 10]]}
    size = {"descriptor": 32, "feature_file": 40.0}
    found |= {"queries": 3, "localized": 2}
    rest = {"bytes_per_keypoint": size, "seconds": {}, "queries": 3, "queries_localized": 2}
    made = [Job(aachen_layout, "sift", num_loc=n) for n in (1, 2)]
    shared = Shared(aachen_layout, made, tmp_path / "shared")
    summaries = {
        made[0]: {"lists": {"DUC1": found}, **rest},
        made[1]: {"lists": {"DUC2": {**found, "recall_percent": [25.0]}}, **rest},
    }
    lines = [
        [cell.strip() for cell in line.split("|")][-2:]
        for line in tables.table(shared, summaries).splitlines()
    ]
    assert lines == [["DUC1", "DUC2"], ["0.25", "0.25"], ["10", "10"], ["50.0", "-"], ["-", "25.0"]]
    assert [(row["job"], row["list"]) for row in tables.job_rows(shared, summaries)] == [
        ("sift+num_loc1", "DUC1"),
        ("sift+num_loc2", "DUC2"),
    ]


def test_a_full_disk_ends_a_batch(aachen_layout, run_batch, monkeypatch, caplog):
    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "a file")

    monkeypatch.setattr(aachen, "main", full)
    with pytest.raises(SystemExit):
        run_batch({"dataset": str(aachen_layout), "feature": ["sift", "sift_sv16"]})
    (line,) = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
    assert line == "[Errno 28] No space left on device: 'a file'"


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
