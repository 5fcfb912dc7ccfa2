"""Poses of frames by time."""

import csv

import numpy as np
import pycolmap
import pytest

from hloc_reduce.localization import trajectory


def record(pose, localized=True):
    """Return the part of a record that has the pose, camera from world."""
    x, y, z, w = pose.rotation.quat
    qvec = [float(value) for value in (w, x, y, z)]
    return {"localized": localized, "qvec": qvec, "tvec": [float(v) for v in pose.translation]}


def test_poses_are_written_by_time(tmp_path):
    """World from camera, of localized frames; fallback poses are no poses of frames."""
    world_from_cam = pycolmap.Rigid3d(
        pycolmap.Rotation3d(np.array([0.1, -0.2, 0.3])), np.array([1.0, 2, 3])
    )
    known = record(world_from_cam.inverse())
    fallback = record(pycolmap.Rigid3d(), localized=False)
    none = {"localized": False, "qvec": None, "tvec": None}
    names = ["1305031102.175304.png", "10.jpg", "9.5.jpg", "0009.jpg"]
    records = dict(zip(names, [known, none, known, fallback], strict=True))
    assert trajectory.write(records, tmp_path)
    lines = (tmp_path / "trajectory_tum.txt").read_text().splitlines()
    assert [line.split()[0] for line in lines] == ["9.5", "1305031102.175304"]
    values = np.array(lines[0].split()[1:], float)
    assert values[:3] == pytest.approx([1, 2, 3])
    assert values[3:] == pytest.approx(world_from_cam.rotation.quat)
    with (tmp_path / "trajectory.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["query"] for row in rows] == ["0009.jpg", "9.5.jpg", "10.jpg", names[0]]
    assert [row["localized"] for row in rows] == ["0", "1", "0", "1"]
    assert rows[0]["tx"] == rows[2]["qw"] == "" and float(rows[1]["tz"]) == pytest.approx(3)


def test_names_that_are_no_time_stamps(tmp_path):
    pose = record(pycolmap.Rigid3d())
    assert not trajectory.write({"1.jpg": pose, "night.jpg": pose}, tmp_path)
    assert not [*tmp_path.iterdir()]


def test_no_frame_is_localized(tmp_path):
    assert trajectory.write({"1.jpg": record(pycolmap.Rigid3d(), False)}, tmp_path)
    assert (tmp_path / "trajectory_tum.txt").read_text() == ""
    assert len((tmp_path / "trajectory.csv").read_text().splitlines()) == 2
