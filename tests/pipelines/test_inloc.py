"""Localization by RGB-D scans, on a plane whose geometry is known and on a real place."""

import subprocess
import sys

import command
import h5py
import numpy as np
import pycolmap
import pytest
from conftest import SHARED, scan_frame
from scipy.io import loadmat, savemat

from hloc_reduce import localize_inloc
from hloc_reduce.datasets import scans
from hloc_reduce.datasets.inloc import InLoc
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.utils.parsers import parse_poses
from pipelines import inloc

PIPELINE = inloc


def outcome(outputs):
    """Return the summary, and the rows of queries.csv by base name."""
    summary, rows = command.outcome(outputs)
    return summary, {name.rpartition("/")[2]: row for name, row in rows.items()}


def test_plane(inloc_layout, tmp_path, monkeypatch, capsys, run):
    outputs = tmp_path / "outputs"
    arguments = ("--dataset", inloc_layout, "--feature", "sift_sv32", "--outputs")
    read, original = [], scans.read_scan
    monkeypatch.setattr(scans, "read_scan", lambda path: read.append(path) or original(path))
    run(*arguments, outputs)
    assert len(read) == len(set(read)) == 4  # of three queries
    summary, rows = outcome(outputs)
    # all are nearest to scans of PLA1, which more of the plane's photos are in
    assert {row["list"] for row in rows.values()} == {"PLA1"}
    for name in ("a.JPG", "b.JPG"):
        assert rows[name]["status"] == "localized"
        assert float(rows[name]["position_error_m"]) < 0.02
        assert "/PLA1/" in rows[name]["retrieved"]
        assert int(rows[name]["num_without_point"]) > 0  # of the columns without depth
    assert rows["a.JPG"]["num_inliers"] == rows["b.JPG"]["num_inliers"]
    grey = rows["grey.JPG"]
    assert grey["status"] == "failed" and grey["position_error_m"] == "inf"
    result = summary["lists"]["PLA1"]
    assert result["recall_percent"] == [66.67] * 3
    assert result["thresholds_m_deg"] == [[0.25, 10], [0.5, 10], [1, 10]]
    poses = (outputs / summary["poses"]).read_text()
    assert [line.split()[0] for line in poses.splitlines()] == ["a.JPG", "b.JPG"]
    assert "66.7 / 66.7 / 66.7" in capsys.readouterr().out

    # a second run computes nothing anew and says the same
    times = {path: path.stat().st_mtime_ns for path in outputs.rglob("*.h5")}
    run(*arguments, outputs)
    assert {path: path.stat().st_mtime_ns for path in times} == times and len(read) == 4
    assert (outputs / summary["poses"]).read_text() == poses

    # but for scans that have changed
    run(*arguments, outputs, "--overwrite")
    assert len(read) == 8 and (outputs / summary["poses"]).read_text() == poses

    # and so does one from nothing, of the queries in another order
    queries = inloc_layout / "queries_with_intrinsics.txt"
    queries.write_text("\n".join(reversed(queries.read_text().splitlines())))
    run(*arguments, tmp_path / "again")
    again = (tmp_path / "again" / summary["poses"]).read_text()
    assert sorted(again.splitlines()) == sorted(poses.splitlines())
    assert outcome(tmp_path / "again")[1] == rows


def shifted(number):
    """Return the frame of a photo's floor from the world: 100 m apart for photo 3."""
    matrix = np.eye(4)
    matrix[0, 3] = 100 * (number == 3)
    return matrix


def test_points_are_those_of_the_plane(inloc_layout, tmp_path, run):
    """In the frame of the floor: z = 0, at the pixel that sees it."""
    run("--dataset", inloc_layout, "--feature", "sift", "--outputs", tmp_path / "o")
    model = pycolmap.Reconstruction(inloc_layout.parent / "model")
    camera = next(iter(model.cameras.values()))
    with (
        h5py.File(tmp_path / "o/feats-dog-sift.h5") as features,
        h5py.File(tmp_path / "o/feats-dog-sift-points3D.h5") as points,
    ):
        for number in range(4):
            floor = "PLA2" if number == 3 else "PLA1"
            name = f"database/cutouts/{floor}/00{number}/PLA_cutout_00{number}_0_0.jpg"
            (of_keypoints,) = points[name].values()
            xyz = of_keypoints["points3D"][:].astype(float)
            keypoints = features[name]["keypoints"][:]
            without = np.isnan(xyz).any(1)
            assert (without == (keypoints[:, 0] < 39)).all() and without.any()
            xyz, keypoints = xyz[~without], keypoints[~without]
            pose = scans.read_pose(inloc_layout, name)
            np.testing.assert_allclose(pose @ scan_frame(number), shifted(number), atol=1e-9)
            xyz = xyz @ pose[:3, :3].T + pose[:3, 3] - shifted(number)[:3, 3]
            np.testing.assert_allclose(xyz[:, 2], 0, atol=1e-4)
            pose = model.find_image_with_name(f"{number}.png").cam_from_world()
            pixels = camera.img_from_cam(xyz @ pose.rotation.matrix().T + pose.translation)
            inside = keypoints[:, 0] > 40
            np.testing.assert_allclose(pixels[inside], keypoints[inside] + 0.5, atol=0.02)


