"""Photos whose positions the points of a map hardly determine."""

import json

import numpy as np
import pycolmap
import pytest

from hloc_reduce.mapping import findings
from hloc_reduce.mapping.adjustment import focal_length_deviations
from hloc_reduce.mapping.checks import Inputs, positions
from hloc_reduce.utils import colmap


def seen_from(distances, depth, one_camera=False, turn=0.3):
    """Make a map of points in a box of a depth, with photos at some distances around it."""
    generator = np.random.default_rng(0)
    points = generator.uniform(-1, 1, (200, 3)) * [1, 1, depth / 2]
    model = pycolmap.Reconstruction()
    tracks = [pycolmap.Track() for _ in points]
    for i, distance in enumerate(distances):
        camera = pycolmap.Camera(
            model="SIMPLE_PINHOLE",
            width=1000,
            height=800,
            params=[200 * distance, 500, 400],
            camera_id=1 if one_camera else i + 1,
        )
        rotation = pycolmap.Rotation3d(turn * np.array([i % 2, i - len(distances) / 2, 0]))
        pose = pycolmap.Rigid3d(rotation, [0.1 * i, 0, distance])
        pixels = camera.img_from_cam(pose * points) + generator.normal(0, 1, (200, 2))
        image = pycolmap.Image(
            name=f"{i}.jpg", keypoints=pixels, camera_id=camera.camera_id, image_id=i + 1
        )
        colmap.add_image(model, camera, image, pose)
        for row, track in enumerate(tracks):
            track.add_element(i + 1, row)
    for at, track in zip(points, tracks, strict=True):
        model.add_point3D(at, track)
    return model


@pytest.mark.parametrize(
    ("distances", "depth", "one_camera", "turn", "expected"),
    [
        ([4, 4, 4, 4], 1, False, 0.3, []),
        ([4, 4, 4, 40], 1, False, 0.3, ["3.jpg"]),  # far away
        ([4, 4, 4, 4], 0.1, False, 0.3, ["2.jpg", "3.jpg"]),  # nearly flat
        ([40, 40, 40, 40], 0.1, True, 0.3, []),
        ([4, 4, 4, 4], 1, False, 0.1, ["0.jpg", "1.jpg", "2.jpg", "3.jpg"]),  # hardly turned
        ([4, 4, 4, 4], 1, False, 0, ["0.jpg", "1.jpg", "2.jpg", "3.jpg"]),  # parallel
        ([4, 4, 4, 4], 1, True, 0.1, []),
    ],
)
def test_photos_of_uncertain_positions_are_named(
    distances, depth, one_camera, turn, expected, caplog
):
    """Also those that are uncertain together: a photo of a facade was 25 % off without a word."""
    found = positions.find(Inputs(seen_from(distances, depth, one_camera, turn)))
    assert expected == sorted(findings.names_in(found))
    findings.warn(found)
    assert all(f"{name} (" in caplog.text for name in expected)
    assert bool(caplog.text) == bool(found)


def test_photos_that_see_little_do_not_make_others_uncertain():
    """Some with hardly a point, and one far away that sees a few; JSON has no infinity."""
    model = seen_from([4, 4, 4, 4, 4, 4, 40], 1)
    for image_id, kept in ((5, 3), (6, 0), (7, 8)):
        for i in range(kept, 200):
            model.delete_observation(image_id, i)
    (found,) = positions.find(Inputs(model))
    assert {*found.names} == {"4.jpg", "5.jpg", "6.jpg"}
    assert found.values["4.jpg"] == found.values["5.jpg"] == 1
    assert "4.jpg (at least 100 %)" in found.message
    content = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert findings.Finding.from_json(content) == found


def with_given_camera(model, camera_id):
    focal_length, *centre = model.cameras[camera_id].params
    params = [focal_length, focal_length, *centre, *8 * [0.0]]
    model.cameras[camera_id] = pycolmap.Camera(
        model="FULL_OPENCV", width=1000, height=800, params=params, camera_id=camera_id
    )


@pytest.mark.parametrize("far", [1, 3])
def test_photos_that_make_the_adjustment_singular_are_named_alone(far, monkeypatch):
    """In a map of tourists' photos one by a long lens made all 42 uncertain."""
    monkeypatch.setattr(positions, "VAGUE_FOCAL_SHARE", 1)
    model = seen_from([4, 4, 4, 4, 4, 4, *far * [40]], 1)
    for image_id in range(7, 7 + far):
        for i in range(40, 200):
            model.delete_observation(image_id, i)
    with_given_camera(model, 1)
    assert np.isinf(list(focal_length_deviations(model).values())).all()
    found = positions.measure(model)
    assert found.keys() == {f"{6 + i}.jpg" for i in range(far)} and found["6.jpg"] == 1


def test_given_intrinsics_are_known():
    """Such as those of a photo that was added with them: their models may be degenerate."""
    model = seen_from([4, 4, 4, 4, 4, 4], 1)
    with_given_camera(model, 6)
    assert positions.find(Inputs(model)) == []


@pytest.mark.parametrize(
    ("number", "one_camera", "typical", "refused"),
    [
        (10, False, [], True),
        (11, False, [], False),
        (5, False, [(1000, 800)], False),  # their focal lengths agree
        (5, False, [(800, 1000)], True),
        (5, True, [(1000, 800)], True),  # one camera always agrees with itself
    ],
)
def test_a_map_with_many_uncertain_positions_may_be_wrong(
    number, one_camera, typical, refused, monkeypatch
):
    """Six photos by tourists were 5 to 25 % off in maps that only had a warning."""
    monkeypatch.setattr(positions, "measure", lambda _: {"0.jpg": 0.07})
    (found,) = positions.find(Inputs(seen_from([4] * number, 1, one_camera), typical=typical))
    assert found.names == ("0.jpg",) and "0.jpg (7 %)" in found.message
    assert found.verdict == ("refuse" if refused else "warn")
    if refused:
        assert f"the positions of 1 of its {number} photos are uncertain" in found.message
