"""Queries without intrinsics, of the size of the map's photos: perhaps by their camera."""

import numpy as np
import pycolmap
import pytest

from hloc_reduce.localization import absolute_pose, intrinsics
from hloc_reduce.localization.confidence import DEFAULT_GATE
from hloc_reduce.localization.pose import Pose

POSE = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, 0.2, 0.04])), [0.3, 0.1, 8.0])
GATE = DEFAULT_GATE.of_matches({"ratio_threshold": 0.8}, 64)
LENS = [900, 640, 480, -0.05]


def camera_of(*params: float) -> pycolmap.Camera:
    return pycolmap.Camera(model="SIMPLE_RADIAL", width=1280, height=960, params=params)


def solve(typical: list | None, number: int, depth: float) -> tuple[Pose, float]:
    """Return the pose of a query by LENS, and its position error as a share of the distance."""
    generator = np.random.default_rng(3)
    pixels = generator.uniform([40, 40], [1240, 920], (number, 2))
    rays = np.column_stack([camera_of(*LENS).cam_from_img(pixels), np.ones(number)])
    points = POSE.inverse() * (rays * generator.uniform(8 - depth, 8 + depth, (number, 1)))
    pixels += 0.7 * generator.standard_normal((number, 2))
    photo = {"focal_lengths": [800, 1000]}
    if typical is not None:
        photo["camera"] = intrinsics.to_list(camera_of(*typical))
    config = {**intrinsics.REFINEMENTS["guess"], "photo": photo}
    guess = camera_of(1536, 640, 480, 0)
    found = absolute_pose.estimate(pixels, points, [np.arange(number)], guess, config, GATE)
    moved = found.cam_from_world * POSE.inverse()
    return found, float(np.linalg.norm(moved.translation)) / 8


def test_the_typical_camera_is_taken_where_it_fits():
    """One of 12 unedited photos was 5.7 % off, by a focal length that was 3 % too long."""
    free, error = solve(None, 30, 0.2)
    typical, its_error = solve(LENS, 30, 0.2)
    assert free.refusal is None and free.camera.mean_focal_length() != 900
    assert typical.refusal is None and typical.camera.params.tolist() == LENS
    assert its_error < 0.005 < 0.02 < error
    assert typical.agreement == free.agreement


@pytest.mark.parametrize("typical", [[990, 640, 480, -0.05], [900, 640, 480, 0.2]])
def test_another_camera_is_not_taken(typical):
    free, _ = solve(None, 300, 3)
    found, error = solve(typical, 300, 3)
    np.testing.assert_array_equal(found.camera.params, free.camera.params)
    assert found.refusal is None and error < 0.01


def test_the_typical_camera_does_not_make_up_for_few_matches():
    """The photo may be by another camera, so its own intrinsics must be determined."""
    free, _ = solve(None, 30, 0.1)
    assert "do not fix the pose" in free.refusal
    assert solve(LENS, 30, 0.1)[0].refusal == free.refusal