@pytest.mark.fault(1)
def test_a_place_far_from_the_origin(inloc_layout, tmp_path, run):
    """Scans and floors in UTM coordinates give the poses of those near the origin."""
    utm = np.array([448251.0, 5411932.0, 312.0])
    arguments = ("--dataset", inloc_layout, "--feature", "sift_sv32", "--outputs")
    run(*arguments, tmp_path / "near")
    for path in inloc_layout.rglob("*.mat"):
        scan = loadmat(path)["XYZcut"]
        savemat(path, {"XYZcut": scan + utm})
    for path in inloc_layout.rglob("*_trans_*.txt"):
        pose = scans.read_transformation(path)
        pose[:3, 3] += utm - pose[:3, :3] @ utm
        rows = [" ".join(map(repr, row)) for row in pose.tolist()]
        path.write_text("\n".join(["", *["9 9 9 9"] * 4, "", "", *rows, ""]))
    run(*arguments, tmp_path / "far")
    near, far = (
        parse_poses(tmp_path / name / outcome(tmp_path / name)[0]["poses"])
        for name in ("near", "far")
    )
    assert {*near} == {*far} == {"a.JPG", "b.JPG"}
    moved = pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), utm)
    for name, pose in near.items():
        position, rotation = pose_error(far[name], moved.transform_camera_world(pose))
        assert position < 0.001 and rotation < 0.01


def test_retrieval_by_hlocs_pairs(inloc_layout, tmp_path, run):
    """Only what is retrieved is read; a query of which nothing is retrieved has no pose."""
    pairs = tmp_path / "pairs-query-netvlad40.txt"
    cutouts = [f"database/cutouts/PLA1/00{i}/PLA_cutout_00{i}_0_0.jpg" for i in (2, 1)]
    pairs.write_text("".join(f"query/iphone7/a.JPG {cutout}\n" for cutout in cutouts))
    outputs = tmp_path / "outputs"
    (inloc_layout / "ground_truth_poses.txt").unlink()
    (inloc_layout / "database/cutouts/PLA2/003/PLA_cutout_003_0_0.jpg").write_bytes(b"no image")
    (inloc_layout / "database/alignments/PLA2/transformations/PLA_trans_003.txt").unlink()
    run("--dataset", inloc_layout, "--outputs", outputs, "--retrieval", pairs, "--num_loc", 30)
    summary, rows = outcome(outputs)
    assert summary["poses"] == "InLoc_hloc_colmap_sift_sv64+NN-ratio_netvlad30.txt"
    assert summary["map_images"] == 2 and list(summary["lists"]) == ["PLA1"]
    assert rows["a.JPG"]["status"] == "localized" and rows["a.JPG"]["retrieved"] == cutouts[0]
    assert rows["b.JPG"]["status"] == "failed" and rows["b.JPG"]["retrieved"] == ""
    assert summary["intrinsics"] == {"list": 3}


def test_queries_of_the_benchmark(inloc_layout, tmp_path, run):
    """Without a list all photos in the folder are queries, taken with an iPhone 7."""
    (inloc_layout / "queries_with_intrinsics.txt").unlink()
    place = InLoc(inloc_layout)
    assert place.query_names() == [f"query/iphone7/{name}.JPG" for name in ("a", "b", "grey")]
    run("--dataset", inloc_layout, "--outputs", tmp_path / "o")
    _, rows = outcome(tmp_path / "o")
    # its focal length is 280 pixels there, not 375: the camera would be closer
    assert 0.05 < float(rows["a.JPG"]["position_error_m"]) < 1
    assert rows["a.JPG"]["reason"].startswith("its intrinsics contradict the map")


