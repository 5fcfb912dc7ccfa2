"""Where on Earth the cameras of a map are."""

import json

import numpy as np
import pycolmap
import pytest

from hloc_reduce.localization.frame import UNKNOWN, Frame
from hloc_reduce.utils import colmap

ORIGIN = (47.375, 8.5, 408.5)
FRAME = Frame("m", ("gps",), ORIGIN)
NORTH, EAST, UP = np.eye(3)[[1, 0, 2]]


def looking(forward, at=(0, 0, 0)):
    """Return the pose of a camera, camera from world, that is held upright."""
    forward = np.array(forward, float) / np.linalg.norm(forward)
    right = np.cross(forward, UP if abs(forward @ UP) < 0.99 else NORTH)
    right /= np.linalg.norm(right)
    rotation = np.array([right, np.cross(forward, right), forward])
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ np.array(at, float))


@pytest.mark.parametrize(
    ("forward", "heading"),
    [(NORTH, 0), (EAST, 90), (-NORTH, 180), (-EAST, 270), (NORTH + EAST + UP, 45), (-UP, None)],
)
def test_heading(forward, heading):
    found = FRAME.wgs84(looking(forward))
    if heading is None:
        assert found["heading"] is None
    else:
        assert 0 <= found["heading"] < 360
        assert np.sin(np.deg2rad(found["heading"] - heading) / 2) == pytest.approx(0, abs=1e-8)
    assert [found[key] for key in ("latitude", "longitude", "altitude")] == pytest.approx(ORIGIN)


def test_position():
    """A degree of latitude is 111.2 km here, one of longitude 75.5 km."""
    found = FRAME.wgs84(looking(EAST, at=(75.5, 111.2, -8.5)))
    assert found["latitude"] == pytest.approx(47.376, abs=2e-6)
    assert found["longitude"] == pytest.approx(8.501, abs=2e-6)
    assert found["altitude"] == pytest.approx(400, abs=0.01)


def test_true_north():
    """Ten kilometres east, the y axis of the frame is not north: meridians converge."""
    found = FRAME.wgs84(looking(NORTH, at=(10_000, 0, 0)))
    convergence = (found["longitude"] - ORIGIN[1]) * np.sin(np.deg2rad(ORIGIN[0]))
    assert found["heading"] == pytest.approx(convergence, abs=1e-3) and convergence > 0.09


def test_east_north_up_is_the_inverse():
    points = np.random.default_rng(0).uniform(-2000, 2000, (20, 3))
    positions = colmap.ellipsoid_from_enu(points, np.array(ORIGIN))
    found = colmap.enu_from_ellipsoid(positions, np.array(ORIGIN))
    np.testing.assert_allclose(found, points, atol=1e-6)


def test_without_an_altitude_or_an_origin():
    pose = looking(EAST)
    found = Frame("m", ("gps", "gravity"), (47.375, 8.5, np.nan)).wgs84(pose)
    assert found["altitude"] is None and found["latitude"] == pytest.approx(47.375)
    scaled = Frame("m", ("scale",))
    assert scaled.wgs84(pose) is None and scaled.row(pose) == {} == UNKNOWN.row(None)


def test_rows():
    pose = looking(EAST)
    cells = {"latitude": 47.375, "longitude": 8.5, "altitude": 408.5, "heading": 90}
    assert FRAME.row(pose) == cells
    assert FRAME.row(looking(NORTH - 1e-6 * EAST)) == cells | {"heading": 0}
    assert FRAME.row(None) == dict.fromkeys(cells)


@pytest.mark.parametrize(
    "frame",
    [UNKNOWN, FRAME, Frame("m", ("scale", "gravity")), Frame("m", ("gps",), (1, 2, np.nan))],
)
def test_json(frame):
    found = Frame.from_json(json.loads(json.dumps(frame.to_json(), allow_nan=False)))
    assert found[:2] == frame[:2]
    np.testing.assert_array_equal(np.array(found.origin, float), np.array(frame.origin, float))


def test_a_map_of_an_earlier_version():
    assert Frame.from_json(None) == UNKNOWN


@pytest.mark.parametrize(
    "changed",
    [
        {"units": "feet"},
        {"told_by": ["guess"]},
        {"origin": {"latitude": 91, "longitude": 0, "altitude": 0}},
        {"origin": {"latitude": None, "longitude": 0, "altitude": 0}},
        {"origin": {"latitude": 0, "longitude": 0, "altitude": float("inf")}},
        {"origin": {"latitude": 0}},
    ],
)
def test_broken_json(changed):
    with pytest.raises((KeyError, TypeError, ValueError)):
        Frame.from_json(FRAME.to_json() | changed)
