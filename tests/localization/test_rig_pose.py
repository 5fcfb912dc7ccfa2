"""The pose of a rig, of synthetic matches."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from hloc_reduce.localization import rig_pose
from hloc_reduce.localization.gate import Gate
from hloc_reduce.localization.measures import Seen, covariance, rig_covariance
from hloc_reduce.localization.rig_pose import Sight

GATE = Gate(match_kind="mutual")
CAMERA = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500, 500, 320, 240])
TURNS = (0.0, 90.0, 180.0, 270.0)  # degrees about y
TRUE = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, 0.4, -0.2])), np.array([0.3, -0.1, 0.5]))


def about_y(degrees, translation=(0, 0, 0)):
    rotation = pycolmap.Rotation3d(np.array([0, np.deg2rad(degrees), 0]))
    return pycolmap.Rigid3d(rotation, np.array(translation, float))


def sight(number, right, wrong, moved=None, seed=0, scale=1.0):
    """Return what a camera of a rig sees: right matches with noise of half a pixel, wrong ones.

    The rig is at TRUE, in a room whose walls are 3 to 6 units away; `moved` is where the camera
    is in fact, in the rig.
    """
    generator = np.random.default_rng([seed, number])
    cam_from_rig = about_y(TURNS[number], (0.2, 0, 0.1 * number))
    in_camera = generator.uniform([-2, -1.5, 3], [2, 1.5, 6], (right + wrong, 3))
    pose = (moved or cam_from_rig) * TRUE
    points3D = pose.inverse() * in_camera
    points2D = CAMERA.img_from_cam(in_camera) + generator.normal(0, 0.5, (right + wrong, 2))
    points2D[right:] = generator.uniform([0, 0], [640, 480], (wrong, 2))
    scaled = pycolmap.Rigid3d(cam_from_rig.rotation, scale * cam_from_rig.translation)
    config = {"estimation": {"ransac": {"max_error": 6.0}}}
    images = [np.arange(right + wrong)]
    name = f"camera{number}"
    return Sight(name, points2D, scale * points3D, images, CAMERA, scaled, config, GATE)


def error(found):
    """Return how far a pose is from the true one: units and degrees."""
    relative = found.rig_from_world * TRUE.inverse()
    return np.linalg.norm(relative.translation), np.degrees(relative.rotation.angle())


@pytest.mark.parametrize("cameras", [1, 2, 4])
def test_a_rig_is_where_its_cameras_say(cameras):
    found = rig_pose.estimate([sight(i, 40, 40) for i in range(cameras)], GATE)
    assert found.refusal is None
    distance, degrees = error(found)
    assert distance < 0.02 and degrees < 0.3
    assert found.measures.num_inliers >= 38 * cameras
    assert all(inliers[:40].sum() >= 38 for inliers in found.inliers)


@pytest.mark.parametrize("seed", range(6))
def test_a_pose_has_the_least_errors_not_the_most_inliers(seed):
    """Half of the keypoints are imprecise: a pose of few matches may agree with one match more."""
    sights = []
    for one in (sight(i, 60, 0, seed=seed) for i in range(2)):
        noise = np.random.default_rng([seed, len(sights)]).normal(0, 4, (60, 2))
        noise[::2] = 0
        sights.append(replace(one, points2D=one.points2D + noise))
    assert error(rig_pose.estimate(sights, GATE))[0] < 0.006


def test_cameras_that_cannot_tell_alone_tell_together():
    """Each has five right matches of 30: too few to be trusted, all together are enough."""
    sights = [sight(i, 6, 14) for i in range(4)]
    alone = [rig_pose.estimate([one], GATE) for one in sights]
    assert all(found.refusal for found in alone)
    found = rig_pose.estimate(sights, GATE)
    assert found.refusal is None
    assert error(found)[0] < 0.05


def test_more_cameras_are_more_precise():
    positions = [
        rig_pose.estimate([sight(i, 30, 10) for i in range(n)], GATE).measures.uncertainty.position
        for n in (1, 2, 4)
    ]
    assert positions == sorted(positions, reverse=True)


@pytest.mark.parametrize(
    "moved",
    [about_y(100, (0.2, 0, 0.1)), about_y(90, (1.5, 0, 0.1)), about_y(91.5, (0.2, 0, 0.1))],
)
def test_a_camera_that_contradicts_the_others_is_named(moved):
    """Even if it is turned by no more than poses that count as one may be."""
    sights = [sight(0, 60, 10), sight(1, 50, 10, moved), sight(2, 60, 10)]
    found = rig_pose.estimate(sights, GATE)
    assert found.refusal.startswith("camera1: their own matches contradict the rig")
    assert error(found)[0] < 0.02  # of the others


def test_wrong_matches_give_no_pose_that_is_trusted():
    found = rig_pose.estimate([sight(i, 0, 200) for i in range(4)], GATE)
    assert found.refusal


def test_cameras_without_a_match_do_no_harm():
    nothing = replace(sight(1, 0, 0), images=[np.zeros(0, np.int64)])
    found = rig_pose.estimate([sight(0, 40, 10), nothing], GATE)
    assert found.refusal is None and error(found)[0] < 0.03
    lost = rig_pose.estimate([nothing, nothing], GATE)
    assert lost.rig_from_world is None and lost.refusal.startswith("too few inliers: 0")


def test_two_poses_that_are_as_likely_are_ambiguous():
    """Half of each camera's matches are of a copy of the room elsewhere."""
    there = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, 1.0, 0])), np.array([9.0, 0, 2.0]))
    sights = []
    for i in range(2):
        first, second = sight(i, 40, 0), sight(i, 40, 0, seed=1)
        points3D = np.concatenate([first.points3D, there * second.points3D])
        points2D = np.concatenate([first.points2D, second.points2D])
        images = [np.arange(40), np.arange(40, 80)]
        sights.append(replace(first, points2D=points2D, points3D=points3D, images=images))
    found = rig_pose.estimate(sights, GATE)
    assert "ambiguous" in found.refusal


