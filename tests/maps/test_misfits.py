"""Photos of a map whose matches fit their poses badly."""

import numpy as np
import pytest
from row_of_photos import row

from hloc_reduce import maps
from hloc_reduce.mapping.epipolar import misplaced
from hloc_reduce.maps import misfits
from hloc_reduce.utils import colmap
from pipelines import localize

PIPELINE = localize


@pytest.mark.parametrize(
    ("turned", "worst"),
    [
        ({}, []),
        ({2: 0.02}, []),
        ({2: 0.25}, ["2.jpg"]),  # two pixels
        ({2: 0.25, 4: -0.4}, ["4.jpg", "2.jpg"]),
    ],
)
def test_photos_that_fit_badly_are_named(turned, worst, caplog):
    """The mapper and `misplaced` tolerate four pixels."""
    model, keypoints, verified = row(turned)
    assert misplaced(model, keypoints, verified) == []
    assert misfits.find(model, verified) == worst
    misfits.warn(worst)
    assert all(name in caplog.text for name in worst) and bool(caplog.text) == bool(worst)


def test_what_is_typical_of_the_map_counts():
    """All photos are turned by about a pixel; only one of them by three times as much."""
    small = {0: 0.1, 1: -0.1, 2: 0.1, 3: -0.1, 4: 0.1, 5: -0.1}
    for turned, worst in ((small, []), (small | {2: 0.3}, []), (small | {2: 0.6}, ["2.jpg"])):
        model, _, verified = row(turned)
        # pairs that are turned in the same way fit
        across = {
            pair: rows for pair, rows in verified.items() if (int(pair[0][0]) + int(pair[1][0])) % 2
        }
        assert misfits.find(model, across) == worst


def test_a_point_without_a_ray_does_not_hide_a_photo(monkeypatch):
    model, _, verified = row({2: 0.25})
    project = colmap.cam_from_img

    def without_one(camera, keypoints):
        rays = project(camera, keypoints)
        rays[7] = np.inf
        return rays

    monkeypatch.setattr(colmap, "cam_from_img", without_one)
    assert misfits.find(model, verified) == ["2.jpg"]


def test_wrong_matches_of_weaker_pairs_do_not_count():
    model, _, verified = row({})
    wrong = np.stack([np.arange(29), np.roll(np.arange(29), 7)], axis=1)
    for pair in verified:
        if "2.jpg" in pair and "3.jpg" not in pair:
            verified[pair] = wrong
    assert misfits.find(model, verified) == []
    verified[("3.jpg", "2.jpg")] = wrong  # no pair of it is right
    assert misfits.find(model, verified) == ["2.jpg"]


def test_few_matches_tell_nothing():
    model, _, verified = row({2: 0.25})
    assert misfits.find(model, {pair: rows[:14] for pair, rows in verified.items()}) == []
    assert misfits.find(model, {}) == []
    assert misfits.find(model, {("0.jpg", "absent.jpg"): verified[("1.jpg", "0.jpg")]}) == []


def test_such_a_map_is_refused_unless_it_is_accepted(plane, tmp_path, monkeypatch, run, refused):
    outputs = tmp_path / "outputs"
    given = ("--map_images", plane / "images", "--outputs", outputs, "--camera_mode", "single")
    monkeypatch.setattr(maps.building.misfits, "find", lambda *_: ["3.png"])
    message = refused(*given)
    assert "of the others: 3.png." in message and "--accept_partial" in message
    assert not (outputs / "map/map.json").exists()
    run(*given, "--accept_partial")
    built = maps.Map(outputs / "map")
    assert built.fitting_badly == ["3.png"]
    assert built.doubts == ["photos whose matches fit their poses badly"]
