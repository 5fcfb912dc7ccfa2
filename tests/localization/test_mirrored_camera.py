"""Intrinsics of mirrored photos."""

import numpy as np
import pycolmap
import pytest

from hloc_reduce.localization.mirrored import mirror

FULL_OPENCV = [500, 510, 310, 250, 0.1, -0.02, 0.01, -0.03, 0.01, 0.02, 0.01, -0.01]
PARAMS = {
    "SIMPLE_RADIAL": [500, 310, 250, 0.1],
    "OPENCV": FULL_OPENCV[:8],
    "FULL_OPENCV": FULL_OPENCV,
    "THIN_PRISM_FISHEYE": FULL_OPENCV,
    "RAD_TAN_THIN_PRISM_FISHEYE": [*FULL_OPENCV, 0.02, -0.01, 0.01, 0.03],
}


@pytest.mark.parametrize("model", PARAMS)
def test_points_are_mirrored(model):
    """A point on the left of the camera is seen where the one on the right was."""
    camera = pycolmap.Camera(model=model, width=640, height=480, params=PARAMS[model])
    points = np.random.default_rng(0).uniform([-0.4, -0.3, 1], [0.4, 0.3, 2], (50, 3))
    seen, other = camera.img_from_cam(points), mirror(camera).img_from_cam(points * [-1, 1, 1])
    np.testing.assert_allclose(other, [640, 0] + seen * [-1, 1], atol=1e-9)
