"""Queries with a lens of any of COLMAP's camera models, also a fisheye, whose list is right."""

import numpy as np
import pycolmap
import pytest

from hloc_reduce.localization import absolute_pose
from hloc_reduce.localization.gate import DEFAULT_GATE

POSE = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, 0.2, 0.04])), [0.3, 0.1, 8.0])
GATE = DEFAULT_GATE.of_matches({"ratio_threshold": 0.8}, 64)
LENSES = {
    "SIMPLE_RADIAL": [900, 640, 480, -0.15],
    "FULL_OPENCV": [900, 910, 630, 485, -0.2, 0.05, 1e-3, -1e-3, 0, 0.01, 0, 0],
    "OPENCV_FISHEYE": [520, 521, 632, 477, 0.03, -0.01, 0.002, 0],
    "RADIAL_FISHEYE": [520, 632, 477, 0.03, -0.01],
    "FOV": [520, 521, 632, 477, 0.8],
}


@pytest.mark.parametrize("model", LENSES)
def test_a_listed_lens_is_used_as_it_is(model):
    camera = pycolmap.Camera(model=model, width=1280, height=960, params=LENSES[model])
    generator = np.random.default_rng(0)
    pixels = generator.uniform([40, 40], [1240, 920], (300, 2))
    rays = np.column_stack([camera.cam_from_img(pixels), np.ones(300)])
    points = POSE.inverse() * (rays * generator.uniform(5, 12, (300, 1)))
    pixels += 0.5 * generator.standard_normal((300, 2))
    pixels[260:] = generator.uniform([0, 0], [1280, 960], (40, 2))  # wrong matches
    pose = absolute_pose.estimate(pixels, points, [np.arange(300)], camera, {}, GATE)
    assert pose.refusal is None and pose.num_inliers >= 260
    moved = pose.cam_from_world * POSE.inverse()
    assert np.linalg.norm(moved.translation) < 0.02
    assert np.degrees(moved.rotation.angle()) < 0.1
