"""Queries of rigs, whose photos get one pose together."""

import json
import shutil

import cv2
import numpy as np
import pycolmap
import pytest
from command import outcome, state

from hloc_reduce import maps
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.localization import rig_pose
from hloc_reduce.localization.records import pose_of, read_records
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.parsers import parse_pairs
from pipelines import localize

PIPELINE = localize


@pytest.fixture
def rig(place, build_map, plane, tmp_path):
    """Photos of two cameras, a query and a darker photo of the map, and their configuration."""
    build_map()
    _, images, outputs = place
    model = pycolmap.Reconstruction(plane / "model")
    by_name = {image.name: image for image in model.images.values()}
    true = by_name["4.png"].cam_from_world()
    second = by_name["0.png"].cam_from_world() * true.inverse()
    folder = tmp_path / "drive"
    for camera in ("left", "right"):
        (folder / camera).mkdir(parents=True)
    for name in ("1.png", "2.png"):
        shutil.copy(images / "query/day/a.png", folder / "left" / name)
    cv2.imwrite(str(folder / "right/1.png"), cv2.imread(str(images / "db/0.png")) // 2)
    of_map = by_name["4.png"].camera
    x, y, z, w = second.rotation.quat
    cameras = [
        {"image_prefix": "left/", "ref_sensor": True},
        {
            "image_prefix": "right/",
            "cam_from_rig_rotation": [w, x, y, z],
            "cam_from_rig_translation": list(second.translation),
        },
    ]
    known = {"camera_model_name": of_map.model.name, "camera_params": list(of_map.params)}
    return folder, [{"cameras": [camera | known for camera in cameras]}], true, outputs


def write(rigs, folder):
    path = folder / "rig_config.json"
    path.write_text(rigs if isinstance(rigs, str) else json.dumps(rigs))
    return path


def records_of(outputs):
    [logs] = (outputs / "queries-drive").glob("*_logs.jsonl")
    return read_records(logs)


def test_photos_of_a_moment_get_one_pose(rig, tmp_path, run):
    folder, rigs, true, outputs = rig
    given = "--map", outputs / "map", "--query_images", folder, "--outputs", outputs
    run(*given)
    alone = records_of(outputs)
    given += ("--rigs", write(rigs, tmp_path))
    run(*given)
    records = records_of(outputs)
    summary, rows = outcome(outputs / "queries-drive")
    assert (summary["frames"], summary["frames_localized"]) == (1, 1)
    assert summary["intrinsics"] == {"rig": 3}
    assert {name: row["frame"] for name, row in rows.items()} == {
        "left/1.png": "left/1.png",
        "left/2.png": "",
        "right/1.png": "left/1.png",
    }
    pose = pose_of(records["left/1.png"])
    distance, degrees = pose_error(pose, true)
    assert distance < 0.02 and degrees < 0.2
    config = pycolmap.read_rig_config(str(tmp_path / "rig_config.json"))
    [right] = [one for one in config[0].cameras if one.image_prefix == "right/"]
    error = pose_error(pose_of(records["right/1.png"]), right.cam_from_rig * pose)
    assert max(error) < 1e-6
    for name in ("left/1.png", "right/1.png"):
        covariance = np.array(records[name]["covariance"])
        assert np.trace(covariance) < np.trace(alone[name]["covariance"])
        assert records[name]["measures"]["num_inliers"] == sum(
            records[one]["num_inliers"] for one in ("left/1.png", "right/1.png")
        )
    before = state(outputs / "queries-drive")
    run(*given)
    assert state(outputs / "queries-drive") == before
    rigs[0]["cameras"][1]["cam_from_rig_translation"][0] += 3.0
    write(rigs, tmp_path)
    run(*given)  # the photos contradict the rig, and keep the poses of their own
    summary, rows = outcome(outputs / "queries-drive")
    assert (summary["frames"], summary["frames_localized"]) == (1, 0)
    records = records_of(outputs)
    assert "contradict the rig" in records["left/1.png"]["rig"]["reason"]
    assert records["left/1.png"]["qvec"] and rows["left/1.png"]["frame"] == ""
    run(*given[:6])  # without a rig
    assert records_of(outputs)["left/1.png"]["rig"] is None


def test_an_uncertain_rig_is_matched_with_the_images_about_it(rig, tmp_path, monkeypatch, run):
    """Each camera retrieves one image, and no pose is certain."""
    folder, rigs, true, outputs = rig
    given = "--map", outputs / "map", "--query_images", folder, "--num_loc", 1
    given += "--rigs", write(rigs, tmp_path)
    run(*given, "--outputs", outputs)
    assert not [*(outputs / "queries-drive").glob("*-rigs.txt")]  # it is certain
    monkeypatch.setattr(rig_pose, "CERTAIN", np.inf)
    again = tmp_path / "again"
    run(*given, "--outputs", again)
    [pairs] = (again / "queries-drive").glob("*-rigs.txt")
    listed = list(parse_pairs(pairs))
    assert {name for name, _ in listed} == {"left/1.png", "right/1.png"}
    assert len(listed) == len({*listed}) > 2
    once, twice = records_of(outputs)["left/1.png"], records_of(again)["left/1.png"]
    assert twice["measures"]["num_inliers"] > once["measures"]["num_inliers"]
    assert twice["rig"]["reason"] is None and pose_error(pose_of(twice), true)[0] < 0.02
    before = state(again / "queries-drive")
    run(*given, "--outputs", again)
    assert state(again / "queries-drive") == before


def without(rigs, *keys):
    """Return rigs whose second camera lacks something."""
    first, second = rigs[0]["cameras"]
    second = {key: value for key, value in second.items() if key not in keys}
    return [{"cameras": [first, second]}]


def changed(rigs, **values):
    """Return rigs whose second camera has other values."""
    first, second = rigs[0]["cameras"]
    return [{"cameras": [first, second | values]}]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rigs: "{", "is not a rig configuration of COLMAP"),
        (lambda rigs: "[]", "has no rig"),
        (lambda rigs: [{"cameras": rigs[0]["cameras"][1:]}], "must have one reference sensor"),
        (
            lambda rigs: without(rigs, "cam_from_rig_rotation", "cam_from_rig_translation"),
            "the camera right/ has no cam_from_rig_rotation",
        ),
        (
            lambda rigs: changed(rigs, cam_from_rig_rotation=[2, 0, 1, 0]),
            "right/ is no unit quaternion w, x, y, z: its length is 2.24",
        ),
        (
            lambda rigs: changed(rigs, cam_from_rig_rotation=[1, 0, 0]),
            "the cam_from_rig_rotation of right/ has not 4 numbers",
        ),
        (
            lambda rigs: changed(rigs, cam_from_rig_translation=[1, 0, 0, 0]),
            "the cam_from_rig_translation of right/ has not 3 numbers",
        ),
        (
            lambda rigs: changed(rigs, cam_from_rig_translation=[float("inf"), 0, 0]),
            "not a rig configuration|is not finite",
        ),
        (lambda rigs: changed(rigs, image_prefix="left/"), "several cameras have the image_prefix"),
        (lambda rigs: changed(rigs, image_prefix="left/1"), "left/1.png is a photo of two cameras"),
        (
            lambda rigs: changed(rigs, image_prefix="back/"),
            "no two photos were taken at one moment",
        ),
        (
            lambda rigs: changed(rigs, camera_params=[-5, 1, 1]),
            "camera_params of right/: |not a rig configuration",
        ),
        (
            lambda rigs: without(rigs, "camera_model_name", "camera_params"),
            "The intrinsics of right/1.png are not known: give --queries",
        ),
    ],
)
def test_what_is_no_rig(change, message, rig, tmp_path, refused):
    folder, rigs, _, outputs = rig
    path = write(change(rigs), tmp_path)
    given = "--map", outputs / "map", "--query_images", folder, "--outputs", outputs
    printed = refused(*given, "--rigs", path)
    assert any(part in printed for part in message.split("|")), printed
    assert not (outputs / "queries-drive").exists()


