"""Logos, time stamps and other overlays, which match themselves in photos of any place."""

from itertools import combinations

import numpy as np
import pytest

from hloc_reduce.mapping.checks.overlays import drop_overlays

NAMES = [f"{i}.jpg" for i in range(6)]


SCENE, LOGO, CLOCK = 100, 12, 6  # keypoints


def photos(step: float) -> tuple[dict, dict]:
    """Return keypoints and matches of photos between which a scene moves by some pixels.

    The first keypoints are of the scene, the next of a logo, the last of a clock below it, whose
    digits match each other in any order.
    """
    generator = np.random.default_rng(0)
    scene = generator.uniform(0, 1000, (SCENE, 2))
    logo = generator.uniform([1400, 1100], [1500, 1150], (LOGO, 2))
    clock = generator.uniform([1400, 1150], [1500, 1170], (CLOCK, 2))
    keypoints = {
        name: np.concatenate([scene + [step * i, 0], logo, clock]) for i, name in enumerate(NAMES)
    }
    fixed = np.arange(SCENE + LOGO)
    matches = {}
    for pair in combinations(NAMES, 2):
        digits = SCENE + LOGO + np.stack([np.arange(CLOCK), generator.permutation(CLOCK)], axis=1)
        matches[pair] = np.concatenate([np.stack([fixed, fixed], axis=1), digits])
    return keypoints, matches


def test_a_logo_and_the_clock_beside_it_are_dropped(caplog):
    keypoints, matches = photos(step=20)
    kept = drop_overlays(keypoints, matches)
    for indices in kept.values():
        assert (indices < SCENE).all() and len(indices) == SCENE


@pytest.mark.parametrize("step", [0, 0.5])
def test_photos_from_one_place_keep_their_matches(step):
    """Of a tripod, or of a slow video: all that they show is where it was."""
    keypoints, matches = photos(step)
    scene = {name: points[:SCENE] for name, points in keypoints.items()}
    kept = drop_overlays(scene, {pair: indices[:SCENE] for pair, indices in matches.items()})
    assert all(len(indices) == SCENE for indices in kept.values())


def test_a_few_photos_of_a_tripod_among_others_keep_their_matches():
    keypoints, matches = photos(step=20)
    scene = {name: points[:SCENE] for name, points in keypoints.items()}
    for name in NAMES[1:4]:
        scene[name] = scene[NAMES[0]]
    matches = {pair: indices[:SCENE] for pair, indices in matches.items()}
    kept = drop_overlays(scene, matches)
    assert all(len(indices) == SCENE for indices in kept.values())


def test_without_keypoints_or_matches():
    empty = np.zeros((0, 2), int)
    keypoints = {"a.jpg": np.zeros((0, 2)), "b.jpg": np.zeros((3, 2)), "c.jpg": np.zeros((0, 2))}
    kept = drop_overlays(keypoints, {("a.jpg", "b.jpg"): empty, ("a.jpg", "c.jpg"): empty})
    assert [len(indices) for indices in kept.values()] == [0, 0]
