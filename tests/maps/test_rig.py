"""Rigs of cameras that are localized in memory."""

import copy

import cv2
import numpy as np
import pycolmap
import pytest

from hloc_reduce import Localizer, compact
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.localization import rig_pose
from hloc_reduce.localization.gate import Gate
from hloc_reduce.utils.cli import InputError


@pytest.fixture
def rig(build_map, plane, place):
    """A map; and two cameras: a query, and a photo of the map, which is darker in the rig."""
    folder, (_, images, _) = build_map(), place
    model = pycolmap.Reconstruction(plane / "model")
    by_name = {image.name: image for image in model.images.values()}
    first, second = by_name["4.png"], by_name["0.png"]
    true = first.cam_from_world()
    cams_from_rig = [pycolmap.Rigid3d(), second.cam_from_world() * true.inverse()]
    photos = [images / "query/day/a.png", cv2.imread(str(images / "db/0.png"))[..., ::-1] // 2]
    photos[1] = np.ascontiguousarray(photos[1])
    cameras = [copy.deepcopy(image.camera) for image in (first, second)]  # they outlive the model
    return folder, photos, cameras, cams_from_rig, true


@pytest.mark.parametrize("is_compact", [False, True])
def test_a_rig_is_localized_by_all_its_cameras(is_compact, rig, tmp_path):
    path, photos, cameras, cams_from_rig, true = rig
    if is_compact:
        compact.main(tmp_path / "map.hlm", path)
        path = tmp_path / "map.hlm"
    localizer = Localizer(path)
    pose, info = localizer.localize_rig(photos, cameras, cams_from_rig)
    assert info["reason"] is None
    distance, degrees = pose_error(pose, true)
    assert distance < 0.02 and degrees < 0.2
    alone, its = localizer.localize(photos[0], cameras[0])
    of_cameras = info["cameras"]
    assert info["num_inliers"] == sum(one["num_inliers"] for one in of_cameras)
    assert of_cameras[0]["num_correspondences"] == its["num_correspondences"]
    assert of_cameras[0]["retrieved"] == its["retrieved"]
    assert abs(of_cameras[0]["num_inliers"] - its["num_inliers"]) < 0.1 * its["num_inliers"]
    assert np.trace(info["covariance"]) < np.trace(its["covariance"])
    for one, camera, cam_from_rig in zip(of_cameras, cameras, cams_from_rig, strict=True):
        assert len(one["points2D"]) == len(one["points3D"]) == one["num_correspondences"]
        local = one["points3D"] @ (cam_from_rig * pose).rotation.matrix().T
        projected = camera.img_from_cam(local + (cam_from_rig * pose).translation)
        errors = np.linalg.norm(projected - one["points2D"], axis=1)
        assert errors[one["inliers"]].max() <= 12


@pytest.mark.parametrize("is_trusted", [False, True])
def test_an_uncertain_rig_is_matched_with_the_images_about_it(is_trusted, rig, monkeypatch):
    """Each camera retrieves one image."""
    path, photos, cameras, cams_from_rig, true = rig
    _, info = Localizer(path, num_loc=1).localize_rig(photos, cameras, cams_from_rig)
    assert [len(one["retrieved"]) for one in info["cameras"]] == [1, 1]  # it is certain
    number = info["num_inliers"]
    gate = Gate(min_inliers=8 if is_trusted else number + 1)
    monkeypatch.setattr(rig_pose, "CERTAIN", np.inf if is_trusted else 0.0)
    given = photos, cameras, cams_from_rig
    pose, more = Localizer(path, num_loc=1, gate=gate).localize_rig(*given)
    assert more["reason"] is None and more["num_inliers"] > number
    assert pose_error(pose, true)[0] < 0.02
    for one, before in zip(more["cameras"], info["cameras"], strict=True):
        assert one["retrieved"][0] == before["retrieved"][0] and len(one["retrieved"]) > 1
        assert len(set(one["retrieved"])) == len(one["retrieved"])
    pose, info = Localizer(path, num_loc=1, gate=Gate(min_inliers=10**6)).localize_rig(*given)
    assert pose is None and info["reason"].startswith("too few inliers")


def test_a_camera_that_was_moved_is_named(rig):
    path, photos, cameras, (first, second), _ = rig
    moved = pycolmap.Rigid3d(second.rotation, second.translation + [3.0, 0, 0])
    localizer = Localizer(path)
    pose, info = localizer.localize_rig(photos, cameras, [first, moved], ["left", "right"])
    assert pose is None and "contradict" in info["reason"]
    assert "left" in info["reason"] or "right" in info["reason"]


def test_what_is_no_rig(rig):
    path, photos, cameras, cams_from_rig, _ = rig
    localizer = Localizer(path)
    for given in ((photos[:1], cameras, cams_from_rig), ([], [], []), (photos, cameras, [])):
        with pytest.raises(InputError, match="A rig needs one of each for every camera, not"):
            localizer.localize_rig(*given)
    with pytest.raises(InputError, match=r"are pycolmap.Camera"):
        localizer.localize_rig(photos, [None, None], cams_from_rig)
    quaternion, nowhere = np.array([0, 0, 0, 2.0]), np.array([np.nan, 0, 0])
    for wrong in (
        np.eye(4),
        pycolmap.Rigid3d(pycolmap.Rotation3d(quaternion), np.zeros(3)),
        pycolmap.Rigid3d(pycolmap.Rotation3d(), nowhere),
    ):
        with pytest.raises(InputError, match=r"are pycolmap.Rigid3d"):
            localizer.localize_rig(photos, cameras, [cams_from_rig[0], wrong])
    with pytest.raises(InputError, match="camera 1 has 9x9 pixels, the photo has"):
        smaller = pycolmap.Camera(model="SIMPLE_PINHOLE", width=9, height=9, params=[9, 4, 4])
        localizer.localize_rig(photos, [cameras[0], smaller], cams_from_rig)
    for given in ([photos[0], None], [photos[0], 7]):
        with pytest.raises(InputError, match="An image is a file or an array, not"):
            localizer.localize_rig(given, cameras, cams_from_rig)
    with pytest.raises(InputError, match=r"NoneType: cv2.imread returns that"):
        localizer.localize(None)
    grey = np.full((*cv2.imread(str(photos[0])).shape[:2], 3), 128, np.uint8)
    pose, info = localizer.localize_rig([grey, grey], cameras, cams_from_rig)
    assert pose is None and info["reason"].startswith("too few inliers: 0")


def test_a_camera_that_sees_the_robot_is_masked(rig):
    """Of one camera, and of no other."""
    path, photos, cameras, cams_from_rig, true = rig
    localizer = Localizer(path)
    _, every = localizer.localize_rig(photos, cameras, cams_from_rig)
    mask = np.ones((270, 360), bool)
    mask[135:] = False
    pose, info = localizer.localize_rig(photos, cameras, cams_from_rig, masks=[None, mask])
    assert info["reason"] is None and pose_error(pose, true)[0] < 0.02
    before, after = every["cameras"], info["cameras"]
    assert after[0]["num_correspondences"] == before[0]["num_correspondences"]
    assert after[1]["points2D"][:, 1].max() <= 135 < before[1]["points2D"][:, 1].max()
    with pytest.raises(InputError, match="2 images, 2 cameras, 2 poses, 2 names and 1 masks"):
        localizer.localize_rig(photos, cameras, cams_from_rig, masks=[mask])
