"""Photos whose poses contradict their matches."""

import numpy as np
import pycolmap
import pytest

from hloc_reduce.mapping.epipolar import misplaced
from hloc_reduce.mapping.plausibility import MISPLACED, keep_plausible
from hloc_reduce.utils import colmap

POINTS = np.random.default_rng(0).uniform(-1, 1, (60, 3))


def row(turned: dict[int, float]) -> tuple[pycolmap.Reconstruction, dict, dict]:
    """Six photos of 60 points in a row, some turned by degrees; their keypoints and matches."""
    model, keypoints = pycolmap.Reconstruction(), {}
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=640, height=480, params=[500, 320, 240], camera_id=1
    )
    for i in range(6):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), [0.4 * i - 1, 0, 6])
        pixels = camera.img_from_cam(POINTS + pose.translation)
        keypoints[f"{i}.jpg"] = pixels
        image = pycolmap.Image(name=f"{i}.jpg", keypoints=pixels, camera_id=1, image_id=i + 1)
        axis = np.radians(turned.get(i, 0)) * np.array([1, 0, 0])
        turn = pycolmap.Rigid3d(pycolmap.Rotation3d(axis), np.zeros(3))
        colmap.add_image(model, camera, image, turn * pose)
    for number, point in enumerate(POINTS):
        track = pycolmap.Track([pycolmap.TrackElement(i + 1, number) for i in range(6)])
        model.add_point3D(point, track)
    pairs = [(f"{i}.jpg", f"{j}.jpg") for i in range(6) for j in range(i)]
    return model, keypoints, dict.fromkeys(pairs, np.repeat(np.arange(60)[:, None], 2, axis=1))


@pytest.mark.parametrize(("turned", "worst"), [({}, []), ({2: 0.1}, []), ({2: 5.0}, ["2.jpg"])])
def test_the_pose_that_contradicts_most_matches(turned, worst):
    model, *matched = row(turned)
    assert misplaced(model, *matched) == worst


def test_few_matches_are_no_evidence():
    model, keypoints, verified = row({2: 5.0})
    few = {pair: rows[:14] for pair, rows in verified.items()}
    assert misplaced(model, keypoints, few) == []
    assert misplaced(model, keypoints, {}) == []


def test_groups_that_contradict_each_other():
    """Each agrees with itself, and all of its photos with most of their matches."""
    model, keypoints, verified = row({3: 5.0, 4: 5.0, 5: 5.0})
    across = {(f"{i}.jpg", f"{j}.jpg") for i in (3, 4, 5) for j in (0, 1, 2)}
    verified = {pair: rows[:20] if pair in across else rows for pair, rows in verified.items()}
    assert misplaced(model, keypoints, verified) in (
        ["0.jpg", "1.jpg", "2.jpg"],
        ["3.jpg", "4.jpg", "5.jpg"],
    )


def test_misplaced_photos_are_left_out_of_a_map():
    """Two sides of a castle were joined by a few wrong matches, the second one bent."""
    model, *matched = row({1: 5.0, 4: -8.0})
    given = {1: pycolmap.Camera(model.cameras[1].todict())}
    (kept,), dropped = keep_plausible([model], given, *matched)
    assert dropped == {"1.jpg": MISPLACED, "4.jpg": MISPLACED}
    assert kept.num_reg_images() == 4
