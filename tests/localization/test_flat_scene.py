"""Photos of a nearly flat scene by the lens of the map's photos, as from a drone."""

import numpy as np
import pycolmap
import pytest

from hloc_reduce.localization import absolute_pose, intrinsics
from hloc_reduce.localization.gate import DEFAULT_GATE

pytestmark = pytest.mark.fault(6)
POSE = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, 0.2, 0.04])), [0.3, 0.1, 8.0])
GATE = DEFAULT_GATE.of_matches({"ratio_threshold": 0.8}, 64)


def solve(source: str, zoom: float, depth: float, bend: float) -> tuple[str | None, float]:
    """Return the refusal of a photo and its position error, as a share of the distance.

    Points are at 8 plus or minus a depth from the camera, in a map that is bent like a dome.
    """
    generator = np.random.default_rng(0)
    lens, true = (
        pycolmap.Camera(model="SIMPLE_RADIAL", width=1280, height=960, params=[f, 640, 480, 0])
        for f in (900, 900 * zoom)
    )
    pixels = generator.uniform([40, 40], [1240, 920], (400, 2))
    rays = np.pad(true.cam_from_img(pixels), ((0, 0), (0, 1)), constant_values=1)
    points = rays * generator.uniform(8 - depth, 8 + depth, (400, 1))
    points[:, 2] += bend * ((points[:, :2] ** 2).sum(axis=1) - 10)
    pixels += 0.7 * generator.standard_normal(pixels.shape)
    options = intrinsics.REFINEMENTS[source]
    found = absolute_pose.estimate(
        pixels, POSE.inverse() * points, [np.arange(400)], lens, options, GATE
    )
    centres = [pose.inverse().translation for pose in (found.cam_from_world, POSE)]
    return found.refusal, float(np.linalg.norm(centres[0] - centres[1])) / 8


@pytest.mark.parametrize(("depth", "bend"), [(0.05, 0.001), (0.06, 0.0012), (0.08, 0.0012)])
def test_a_focal_length_that_the_scene_hardly_tells_does_not_contradict_the_map(depth, bend):
    """Of a drone's photo with 440 inliers, one 8 % longer fitted 1 % better."""
    refusal, error = solve("map", 1, depth, bend)
    assert refusal is None and error < 0.005
    refusal, _ = solve("list", 1, depth, bend)  # a list may be wrong
    assert "contradict the map" in refusal


@pytest.mark.parametrize("zoom", [1.08, 1.15, 1.3])
@pytest.mark.parametrize("depth", [0.1, 0.4, 2])
def test_a_photo_that_was_enlarged_contradicts_the_lens_of_the_map(zoom, depth):
    """Although its EXIF data and its size are the same."""
    refusal, error = solve("map", zoom, depth, 0)
    assert error > 0.06 and "contradict the map" in refusal


def test_a_scene_that_tells_no_principal_point_does_not_make_a_photo_cropped():
    """With all intrinsics free, a slope in a bent map fits 5 to 10 % better, anywhere."""
    generator, slope = np.random.default_rng(1), np.array([np.sin(0.5), 0, np.cos(0.5)])
    true, guess = (
        pycolmap.Camera(model="SIMPLE_RADIAL", width=1280, height=960, params=[f, 640, 480, k])
        for f, k in ((900, -0.03), (1536, 0))
    )
    pixels = generator.uniform([10, 10], [1270, 950], (300, 2))
    rays = np.pad(true.cam_from_img(pixels), ((0, 0), (0, 1)), constant_values=1)
    depths = 8 * np.cos(0.5) / (rays @ slope) * generator.uniform(0.99, 1.01, 300)
    points = rays * depths[:, None]
    squares = ((points - points.mean(axis=0)) ** 2).sum(axis=1)
    points += 0.002 * (squares - squares.mean())[:, None] * slope
    pixels += 0.7 * generator.standard_normal(pixels.shape)
    options = {**intrinsics.REFINEMENTS["guess"], "photo": {"focal_lengths": [900, 900]}}
    found = absolute_pose.estimate(
        pixels, POSE.inverse() * points, [np.arange(300)], guess, options, GATE
    )
    assert found.refusal is None and found.camera.mean_focal_length() == pytest.approx(900, 0.01)
    centres = [pose.inverse().translation for pose in (found.cam_from_world, POSE)]
    assert np.linalg.norm(centres[0] - centres[1]) < 0.02 * 8
