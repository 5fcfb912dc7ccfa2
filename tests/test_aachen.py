"""The main job, from photos to poses, and what it says to wrong input."""

import io
import json
import shutil

import command
import cv2
import h5py
import numpy as np
import pytest
import torch
from command import outcome

from hloc_reduce import projections
from hloc_reduce.utils import cli
from pipelines import aachen


def run(monkeypatch, *arguments):
    command.run(monkeypatch, aachen, *arguments)


def refused(monkeypatch, caplog, *arguments):
    return command.refused(monkeypatch, caplog, aachen, *arguments)


@pytest.fixture(autouse=True)
def propagated(monkeypatch):
    monkeypatch.setattr(cli.logger, "propagate", True)  # for caplog


def test_plane(aachen_layout, tmp_path, monkeypatch, capsys):
    outputs = tmp_path / "outputs"
    given = ("--dataset", aachen_layout, "--outputs", outputs, "--feature", "sift_sv32")
    run(monkeypatch, *given, "--profile")
    summary, rows = outcome(outputs)
    assert summary["queries"] == 3 and summary["queries_localized"] == 2
    day = summary["lists"]["day_time_queries_with_intrinsics"]
    night = summary["lists"]["night_time_queries_with_intrinsics"]
    assert day["recall_percent"] == [50, 50, 50] and day["localized"] == 1
    assert day["thresholds_m_deg"] == [[0.25, 2], [0.5, 5], [5, 10]]
    assert night["recall_percent"] == [100, 100, 100]
    assert night["thresholds_m_deg"] == [[0.5, 2], [1, 5], [5, 10]]
    assert summary["bytes_per_keypoint"]["descriptor"] == 64
    assert summary["map_points3D"] > 100 and summary["versions"]["pycolmap"]
    assert len(summary["seconds"]) == 7
    events = json.loads((outputs / "trace.json").read_text())["traceEvents"]
    traced = {event["name"] for event in events}
    assert traced > {*summary["seconds"], "extract", "match", "localize"}
    written = {"match_map": "*covis*.h5", "match_queries": "*pairs-query*.h5"}
    for stage, files in written.items():
        (file,) = outputs.glob(files)
        assert summary["bytes"][stage] == file.stat().st_size
    assert summary["bytes"].keys() == summary["seconds"].keys()
    good, grey = rows["query/day/a.png"], rows["query/day/grey.png"]
    assert good["status"] == "localized" and float(good["position_error_m"]) < 0.02
    assert 0 < int(good["num_inliers"]) <= int(good["num_matches"])
    assert grey["status"] == "fallback" and grey["num_matches"] == "0"
    assert grey["retrieved"].startswith("db/") and grey["reason"] == "no keypoints"
    assert good["reason"] == ""
    poses = outputs / summary["poses"]
    assert [line.split()[0] for line in poses.read_text().splitlines()] == ["a.png", "grey.png"] + [
        "a.png"
    ]
    table = capsys.readouterr().out
    assert "0.25 / 0.5 / 5" in table and "100.0 / 100.0 / 100.0" in table

    # a second run computes nothing anew and says the same
    before = {path: path.read_bytes() for path in outputs.rglob("*.h5")}
    times = {path: path.stat().st_mtime_ns for path in before}
    submitted = poses.read_bytes()
    run(monkeypatch, "--dataset", aachen_layout, "--outputs", outputs, "--feature", "sift_sv32")
    assert {path: path.stat().st_mtime_ns for path in before} == times
    assert poses.read_bytes() == submitted
    second = outcome(outputs)[0]
    assert second["lists"] == summary["lists"] and second["bytes"] == summary["bytes"]
    assert second["seconds"] == summary["seconds"]

    # and so does a run from nothing
    again = tmp_path / "again"
    run(monkeypatch, "--dataset", aachen_layout, "--outputs", again, "--feature", "sift_sv32")
    assert (again / summary["poses"]).read_bytes() == submitted


