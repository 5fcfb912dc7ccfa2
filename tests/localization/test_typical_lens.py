"""Queries without intrinsics, of the size of the map's photos: perhaps by their lens."""

from dataclasses import replace
from functools import cache

import numpy as np
import pycolmap
import pytest

from hloc_reduce.localization import absolute_pose, intrinsics
from hloc_reduce.localization.gate import DEFAULT_GATE, Gate
from hloc_reduce.localization.pose import Pose

POSE = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, 0.2, 0.04])), [0.3, 0.1, 8.0])
GATE = DEFAULT_GATE.of_matches({"ratio_threshold": 0.8}, 64)
LENS = intrinsics.Lens(900 / 1280, -0.05)


def camera_of(*params: float) -> pycolmap.Camera:
    return pycolmap.Camera(model="SIMPLE_RADIAL", width=1280, height=960, params=params)


@cache
def solve(
    typical: intrinsics.Lens | None,
    number: int,
    depth: float,
    seed: int = 3,
    gate: Gate = GATE,
    focal_lengths: tuple = (800, 1000),
    lean: float = 0,
) -> tuple[Pose, float]:
    """Return the pose of a query by LENS, and its position error as a share of the distance.

    In a map that leans, points to the right are farther from the camera, by a share of their x.
    """
    generator = np.random.default_rng(seed)
    pixels = generator.uniform([40, 40], [1240, 920], (number, 2))
    rays = camera_of(900, 640, 480, LENS.distortion).cam_from_img(pixels)
    distances = generator.uniform(8 - depth, 8 + depth, (number, 1))
    points = np.column_stack([rays, np.ones(number)]) * distances
    points[:, 2] += lean * points[:, 0]
    points = POSE.inverse() * points
    pixels += 0.7 * generator.standard_normal((number, 2))
    photo: dict = {"focal_lengths": focal_lengths}
    if typical is not None:
        photo["typical"] = [*typical]
    config = {**intrinsics.REFINEMENTS["guess"], "photo": photo}
    guess = camera_of(1536, 640, 480, 0)
    found = absolute_pose.estimate(pixels, points, [np.arange(number)], guess, config, gate)
    moved = found.cam_from_world * POSE.inverse()
    return found, float(np.linalg.norm(moved.translation)) / 8


def test_the_typical_lens_is_taken_where_it_fits():
    """One of 12 unedited photos was 5.7 % off, by a focal length that was 3 % too long."""
    free, error = solve(None, 30, 0.2)
    found, its_error = solve(LENS, 30, 0.2)
    assert free.refusal is None and free.camera.mean_focal_length() != 900
    assert found.refusal is None and found.camera.params.tolist() == [900, 640, 480, -0.05]
    assert its_error < 0.005 < 0.02 < error
    assert found.measures.agreement == free.measures.agreement


@pytest.mark.parametrize("number, depth", [(30, 0.5), (300, 0.2)])
@pytest.mark.parametrize(
    "zoom, distortion", [(1.035, -0.05), (1.05, -0.05), (0.92, -0.05), (1, 0.2)]
)
def test_an_unlike_lens_is_not_taken(number, depth, zoom, distortion):
    """By the confidence alone, one whose focal length is 5 % off would fit few matches."""
    other = intrinsics.Lens(zoom * LENS.focal_length, distortion)
    taken = 0
    for seed in range(3):
        free, _ = solve(None, number, depth, seed)
        found, _ = solve(other, number, depth, seed)
        assert found.refusal == free.refusal
        taken += found.camera.params.tolist() != free.camera.params.tolist()
    assert taken == 0 if number == 300 else taken < 3


def test_many_matches_do_not_exclude_a_lens_that_is_nearly_the_same():
    """Their errors may be alike: of 638 inliers of a castle, the focal length was 3 % too long."""
    like = intrinsics.Lens(1.01 * LENS.focal_length, LENS.distortion)
    found, _ = solve(like, 1200, 0.2)
    assert found.camera.params.tolist() == [909, 640, 480, -0.05]


@pytest.mark.parametrize("number, depth", [(30, 0.5), (300, 0.2)])
def test_the_right_lens_is_taken_mostly(number, depth):
    taken = 0
    for seed in range(3):
        free, error = solve(None, number, depth, seed)
        found, its_error = solve(LENS, number, depth, seed)
        if found.camera.params.tolist() == [900, 640, 480, -0.05]:
            taken += 1
            assert its_error < 0.005 and its_error < error + 0.001
    assert taken >= 2


def test_the_lens_of_a_photo_that_may_be_cropped_is_estimated():
    free, _ = solve(None, 30, 0.2, focal_lengths=(1000, 1100))
    found, _ = solve(LENS, 30, 0.2, focal_lengths=(1000, 1100))
    assert found.camera.params.tolist() == free.camera.params.tolist()


def test_the_typical_lens_does_not_make_up_for_a_flat_scene():
    """The photo may be by another lens, so its own one must be determined."""
    free, _ = solve(None, 30, 0.1)
    assert "do not fix the pose" in free.refusal
    assert solve(LENS, 30, 0.1)[0].refusal == free.refusal


def test_a_pose_with_the_typical_lens_is_judged():
    found, _ = solve(LENS, 30, 0.2, gate=Gate(min_inliers=31, min_probability=0))
    assert found.refusal == "too few inliers: 30, at least 31 are needed"


def test_a_pose_with_the_typical_lens_is_no_more_certain_than_its_matches_make_it(monkeypatch):
    """It may be bent by a match although the pose with an estimated lens is not."""
    agreed = absolute_pose._agreed

    def moved(matches, pose):
        found = agreed(matches, pose)
        if not matches.is_lens_by_size:
            return found
        return replace(found, precision=found.precision.at_least(0.05, 0))

    monkeypatch.setattr(absolute_pose, "_agreed", moved)
    found, _ = solve.__wrapped__(LENS, 30, 0.2)
    assert found.camera.params.tolist() == [900, 640, 480, -0.05]
    assert "its position is uncertain by 5.0 %" in found.refusal


@pytest.mark.parametrize("lean", [0.065, 0.08])
def test_a_photo_is_not_taken_for_a_stretched_one(lean):
    """Where the lens of the map's photos gives another pose, neither is trusted."""
    free, _ = solve(None, 200, 0.5, lean=lean)
    assert free.refusal is None and free.camera.model == pycolmap.CameraModelId.OPENCV
    assert "cropped or stretched" in solve(LENS, 200, 0.5, lean=lean)[0].refusal


def test_a_photo_that_was_stretched_is_taken_for_one():
    """Where the typical lens fits much worse, the estimated intrinsics stay."""
    free, _ = solve(None, 200, 1.5, lean=0.1)
    found, _ = solve(LENS, 200, 1.5, lean=0.1)
    assert free.refusal is found.refusal is None
    assert found.camera.params.tolist() == free.camera.params.tolist()
