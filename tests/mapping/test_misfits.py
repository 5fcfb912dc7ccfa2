"""Photos of a map whose matches fit their poses badly."""

import numpy as np
import pytest
from row_of_photos import row

from hloc_reduce.mapping.checks import Inputs, misfits, misplaced
from hloc_reduce.utils import colmap


def named(inputs):
    """Return the photos that fit badly, the worst first."""
    return [name for one in misfits.find(inputs) for name in one.names]


@pytest.mark.parametrize(
    ("turned", "worst"),
    [
        ({}, []),
        ({2: 0.02}, []),
        ({2: 0.25}, ["2.jpg"]),  # two pixels
        ({2: 0.25, 4: -0.4}, ["4.jpg", "2.jpg"]),
    ],
)
def test_photos_that_fit_badly_are_named(turned, worst):
    """The mapper and `misplaced` tolerate four pixels."""
    inputs = Inputs(*row(turned))
    assert misplaced.find(inputs) == []
    assert named(inputs) == worst


def test_what_is_typical_of_the_map_counts():
    """All photos are turned by about a pixel; only one of them by three times as much."""
    small = {0: 0.1, 1: -0.1, 2: 0.1, 3: -0.1, 4: 0.1, 5: -0.1}
    for turned, worst in ((small, []), (small | {2: 0.3}, []), (small | {2: 0.6}, ["2.jpg"])):
        model, verified = row(turned)
        # pairs that are turned in the same way fit
        across = {
            pair: rows for pair, rows in verified.items() if (int(pair[0][0]) + int(pair[1][0])) % 2
        }
        assert named(Inputs(model, across)) == worst


def test_a_point_without_a_ray_does_not_hide_a_photo(monkeypatch):
    model, verified = row({2: 0.25})
    project = colmap.cam_from_img

    def without_one(camera, keypoints):
        rays = project(camera, keypoints)
        rays[7] = np.inf
        return rays

    monkeypatch.setattr(colmap, "cam_from_img", without_one)
    assert named(Inputs(model, verified)) == ["2.jpg"]


def test_wrong_matches_of_weaker_pairs_do_not_count():
    model, verified = row({})
    wrong = np.stack([np.arange(29), np.roll(np.arange(29), 7)], axis=1)
    for pair in verified:
        if "2.jpg" in pair and "3.jpg" not in pair:
            verified[pair] = wrong
    assert named(Inputs(model, verified)) == []
    verified[("3.jpg", "2.jpg")] = wrong  # no pair of it is right
    assert named(Inputs(model, verified)) == ["2.jpg"]


def test_few_matches_tell_nothing():
    model, verified = row({2: 0.25})
    few = {pair: rows[:14] for pair, rows in verified.items()}
    absent = {("0.jpg", "absent.jpg"): verified[("1.jpg", "0.jpg")]}
    for matches in (few, absent, {}, None):
        assert misfits.find(Inputs(model, matches)) == []