def test_a_run_goes_on_where_it_was_stopped(aachen_layout, tmp_path, monkeypatch, caplog):
    outputs = tmp_path / "outputs"
    arguments = ("--dataset", aachen_layout, "--outputs", outputs, "--feature", "sift")
    query = aachen_layout / "images_upright/query/night/a.png"
    content = query.read_bytes()
    query.write_bytes(b"no image")
    message = refused(monkeypatch, caplog, *arguments, "--strict")
    assert "Cannot read image" in message and "query/night/a.png" in message
    assert list((outputs / "feats-dog-sift.h5.pieces").iterdir())
    query.write_bytes(content)
    caplog.clear()
    run(monkeypatch, *arguments)
    summary, _ = outcome(outputs)
    assert summary["queries_localized"] == 2
    again = tmp_path / "again"
    run(monkeypatch, *arguments[:2], "--outputs", again, *arguments[4:])
    assert (again / summary["poses"]).read_bytes() == (outputs / summary["poses"]).read_bytes()


def test_a_wrong_configuration_touches_no_results(aachen_layout, tmp_path, monkeypatch, caplog):
    """It is refused before a finished run is overwritten, and before it claims a new folder."""
    outputs, new = tmp_path / "outputs", tmp_path / "new"
    place = ("--dataset", aachen_layout, "--feature", "sift", "--outputs")
    run(monkeypatch, *place, outputs)
    before = {path: path.read_bytes() for path in outputs.rglob("*") if path.is_file()}
    (tmp_path / "typo.yaml").write_text("model: {name: dog, options: {peak_treshold: 1}}")
    (tmp_path / "bare.yaml").write_text("model: {name: reduced, base: {name: dog}}")
    (tmp_path / "no.safetensors").write_text("no projection")
    (tmp_path / "HardNet_sv.pth").write_bytes(released_file())
    (tmp_path / "pairs.txt").write_text("other/a.png db/1.png\nquery/day/a.png other/1.png\n")
    for message, *wrong in (
        ("The DoG options", "--feature", tmp_path / "typo.yaml"),
        ("needs a projection", "--feature", tmp_path / "bare.yaml"),
        ("not a projection", "--projection", tmp_path / "no.safetensors"),
        ("is for mkd, not for sift", "--projection", projections.find("mkd_sv16")),
        ("is for hardnet, not for sift", "--projection", tmp_path / "HardNet_sv.pth"),
        ("no pair of a query and a map image", "--retrieval", tmp_path / "pairs.txt"),
    ):
        for folder in (outputs, new):
            arguments = (*place, folder, *wrong, "--overwrite")
            assert message in refused(monkeypatch, caplog, *arguments)
    assert {path: path.read_bytes() for path in before} == before and not new.exists()


def released_file():
    """A model as the paper's authors released theirs, untrained."""
    layers = torch.nn.Sequential(torch.nn.Linear(128, 96), torch.nn.BatchNorm1d(96))
    layers.append(torch.nn.Linear(96, 16))
    buffer = io.BytesIO()
    torch.save(layers.state_dict(), buffer)
    return buffer.getvalue()


