"""Listed principal points far from the centre: of crops, or wrong."""

import numpy as np
import pycolmap
import pytest

from hloc_reduce.localization import absolute_pose
from hloc_reduce.localization.gate import DEFAULT_GATE
from hloc_reduce.localization.pose import Pose
from hloc_reduce.localization.projection import reprojection_errors

POSE = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, 0.2, 0.04])), [0.3, 0.1, 8.0])
GATE = DEFAULT_GATE.of_matches({"ratio_threshold": 0.8}, 64)


def solve(
    true_params: list, listed_params: list, number: int, depth: float = 3
) -> tuple[Pose, float]:
    """Return the pose with a listed camera, and its rotation error in degrees."""
    true, listed = (
        pycolmap.Camera(model="PINHOLE", width=1200, height=900, params=params)
        for params in (true_params, listed_params)
    )
    generator = np.random.default_rng(0)
    points = generator.uniform([-5, -4, -depth], [5, 4, depth], (60 * number, 3))
    _, image = reprojection_errors(np.zeros((len(points), 2)), points, POSE, true)
    inside = np.flatnonzero(((image > 0) & (image < [1200, 900])).all(axis=1))[:number]
    image, points = image[inside] + generator.standard_normal((number, 2)), points[inside]
    everything = [np.arange(number)]
    pose = absolute_pose.estimate(image, points, everything, listed, {}, GATE)
    moved = pose.cam_from_world * POSE.inverse()
    return pose, np.degrees(moved.rotation.angle())


@pytest.mark.parametrize("number", [12, 16, 20, 400])
def test_a_wrong_principal_point_is_refused(number):
    """As one that was scaled when the focal length was not: with few matches it seemed to fit."""
    pose, error = solve([1300, 1300, 600, 450], [1300, 1300, 1190, 890], number)
    assert pose.refusal is not None and error > 5


def test_that_of_a_crop_is_taken_where_the_matches_tell():
    corner = [1300, 1300, 250, 200]
    pose, error = solve(corner, corner, 400)
    assert pose.refusal is None and error < 0.5
    pose, _ = solve(corner, corner, 12, depth=0.01)
    assert "principal point is far from the centre" in pose.refusal


def test_swapped_coordinates_are_named():
    """80 matches fit them, with a rotation 6 degrees off."""
    pose, _ = solve([2600, 2600, 600, 450], [2600, 2600, 450, 600], 80)
    assert pose.refusal == "the x and y of its listed principal point are swapped"
    corner = [2600, 2600, 460, 330]
    assert solve(corner, corner, 80)[0].refusal is None
