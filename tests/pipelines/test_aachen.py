"""The main job, from photos to poses."""

import json

import h5py
import numpy as np
import pytest
from command import outcome
from demo_photos import scaled

from hloc_reduce import demo
from hloc_reduce.demo.cameras import MAP
from pipelines import aachen

PIPELINE = aachen


def test_plane(aachen_layout, tmp_path, capsys, run):
    outputs = tmp_path / "outputs"
    given = ("--dataset", aachen_layout, "--outputs", outputs, "--feature", "sift_sv32")
    run(*given, "--profile")
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
    run("--dataset", aachen_layout, "--outputs", outputs, "--feature", "sift_sv32")
    assert {path: path.stat().st_mtime_ns for path in before} == times
    assert poses.read_bytes() == submitted
    second = outcome(outputs)[0]
    assert second["lists"] == summary["lists"] and second["bytes"] == summary["bytes"]
    assert second["seconds"] == summary["seconds"]

    # and so does a run from nothing
    again = tmp_path / "again"
    run("--dataset", aachen_layout, "--outputs", again, "--feature", "sift_sv32")
    assert (again / summary["poses"]).read_bytes() == submitted


def test_a_run_goes_on_where_it_was_stopped(aachen_layout, tmp_path, caplog, run, refused):
    outputs = tmp_path / "outputs"
    arguments = ("--dataset", aachen_layout, "--outputs", outputs, "--feature", "sift")
    query = aachen_layout / "images_upright/query/night/a.png"
    content = query.read_bytes()
    query.write_bytes(b"no image")
    message = refused(*arguments, "--strict")
    assert "Cannot read image" in message and "query/night/a.png" in message
    assert list((outputs / "feats-dog-sift.h5.pieces").iterdir())
    query.write_bytes(content)
    caplog.clear()
    run(*arguments)
    summary, _ = outcome(outputs)
    assert summary["queries_localized"] == 2
    again = tmp_path / "again"
    run(*arguments[:2], "--outputs", again, *arguments[4:])
    assert (again / summary["poses"]).read_bytes() == (outputs / summary["poses"]).read_bytes()


def test_retrieval_from_files(aachen_layout, tmp_path, run, refused):
    pairs = tmp_path / "pairs-query-netvlad50.txt"
    pairs.write_text(
        "query/day/a.png db/3.png\nquery/day/a.png db/gone.png\nquery/night/a.png db/2.png\n"
        "query/other.png db/2.png\n"
    )
    outputs = tmp_path / "outputs"
    arguments = ["--dataset", aachen_layout, "--feature", "sift", "--outputs", outputs]
    run(*arguments, "--retrieval", pairs)
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
    run(*arguments, "--retrieval", global_descriptors, "--num_loc", 2)
    lines = (outputs / "pairs-query-netvlad2.txt").read_text().splitlines()
    assert len(lines) == 6
    prose = tmp_path / "prose.txt"
    prose.write_text("this is no list of pairs")
    arguments[-1] = tmp_path / "outputs3"
    message = refused(*arguments, "--retrieval", prose)
    assert "prose.txt:1" in message and not arguments[-1].exists()
    assert "neither vlad nor an existing file" in refused(
        *arguments, "--retrieval", tmp_path / "absent.h5"
    )


def test_without_ground_truth(aachen_layout, tmp_path, capsys, run):
    (aachen_layout / "queries/ground_truth_poses.txt").unlink()
    arguments = ("--dataset", aachen_layout, "--outputs", tmp_path / "o", "--feature", "sift")
    run(*arguments)
    summary, rows = outcome(tmp_path / "o")
    assert "recall_percent" not in summary["lists"]["day_time_queries_with_intrinsics"]
    assert rows["query/day/a.png"]["position_error_m"] == ""
    assert "submit" in capsys.readouterr().out


def test_features_are_listed(capsys, run):
    with pytest.raises(SystemExit) as exit:
        run("--list_features")
    assert not exit.value.code
    lines = capsys.readouterr().out.splitlines()
    cells = [[cell.strip() for cell in line.split("|")] for line in lines]
    rows = {name: values for name, *values in cells}
    assert list(rows)[:2] == ["feature", "sift"]
    assert rows["sift_sv16"] == ["16", "32", "NN-ratio", "shipped"]
    assert rows["xfeat_sv32"][-1] == "shipped; base: downloaded on first use"
    assert lines[-1].startswith("Default: colmap_sift_sv64.")
    assert rows["edgepoint2_m48"] == ["48", "96", "NN-mutual", "downloaded on first use"]


def test_herz_jesus(herz_jesus, tmp_path, run):
    """The whole job on a real place with laser-measured poses, and every other query."""
    place = tmp_path / "herz-jesus"
    (place / "queries").mkdir(parents=True)
    for name in ("images_upright", "3D-models"):
        (place / name).symlink_to(herz_jesus / name)
    for path in (herz_jesus / "queries").iterdir():
        step = 2 if path.name.endswith("_with_intrinsics.txt") else 1
        lines = path.read_text().splitlines(keepends=True)
        (place / "queries" / path.name).write_text("".join(lines[::step]))
    run("--dataset", place, "--outputs", tmp_path / "outputs", "--feature", "sift_sv64")
    summary, rows = outcome(tmp_path / "outputs")
    assert len(rows) == 8 and summary["queries_localized"] == 8
    for row in rows.values():
        assert float(row["position_error_m"]) < 0.25 and float(row["rotation_error_deg"]) < 2
    day = summary["lists"]["day_time_queries_with_intrinsics"]
    assert day["median_position_error_m"] < 0.01 and day["mean_inliers"] > 1000


@pytest.mark.check
@pytest.mark.parametrize(
    "width, step, least", [(512, 2, 80), pytest.param(1024, 1, 90, marks=pytest.mark.long)]
)
def test_demo(width, step, least, tmp_path, monkeypatch, run):
    """The built-in town: rendered, localized, easy by day and hard by night."""
    listed = demo.list_photos(0)
    photos = [photo for photo in listed if photo.kind == MAP]
    photos += [photo for photo in listed if photo.kind != MAP][::step]
    photos = [scaled(photo, width, width * 3 // 4) for photo in photos]
    monkeypatch.setattr(demo, "list_photos", lambda *_: photos)
    monkeypatch.chdir(tmp_path)
    run("--demo", "--feature", "colmap_sift_sv64")
    summary, rows = outcome(tmp_path / "outputs/demo_town/colmap_sift_sv64")
    assert len(rows) == 20 // step
    day = summary["lists"]["day_time_queries_with_intrinsics"]
    night = summary["lists"]["night_time_queries_with_intrinsics"]
    assert day["recall_percent"][0] >= least
    assert 0 < night["recall_percent"][0] < 100
    wrong = [
        row
        for row in rows.values()
        if row["status"] == "localized" and float(row["position_error_m"]) > 5
    ]
    assert len(wrong) <= 1  # what is called localized is