def test_a_missing_configuration(rig, tmp_path, refused):
    folder, _, _, outputs = rig
    given = "--map", outputs / "map", "--query_images", folder, "--outputs", outputs
    assert "is missing" in refused(*given, "--rigs", tmp_path / "none.json")


def test_rigs_that_took_no_query(rig, tmp_path, refused):
    """Are refused even if the map was made of rigs."""
    folder, rigs, _, outputs = rig
    content = json.loads((outputs / "map/map.json").read_text())
    (outputs / "map/map.json").write_text(json.dumps(content | {"rigs": "0123"}))
    assert maps.Map(outputs / "map").has_rigs
    first, second = rigs[0]["cameras"]
    others = [first | {"image_prefix": "up/"}, second | {"image_prefix": "down/"}]
    path = write([{"cameras": others}], tmp_path)
    given = "--map", outputs / "map", "--query_images", folder, "--outputs", outputs
    assert "no photo is of a camera of a rig" in refused(*given, "--rigs", path)


def test_what_is_no_map_of_a_rig(rig, plane, tmp_path, refused):
    """Before any work is done."""
    _, rigs, _, _ = rig
    path, outputs = write(rigs, tmp_path), tmp_path / "new"
    given = "--map_images", plane / "images", "--outputs", outputs, "--rigs", path
    assert "no photo is of a camera of a rig" in refused(*given)
    message = refused(*given, "--map", plane / "model")
    assert "--rigs is for queries and maps of photos alone" in message
    assert not outputs.exists()


