"""Maps of photos alone that a rig of cameras took."""

import json
from types import SimpleNamespace

import cv2
import matched_scene
import numpy as np
import pycolmap
import pytest

from hloc_reduce import reconstruction
from hloc_reduce.localization.rigs import know_all
from hloc_reduce.mapping import database
from hloc_reduce.mapping.checks import Inputs, copies, few_points
from hloc_reduce.mapping.plausibility import keep_plausible
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError

PARAMS = [500.0, 500.0, 320.0, 240.0]
RIGHT_FROM_LEFT = pycolmap.Rigid3d(
    pycolmap.Rotation3d(np.array([0, 0.1, 0])), np.array([-0.75, 0.02, 0.1])
)


def config(**of_right):
    """Return a configuration of two cameras, with other values of the right one."""
    x, y, z, w = RIGHT_FROM_LEFT.rotation.quat
    known = {"camera_model_name": "PINHOLE", "camera_params": PARAMS}
    right = {
        "image_prefix": "right/",
        "cam_from_rig_rotation": [w, x, y, z],
        "cam_from_rig_translation": RIGHT_FROM_LEFT.translation.tolist(),
    }
    left = {"image_prefix": "left/", "ref_sensor": True}
    return [{"cameras": [left | known, right | known | of_right]}]


@pytest.fixture
def rig(tmp_path):
    """Five moments of two cameras around random points, another photo, and all pairs matched."""
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=PARAMS)
    poses = {}
    for i in range(6):
        rotation = cv2.Rodrigues(np.array([0.1 * np.cos(2 * i), 0.2 * i - 0.4, 0.05]))[0]
        left = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), np.array([0.1 * i, 0, 4.0]))
        of_rig = {f"left/{i}.jpg": left, f"right/{i}.jpg": RIGHT_FROM_LEFT * left}
        poses |= of_rig if i < 5 else {"other.jpg": left}
    points = np.random.default_rng(1).uniform(-1, 1, (300, 3))
    given = matched_scene.write(tmp_path, poses, camera, points)
    return SimpleNamespace(root=tmp_path, poses=poses, given=given, names=sorted(poses))


def write(rigs, folder):
    path = folder / "rig_config.json"
    path.write_text(json.dumps(rigs))
    return path


def test_the_map_of_a_rig_is_in_its_units(rig):
    path = write(config(), rig.root)
    model = reconstruction.main(rig.root / "sfm", *rig.given, rigs=path)
    images = {image.name: image for image in model.images.values()}
    assert sorted(images) == rig.names
    assert model.num_frames() == 6  # the other photo has its own
    centres = np.array([images[name].projection_center() for name in rig.names])
    true = np.array([rig.poses[name].inverse().translation for name in rig.names])
    found = pycolmap.estimate_sim3d(centres, true)
    assert abs(found.scale - 1) < 0.003
    assert np.linalg.norm([found * c for c in centres] - true, axis=1).max() < 0.01
    for i in range(5):
        left, right = images[f"left/{i}.jpg"], images[f"right/{i}.jpg"]
        assert left.frame_id == right.frame_id
        moved = right.cam_from_world() * left.cam_from_world().inverse()
        assert np.abs(moved.matrix() - RIGHT_FROM_LEFT.matrix()).max() < 1e-9
        assert list(right.camera.params) == PARAMS
    assert images["other.jpg"].camera.model.name == "SIMPLE_RADIAL"

    written = (rig.root / "sfm/images.bin").stat().st_mtime_ns
    reconstruction.main(rig.root / "sfm", *rig.given, rigs=path)
    assert (rig.root / "sfm/images.bin").stat().st_mtime_ns == written
    write(config(cam_from_rig_translation=[-1.5, 0.04, 0.2]), rig.root)  # is stale
    model = reconstruction.main(rig.root / "sfm", *rig.given, rigs=path)
    images = {image.name: image for image in model.images.values()}
    left, right = images["left/0.jpg"], images["right/0.jpg"]
    moved = right.cam_from_world() * left.cam_from_world().inverse()
    assert abs(moved.translation[0] + 1.5) < 1e-9


def test_the_scale_of_cameras_that_look_apart(tmp_path):
    """They see different points, so that the mapper hardly tells it: it was 6 % off."""
    generator = np.random.default_rng(1)
    points = generator.standard_normal((1500, 3))
    points *= generator.uniform(3, 6, (1500, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    turned = pycolmap.Rotation3d(np.array([0, np.pi, 0]))
    back_from_front = pycolmap.Rigid3d(turned, np.array([0, 0, -0.5]))
    params = [350.0, 350.0, 320.0, 240.0]
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=params)
    poses = {}
    for i in range(8):
        centre = np.array([1.2 * np.cos(0.5 * i), 0.3 * np.sin(i), 1.2 * np.sin(0.5 * i)])
        rotation = cv2.Rodrigues(np.array([0.05, 0.25 * i, 0.02]))[0]
        front = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centre)
        poses |= {f"left/{i}.jpg": front, f"right/{i}.jpg": back_from_front * front}
    x, y, z, w = turned.quat
    pose = {"cam_from_rig_rotation": [w, x, y, z], "cam_from_rig_translation": [0, 0, -0.5]}
    rigs = config(**pose, camera_params=params)
    rigs[0]["cameras"][0]["camera_params"] = params
    given = matched_scene.write(tmp_path, poses, camera, points)
    model = reconstruction.main(tmp_path / "sfm", *given, rigs=write(rigs, tmp_path))
    images = list(model.images.values())
    centres = np.array([image.projection_center() for image in images])
    true = np.array([poses[image.name].inverse().translation for image in images])
    assert len(images) == 16
    assert abs(pycolmap.estimate_sim3d(centres, true).scale - 1) < 0.001