def test_retrieval_from_files(aachen_layout, tmp_path, monkeypatch, caplog):
    pairs = tmp_path / "pairs-query-netvlad50.txt"
    pairs.write_text(
        "query/day/a.png db/3.png\nquery/day/a.png db/gone.png\nquery/night/a.png db/2.png\n"
        "query/other.png db/2.png\n"
    )
    outputs = tmp_path / "outputs"
    arguments = ["--dataset", aachen_layout, "--feature", "sift", "--outputs", outputs]
    run(monkeypatch, *arguments, "--retrieval", pairs)
    _, rows = outcome(outputs)
    assert rows["query/day/a.png"]["retrieved"] == "db/3.png"
    assert rows["query/night/a.png"]["retrieved"] == "db/2.png"
    grey = rows["query/day/grey.png"]  # for which the file has nothing
    assert grey["status"] == "fallback" and grey["retrieved"] == ""
    assert grey["reason"] == "no keypoints"

    global_descriptors = tmp_path / "netvlad.h5"
    generator = np.random.default_rng(0)
    with h5py.File(global_descriptors, "w") as file:
        for name in ["db/0.png", "db/1.png", "db/2.png", "db/3.png", *rows]:
            vector = generator.standard_normal(8)
            file[f"{name}/global_descriptor"] = vector / np.linalg.norm(vector)
    outputs = arguments[-1] = tmp_path / "outputs2"
    run(monkeypatch, *arguments, "--retrieval", global_descriptors, "--num_loc", 2)
    lines = (outputs / "pairs-query-netvlad2.txt").read_text().splitlines()
    assert len(lines) == 6
    prose = tmp_path / "prose.txt"
    prose.write_text("this is no list of pairs")
    arguments[-1] = tmp_path / "outputs3"
    message = refused(monkeypatch, caplog, *arguments, "--retrieval", prose)
    assert "prose.txt:1" in message and not arguments[-1].exists()
    assert "neither vlad nor an existing file" in refused(
        monkeypatch, caplog, *arguments, "--retrieval", tmp_path / "absent.h5"
    )