def test_rigs_of_the_map_or_the_queries(rig, plane, tmp_path, monkeypatch, refused):
    """The map is built with them if cameras of theirs took its photos."""
    folder, rigs, _, _ = rig
    path, outputs = write(rigs, tmp_path), tmp_path / "new"
    given = "--query_images", folder, "--outputs", outputs
    options = {}

    def stop(*_, **given):
        options.update(given)
        raise InputError("stopped")

    monkeypatch.setattr(localize.maps, "main", stop)
    for images, expected in ((plane / "images", None), (folder, path)):
        assert "stopped" in refused("--map_images", images, *given, "--rigs", path)
        assert options["rigs"] == expected


def test_rigs_of_no_query_are_refused_before_the_map_is_built(rig, place, tmp_path, refused):
    folder, rigs, _, _ = rig
    _, images, _ = place
    path, outputs = write(rigs, tmp_path), tmp_path / "new"
    given = "--map_images", folder, "--rigs", path, "--outputs", outputs
    message = refused(*given, "--query_images", images / "query")
    assert f"no photo is of a camera of a rig in {images / 'query'}" in message
    assert "without --query_images" in message and not outputs.exists()


def test_the_camera_mode_of_photos_of_rigs(rig, tmp_path, monkeypatch, refused):
    """Is that of other photos; without any, it is refused."""
    folder, rigs, _, _ = rig
    path, outputs = write(rigs, tmp_path), tmp_path / "new"
    given = "--map_images", folder, "--rigs", path, "--outputs", outputs
    message = refused(*given, "--camera_mode", "per_image")
    assert "Leave out --camera_mode" in message and not outputs.exists()
    shutil.copy(folder / "left/1.png", folder / "alone.png")
    modes = []

    def stop(*_, camera_mode, **given):
        modes.append(camera_mode)
        raise InputError("stopped")

    monkeypatch.setattr(localize.maps, "main", stop)
    assert "stopped" in refused(*given, "--camera_mode", "per_image")
    assert modes == [pycolmap.CameraMode.PER_IMAGE]
