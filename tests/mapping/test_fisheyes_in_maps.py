"""Maps of fisheye photos alone."""

import cv2
import matched_scene
import numpy as np
import pycolmap
import pytest
from alignment import similarity

from hloc_reduce import reconstruction
from hloc_reduce.localization import gate, intrinsics
from hloc_reduce.utils import colmap

PARAMS = [300.0, 302.0, 320.0, 240.0, -0.02, 0.004, 0.0, 0.0]


@pytest.mark.parametrize("params", [None, "250,250,320,240,0,0,0,0"])
def test_fisheyes_alone(params, tmp_path):
    """Up to a similarity, with their model and a guess or rough parameters: 90 degrees across."""
    camera = pycolmap.Camera(model="OPENCV_FISHEYE", width=640, height=480, params=PARAMS)
    poses = {}
    for i in range(8):
        rotation = cv2.Rodrigues(np.array([0.2 * np.cos(2 * i), 0.2 * i - 0.7, 0.05]))[0]
        place = np.array([0.1 * i, 0.05 * (i % 3), 3.4])
        poses[f"{i}.jpg"] = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), place)
    points = np.random.default_rng(1).uniform(-1.4, 1.4, (300, 3))
    given = matched_scene.write(tmp_path, poses, camera, points)
    options = {
        "camera_mode": pycolmap.CameraMode.SINGLE,
        "image_options": colmap.lens_options("OPENCV_FISHEYE", params),
    }
    model = reconstruction.main(tmp_path / "sfm", *given, **options)
    assert model.num_reg_images() == 8
    images = list(model.images.values())
    centres = np.array([image.projection_center() for image in images])
    true = np.array([poses[image.name].inverse().translation for image in images])
    assert np.linalg.norm(similarity(centres, true), axis=1).max() < 0.03  # of 4
    [found] = model.cameras.values()
    assert found.model.name == "OPENCV_FISHEYE"
    assert np.abs(np.array(found.params[:2]) / PARAMS[:2] - 1).max() < 0.02
    # queries of their size are localized with their lens
    told = intrinsics.of_cameras(image.camera for image in images)
    query, source = intrinsics.infer(np.zeros((480, 640), np.uint8), told)
    assert source == "lens" and list(query.params) == list(found.params)


@pytest.mark.parametrize(("model", "shortest"), [("SIMPLE_RADIAL", 0.3), ("SIMPLE_FISHEYE", 0.15)])
def test_the_shortest_focal_length(model, shortest):
    """A fisheye may show 180 degrees in a half of the photo."""
    if model not in colmap.CAMERA_MODELS:
        model = "OPENCV_FISHEYE"  # pycolmap 3.13
    camera = pycolmap.Camera()
    camera.model, camera.width, camera.height = model, 1000, 500
    camera.params = [500.0] * 2 + [0.0] * (len(camera.params_info.split(",")) - 2)
    assert gate.focal_lengths(camera, guessed=True)[0] == pytest.approx(1000 * shortest)