def test_cameras_without_intrinsics_share_one_each(rig):
    path = rig.root / "1.db"
    rigs = config()
    del rigs[0]["cameras"][1]["camera_params"], rigs[0]["cameras"][1]["camera_model_name"]
    rigs = write(rigs, rig.root)
    mode = pycolmap.CameraMode.AUTO
    database.import_images(path, rig.given[0], rig.names, mode, rigs=rigs)
    with colmap.open_database(path) as opened:
        ids = {image.name: image.camera_id for image in opened.read_all_images()}
    cameras = colmap.read_cameras(path)
    assert len({ids[f"left/{i}.jpg"] for i in range(5)}) == 1 and len(cameras) == 3
    left, right = cameras[ids["left/0.jpg"]], cameras[ids["right/0.jpg"]]
    assert left.has_prior_focal_length and not right.has_prior_focal_length
    assert (left.model.name, right.model.name) == ("PINHOLE", "SIMPLE_RADIAL")
    assert (left.width, left.height) == (640, 480)
    assert database.fixed_cameras(path, rigs) == {ids["left/0.jpg"]}
    assert know_all(rigs, ["left/0.jpg"]) and not know_all(rigs, ["left/0.jpg", "right/0.jpg"])
    assert not know_all(rigs, ["left/0.jpg", "other.jpg"])


def test_photos_of_a_moment_are_judged_together(rig):
    """One that sees hardly anything stays with the other; both go if both do."""
    model = reconstruction.main(rig.root / "sfm", *rig.given, rigs=write(config(), rig.root))

    def blind(name):
        image = model.find_image_with_name(name)
        for index in image.get_observation_point2D_idxs():
            model.delete_observation(image.image_id, index)

    blind("right/3.jpg")
    assert not few_points.find(Inputs(model))
    (found,), dropped = keep_plausible([Inputs(model)])
    assert found.num_reg_images() == 11 and not dropped
    blind("left/3.jpg")
    (found,), dropped = keep_plausible([Inputs(model)])
    assert found.num_reg_images() == 9
    assert [{*one.names} for one in dropped] == [{"left/3.jpg", "right/3.jpg"}]


@pytest.mark.parametrize(("less", "found"), [("right/3.jpg", True), ("left/3.jpg", False)])
def test_copies_are_frames(less, found, rig, monkeypatch):
    """If the photos in the group see most of what the frame does."""
    model = reconstruction.main(rig.root / "sfm", *rig.given, rigs=write(config(), rig.root))
    image = model.find_image_with_name(less)
    for i in image.get_observation_point2D_idxs()[:250]:
        model.delete_observation(image.image_id, i)
    inputs = Inputs(model)
    index = [one.name for one in inputs.images].index("left/3.jpg")
    monkeypatch.setattr(copies.groups, "contradicting", lambda *_, **__: [index])
    names = [name for one in copies.find(inputs) for name in one.names]
    assert names == (["left/3.jpg", "right/3.jpg"] if found else [])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image_prefix": "back/"}, "no two photos were taken at one moment"),
        ({"camera_params": [-5.0, 500, 320, 240]}, "camera_params of right/"),
        ({"cam_from_rig_rotation": [2, 0, 0, 0]}, "right/ is no unit quaternion"),
    ],
)
def test_what_is_no_rig(change, message, rig):
    path = write(config(**change), rig.root)
    with pytest.raises(InputError, match=message):
        reconstruction.main(rig.root / "sfm", *rig.given, rigs=path)
    assert not (rig.root / "sfm").exists()


def test_a_rig_needs_photos_of_its_reference_camera(rig):
    rigs = config()
    third = {**rigs[0]["cameras"][1], "image_prefix": "other"}
    rigs[0]["cameras"].append(third)
    rigs[0]["cameras"][0]["image_prefix"] = "front/"
    path, (image_dir, *_) = write(rigs, rig.root), rig.given
    keypoints = {name: np.zeros((0, 2)) for name in rig.names}
    mode = pycolmap.CameraMode.AUTO
    with pytest.raises(InputError, match="no photo is of front/, the reference camera of right/"):
        database.write(rig.root / "1.db", image_dir, keypoints, {}, mode, verify=False, rigs=path)


def test_photos_of_a_camera_have_one_size(rig):
    image_dir, path = rig.given[0], write(config(), rig.root)
    cv2.imwrite(str(image_dir / "left/3.jpg"), np.zeros((100, 100), np.uint8))
    with pytest.raises(InputError, match=r"differ in size .* share their camera: left/3.jpg"):
        reconstruction.main(rig.root / "sfm", *rig.given, rigs=path)