def test_wrong_input(aachen_layout, tmp_path, monkeypatch, caplog):
    outputs = tmp_path / "outputs"
    arguments = ("--dataset", aachen_layout, "--outputs", outputs)
    message = refused(monkeypatch, caplog, *arguments, "--feature", "sift_sv46")
    assert "sift_sv46" in message and message.index("sift_sv64") < message.index("sift_us64")
    message = refused(monkeypatch, caplog, *arguments, "--matcher", "NN")
    assert "NN-ratio" in message
    message = refused(monkeypatch, caplog, "--dataset", tmp_path / "nowhere")
    for part in ("images_upright", "3D-models/aachen_v_1_1", "queries", "visuallocalization.net"):
        assert part in message
    truth = tmp_path / "truth.txt"
    truth.write_text("a.png 1 0 0 0 0 0 0\n")
    message = refused(monkeypatch, caplog, *arguments, "--ground_truth", truth)
    assert "the pose of no query" in message
    truth.unlink()
    file = tmp_path / "file"
    file.touch()
    assert str(file) in refused(monkeypatch, caplog, *arguments[:2], "--outputs", file)
    assert "--num_loc 0" in refused(monkeypatch, caplog, *arguments, "--num_loc", 0)
    message = refused(monkeypatch, caplog, *arguments, "--ground_truth", tmp_path / "truth.txt")
    assert "truth.txt" in message
    assert not outputs.exists()

    (aachen_layout / "images_upright/db/2.png").rename(tmp_path / "2.png")
    message = refused(monkeypatch, caplog, *arguments)
    assert "1 of 4 images" in message and "db/2.png" in message and "--accept_partial" in message
    shutil.move(tmp_path / "2.png", aachen_layout / "images_upright/db/2.png")

    queries = aachen_layout / "queries/night_time_queries_with_intrinsics.txt"
    text = queries.read_text()
    queries.write_text(text + "query/night/b.png PINHOLE 1\n")
    message = refused(monkeypatch, caplog, *arguments)
    assert f"{queries}:2" in message
    queries.write_text(text)
    model = aachen_layout / "3D-models/aachen_v_1_1/images.bin"
    content = model.read_bytes()
    model.write_bytes(content[: len(content) // 2])
    assert "not a COLMAP model" in refused(monkeypatch, caplog, *arguments)
    model.write_bytes(content)


def test_outputs_of_another_configuration_are_refused(aachen_layout, tmp_path, monkeypatch, caplog):
    outputs = tmp_path / "outputs"
    arguments = ("--dataset", aachen_layout, "--outputs", outputs, "--feature", "sift")
    run(monkeypatch, *arguments)
    before = (outputs / "summary.json").read_bytes()
    message = refused(monkeypatch, caplog, *arguments, "--matcher", "NN-mutual")
    assert "matcher" in message and "--overwrite" in message
    assert (outputs / "summary.json").read_bytes() == before
    foreign = ("settings.json", "sfm_notes.txt", "my-feats-1.h5", ".mine.tmp", "sfm_old/a.bin")
    for name in foreign:
        (outputs / name).parent.mkdir(exist_ok=True)
        (outputs / name).write_text("mine")
    left = outputs / ".summary.json.123.tmp"  # of a killed run
    left.write_text("{")
    run(monkeypatch, *arguments, "--matcher", "NN-mutual", "--overwrite")
    assert outcome(outputs)[0]["matcher"] == "NN-mutual" and not left.exists()
    assert all((outputs / name).read_text() == "mine" for name in foreign)
    assert not list(outputs.glob("*_NN-mutual-ratio.8_*")) and not list(outputs.glob("sfm_*ratio"))


def test_grey_photos_only_give_an_empty_map(aachen_layout, tmp_path, monkeypatch, caplog):
    for path in (aachen_layout / "images_upright").rglob("*.png"):
        cv2.imwrite(str(path), np.full((360, 480), 128, np.uint8))
    arguments = ("--dataset", aachen_layout, "--outputs", tmp_path / "o", "--feature", "sift")
    assert "The map is empty" in refused(monkeypatch, caplog, *arguments)


def test_without_ground_truth(aachen_layout, tmp_path, monkeypatch, capsys):
    (aachen_layout / "queries/ground_truth_poses.txt").unlink()
    arguments = ("--dataset", aachen_layout, "--outputs", tmp_path / "o", "--feature", "sift")
    run(monkeypatch, *arguments)
    summary, rows = outcome(tmp_path / "o")
    assert "recall_percent" not in summary["lists"]["day_time_queries_with_intrinsics"]
    assert rows["query/day/a.png"]["position_error_m"] == ""
    assert "submit" in capsys.readouterr().out


def test_features_are_listed(monkeypatch, capsys):
    with pytest.raises(SystemExit) as exit:
        run(monkeypatch, "--list_features")
    assert not exit.value.code
    lines = capsys.readouterr().out.splitlines()
    cells = [[cell.strip() for cell in line.split("|")] for line in lines]
    rows = {name: values for name, *values in cells}
    assert list(rows)[:2] == ["feature", "sift"]
    assert rows["sift_sv16"] == ["16", "32", "shipped"] and rows["sift_pca64"][:2] == ["64", "128"]


def test_herz_jesus(herz_jesus, tmp_path, monkeypatch):
    """The whole job on a real place with laser-measured poses."""
    run(monkeypatch, "--dataset", herz_jesus, "--outputs", tmp_path, "--feature", "sift_sv64")
    summary, rows = outcome(tmp_path)
    assert len(rows) == 16 and summary["queries_localized"] == 16
    for row in rows.values():
        assert float(row["position_error_m"]) < 0.25 and float(row["rotation_error_deg"]) < 2
    day = summary["lists"]["day_time_queries_with_intrinsics"]
    assert day["median_position_error_m"] < 0.01 and day["mean_inliers"] > 1000


def test_demo(tmp_path, monkeypatch):
    """The built-in town: rendered, localized, easy by day and hard by night."""
    monkeypatch.chdir(tmp_path)
    run(monkeypatch, "--demo", "--feature", "colmap_sift_sv64")
    summary, rows = outcome(tmp_path / "outputs/demo_town/colmap_sift_sv64")
    assert len(rows) == 20
    day = summary["lists"]["day_time_queries_with_intrinsics"]
    night = summary["lists"]["night_time_queries_with_intrinsics"]
    assert day["recall_percent"][0] >= 90
    assert 0 < night["recall_percent"][0] < 100
    wrong = [
        row
        for row in rows.values()
        if row["status"] == "localized" and float(row["position_error_m"]) > 5
    ]
    assert len(wrong) <= 1  # what is called localized is