def test_the_unit_of_the_map_does_not_matter():
    sights = [sight(i, 40, 20) for i in range(3)]
    found = rig_pose.estimate(sights, GATE)
    scaled = rig_pose.estimate([sight(i, 40, 20, scale=1000.0) for i in range(3)], GATE)
    np.testing.assert_allclose(
        scaled.rig_from_world.translation, 1000 * found.rig_from_world.translation, rtol=1e-3
    )
    unit = np.repeat([1.0, 1000.0], 3)
    np.testing.assert_allclose(
        scaled.covariance, found.covariance * np.outer(unit, unit), rtol=0.05, atol=1e-9
    )
    assert scaled.measures.confidence == pytest.approx(found.measures.confidence, rel=0.01)


def test_the_covariance_of_a_rig_of_one_camera_is_that_of_the_camera():
    one = replace(sight(0, 50, 0), cam_from_rig=pycolmap.Rigid3d())
    seen = Seen(one.points2D, one.points3D, about_y(0, (0.2, 0, 0)) * TRUE, CAMERA, 6.0)
    expected = covariance(*seen[:4])
    np.testing.assert_allclose(rig_covariance([seen], [one.cam_from_rig]), expected, rtol=1e-6)


def test_the_covariance_is_that_of_repeated_estimates():
    """Estimates from matches with other noise scatter as it says."""
    twists, said = [], []
    for seed in range(60):
        found = rig_pose.estimate([sight(i, 40, 0, seed=seed) for i in (0, 1)], GATE)
        relative = found.rig_from_world * TRUE.inverse()
        axis = relative.rotation.quat[:3] * 2
        twists.append([*axis, *relative.translation])
        said.append(found.covariance)
    measured, expected = np.std(twists, axis=0), np.sqrt(np.diag(np.mean(said, axis=0)))
    np.testing.assert_allclose(measured, expected, rtol=0.35)


def with_focal_length(one, factor):
    """Return what a camera sees whose listed focal length is wrong by a factor."""
    params = [500 * factor, 500 * factor, 320, 240]
    wrong = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=params)
    return replace(one, camera=wrong)


@pytest.mark.parametrize("factor", [0.8, 1.25])
@pytest.mark.parametrize("cameras", [1, 2])
def test_wrong_intrinsics_contradict_the_map(factor, cameras):
    """Most matches agree with a pose that is a fifth of the depth away."""
    sights = [with_focal_length(sight(i, 150, 30), factor) for i in range(cameras)]
    found = rig_pose.estimate(sights, GATE)
    assert found.refusal is not None
    assert "camera0: its intrinsics contradict the map" in found.refusal


@pytest.mark.parametrize("right", [30, 150])
def test_wrong_intrinsics_of_one_camera_give_no_wrong_pose(right):
    sights = [sight(0, right, 30), with_focal_length(sight(1, 150, 30), 0.8)]
    found = rig_pose.estimate(sights, GATE)
    assert found.refusal is not None or error(found)[0] < 0.05


def test_right_intrinsics_do_not_contradict():
    sights = [sight(i, 150, 30) for i in range(3)]
    assert rig_pose.estimate(sights, GATE).refusal is None


def test_a_wrong_match_does_not_bend_the_pose_of_a_rig():
    """One of a nearer point, of one of two cameras that see a small, distant facade."""
    true, errors = about_y(35, (0, 0, 8)), []
    cams_from_rig = about_y(0), about_y(0, (-0.3, 0, 0))
    camera = pycolmap.Camera(
        model="PINHOLE", width=1600, height=1200, params=[1400, 1400, 800, 600]
    )
    for seed in range(60):
        generator = np.random.default_rng(seed)
        bent = about_y(35 + generator.choice([-1, 1]) * generator.uniform(3, 9), (0, 0, 8))
        sights = []
        for wrong, cam_from_rig in zip((1, 0), cams_from_rig, strict=True):
            facade = generator.uniform([-1, -0.7, 0], [1, 0.7, 0.02], (8, 3))
            nearer = generator.uniform([-3, -2, -4], [3, 2, -1.5], (wrong, 3))
            points3D = np.concatenate([facade, nearer, generator.uniform(-3, 3, (10, 3))])
            there = [cam_from_rig * true * facade, cam_from_rig * bent * nearer]
            points2D = camera.img_from_cam(np.concatenate(there))
            points2D += 1.5 * generator.standard_normal(points2D.shape)
            points2D = np.concatenate([points2D, generator.uniform(0, [1600, 1200], (10, 2))])
            images = np.split(np.arange(len(points3D)), [8 + wrong])
            config = {"estimation": {"ransac": {"max_error": 12.0}}}
            given = points2D, points3D, images, camera, cam_from_rig, config, GATE
            sights.append(Sight(str(wrong), *given))
        found = rig_pose.estimate(sights, GATE)
        if not found.refusal:
            relative = found.rig_from_world * true.inverse()
            errors.append(np.linalg.norm(relative.translation) / 8)
    # the noise alone moves some by 4 % of the distance
    assert len(errors) > 50 and np.sum(np.array(errors) > 0.03) < 8


def test_a_rig_is_certain_although_its_pose_cannot_be_refined(monkeypatch):
    sights = [sight(i, 40, 10) for i in range(3)]
    monkeypatch.setattr(rig_pose, "_refined_by", lambda *_: None)
    found = rig_pose.estimate(sights, GATE)
    assert found.refusal is None and 0 < found.measures.uncertainty.position < 0.01