def test_queries_without_matches_do_not_stop_the_others(inloc_layout, tmp_path, run):
    run("--dataset", inloc_layout, "--outputs", tmp_path / "o")
    (matches,) = (tmp_path / "o").glob("*_matches-*.h5")
    with h5py.File(matches, "a") as file:
        for pair in [name for name in file if "a.JPG" in name]:
            del file[pair]
    records = localize_inloc.main(
        inloc_layout,
        tmp_path / "o/pairs-query-vlad40.txt",
        tmp_path / "o/feats-dog-colmap_sift_sv64.h5",
        matches,
        tmp_path / "poses.txt",
        queries=inloc_layout / "queries_with_intrinsics.txt",
    )
    assert not records["query/iphone7/a.JPG"]["localized"]
    assert records["query/iphone7/a.JPG"]["qvec"] is None
    assert records["query/iphone7/b.JPG"]["localized"]
    strict = localize_inloc.main(
        inloc_layout,
        tmp_path / "o/pairs-query-vlad40.txt",
        tmp_path / "o/feats-dog-colmap_sift_sv64.h5",
        matches,
        tmp_path / "poses.txt",
        skip_matches=10_000,
    )
    assert strict["query/iphone7/b.JPG"]["num_matches"] == 0


def test_wrong_input(inloc_layout, tmp_path, run, refused):
    arguments = ("--dataset", inloc_layout, "--outputs", tmp_path / "o")
    message = refused("--dataset", tmp_path / "nowhere")
    for part in ("query", "database/cutouts", "database/alignments", "visuallocalization.net"):
        assert part in message
    assert "--num_loc 0" in refused(*arguments, "--num_loc", 0)
    mat = inloc_layout / "database/cutouts/PLA1/001/PLA_cutout_001_0_0.jpg.mat"
    content = mat.read_bytes()
    mat.unlink()
    assert f"1 files of scans: {mat}" in refused(*arguments)
    mat.write_bytes(content[: len(content) // 2])
    assert not (tmp_path / "o").exists()
    assert f"Cannot read the scan {mat}" in refused(*arguments)
    mat.write_bytes(content)
    run(*arguments)  # goes on where it was stopped
    before, poses = outcome(tmp_path / "o")
    transformation = inloc_layout / "database/alignments/PLA1/transformations/PLA_trans_001.txt"
    text = transformation.read_text()
    transformation.write_text("\n".join(text.splitlines()[:9]))
    assert "no 4x4 matrix" in refused(*arguments)
    # where scans are is not kept with what they show
    for path in transformation.parent.iterdir():
        lines = path.read_text().splitlines() if path != transformation else text.splitlines()
        row = lines[9].split()
        lines[9] = " ".join([*row[:3], repr(float(row[3]) + 5)])
        path.write_text("\n".join(lines))
    run(*arguments)
    moved = outcome(tmp_path / "o")[1]["a.JPG"]
    assert moved["status"] == "localized" and 4.9 < float(moved["position_error_m"]) < 5.1
    queries = inloc_layout / "queries_with_intrinsics.txt"
    text = queries.read_text()
    queries.write_text(text + text.splitlines()[0])
    assert "a.JPG is listed twice" in refused(*arguments)
    pairs = tmp_path / "o/pairs-query-vlad40.txt"
    queries.write_text(text)
    message = refused(*arguments, "--retrieval", pairs)
    assert "would be overwritten" in message


@pytest.mark.check
@pytest.mark.skipif(not (SHARED / "scripts").is_dir(), reason="no real place on this machine")
def test_redkitchen(tmp_path, run):
    """The whole job on a real place, recorded by a depth camera."""
    root = tmp_path / "redkitchen"
    script = SHARED / "scripts/make_inloc_layout.py"
    source = SHARED / "inloc_like/redkitchen"
    ranges = ("--db", "0:300:40", "--query", "10:300:80")  # of no common frame
    subprocess.run([sys.executable, script, source, root, *ranges], check=True)
    run("--dataset", root, "--outputs", tmp_path / "o", "--feature", "sift_sv16")
    result = outcome(tmp_path / "o")[0]["lists"]["RDK1"]
    assert result["queries"] == 4 and result["recall_percent"] == [100, 100, 100]
    assert result["median_position_error_m"] < 0.02
