"""Poses that can be trusted, and those that cannot: chance, precision, ambiguity."""

import re
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import binom

from hloc_reduce.localization import absolute_pose, measures
from hloc_reduce.localization.gate import DEFAULT_GATE, MATCH_KINDS, Gate, probability, refusal
from hloc_reduce.localization.measures import (
    Measures,
    Seen,
    Uncertainty,
    _log10_tail,
    agreement,
    confidence,
    covariance,
    independent_of,
    most_telling,
    uncertainty,
    uncertainty_without_one,
)
from hloc_reduce.localization.pose import motion
from hloc_reduce.localization.projection import reprojection_errors
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError

CAMERA = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1600, height=1200, params=[1400, 800, 600])
GUESS = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1600, height=1200, params=[1920, 800, 600])
FREE = {
    "estimation": {"estimate_focal_length": True},
    "refinement": {"refine_focal_length": True},
}


def pose_of(turn: float, translation: tuple[float, float, float]) -> pycolmap.Rigid3d:
    rotation = Rotation.from_euler("y", turn, degrees=True).as_matrix()
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), np.array(translation, float))


TRUE = pose_of(10, (0.3, 0.1, 8))


def matches(
    right: int, wrong: int, seed: int = 0, pose: pycolmap.Rigid3d = TRUE, noise: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return image points and world points of right matches, then of wrong ones."""
    generator = np.random.default_rng(seed)
    points = generator.uniform([-4, -3, -2], [4, 3, 2], (right + wrong, 3))
    _, projected = reprojection_errors(np.zeros((len(points), 2)), points, pose, CAMERA)
    projected += noise * generator.standard_normal(projected.shape)
    projected[right:] = generator.uniform(0, [1600, 1200], (wrong, 2))
    return projected, points


def solve(points2D, points3D, images=(), camera=CAMERA, config=None, gate=DEFAULT_GATE):
    return absolute_pose.estimate(points2D, points3D, list(images), camera, config or {}, gate)


@pytest.mark.parametrize("number", [4, 10, 30, 100, 1000, 5000])
@pytest.mark.parametrize("config", [{}, FREE], ids=["given", "guessed"])
def test_wrong_matches_are_never_trusted(number, config):
    """Whatever pose RANSAC finds among wrong matches, of whatever number."""
    for seed in range(5 if number < 1000 else 1):
        images = np.array_split(np.arange(number), 5)
        found = solve(*matches(0, number, seed), images, GUESS, config)
        assert found.refusal is not None and found.confidence < 3


def test_the_likeliest_matches_are_those_of_several_images_then_the_most_similar():
    images = [np.array([5, 0, 1]), np.array([3, 4, 5, 0]), np.array([2, 6])]
    # 0 and 5 are of two images, and 2 and 3 are the first ones of theirs
    assert absolute_pose.likeliest(images, 8, 4).tolist() == [0, 2, 3, 5]
    assert absolute_pose.likeliest([], 3).tolist() == [0, 1, 2]


@pytest.mark.parametrize(("right", "counts"), [(300, [500]), (30, [500, 4000])])
def test_all_matches_are_tried_unless_the_likeliest_give_a_certain_pose(right, counts, monkeypatch):
    """Few of all 4000 matches are right, but these are of two images, of four."""
    points2D, points3D = matches(right, 4000 - right)
    estimate, numbers = colmap.estimate_pose, []

    def counted(points2D, *others):
        numbers.append(len(points2D))
        return estimate(points2D, *others)

    monkeypatch.setattr(colmap, "estimate_pose", counted)
    halves = np.array_split(np.arange(right, 4000), 2)
    images = [np.arange(right), *halves, np.arange(right)]
    found = absolute_pose.estimate(
        points2D, points3D, images, CAMERA, {}, DEFAULT_GATE, thorough=False
    )
    assert found.refusal is None and found.num_inliers >= 0.95 * right
    distance = found.cam_from_world.inverse().translation - TRUE.inverse().translation
    assert np.linalg.norm(distance) < 0.01
    # the others are inliers, and outliers
    first = [number for number in numbers if number in (500, 4000)]
    assert first[: len(counts)] == counts
    assert (4000 in numbers) == (4000 in counts)


@pytest.mark.parametrize(("right", "wrong"), [(9, 0), (12, 20), (40, 300), (200, 1000)])
@pytest.mark.parametrize("config", [{}, FREE], ids=["given", "guessed"])
def test_right_matches_are_trusted(right, wrong, config):
    images = [np.arange(right), np.arange(right, right + wrong)]
    camera = GUESS if config else CAMERA
    found = solve(*matches(right, wrong), images, camera, config)
    assert found.refusal is None and found.confidence > 8
    assert found.num_inliers >= right - 1
    moved = found.cam_from_world * TRUE.inverse()
    assert np.degrees(moved.rotation.angle()) < 1 and np.linalg.norm(moved.translation) < 0.5


def test_few_inliers_are_refused():
    found = solve(*matches(6, 0))
    assert found.refusal == "too few inliers: 6, at least 8 are needed"
    assert solve(*matches(6, 0), gate=Gate(0, 6)).refusal is None
    reason = solve(*matches(12, 20), gate=Gate(1000, 6)).refusal
    assert reason.startswith("12 inliers of 32 matches may be chance: confidence 3")
    nothing = solve(np.zeros((0, 2)), np.zeros((0, 3)))
    assert nothing.cam_from_world is None and "too few inliers: 0" in nothing.refusal


def test_a_pose_from_far_away_explains_nothing():
    """Where all points fall into a small part of the image, keypoints there are near one."""
    generator = np.random.default_rng(0)
    points = generator.uniform(-1, 1, (500, 3))
    far = pose_of(0, (0, 0, 100))
    keypoints = np.array([800, 600]) + generator.uniform(-14, 14, (500, 2))
    errors, _ = reprojection_errors(keypoints, points, far, CAMERA)
    assert (errors < 12).mean() > 0.3
    assert confidence(keypoints, points, far, CAMERA, 12.0) < 0
    # the same keypoints in the whole image, the points too
    near = pose_of(0, (0, 0, 4))
    _, projected = reprojection_errors(keypoints, points, near, CAMERA)
    assert confidence(projected, points, near, CAMERA, 12.0) > 100


def test_keypoints_at_one_place_count_once():
    keypoints, points = matches(12, 30)
    once = confidence(keypoints, points, TRUE, CAMERA, 12.0)
    repeated = np.repeat(keypoints, 5, axis=0), np.repeat(points, 5, axis=0)
    assert abs(confidence(*repeated, TRUE, CAMERA, 12.0) - once) < 0.4 * once
    assert confidence(*repeated, TRUE, CAMERA, 12.0) < once


def test_more_chances_and_more_freedom_are_less_confidence():
    keypoints, points = matches(12, 30)
    once = confidence(keypoints, points, TRUE, CAMERA, 12.0)
    assert confidence(keypoints, points, TRUE, CAMERA, 12.0, 7) < once
    wrong = np.random.default_rng(1).permutation(points)
    more = np.concatenate([keypoints, keypoints]), np.concatenate([points, wrong])
    assert confidence(*more, TRUE, CAMERA, 12.0) < once


def test_points_behind_the_camera_are_no_inliers():
    keypoints, points = matches(20, 0)
    behind = pycolmap.Rigid3d(TRUE.rotation, -TRUE.translation)
    errors, projected = reprojection_errors(keypoints, points, behind, CAMERA)
    assert np.isinf(errors).all() and np.isnan(projected).all()
    assert confidence(keypoints, points, behind, CAMERA, 12.0) < 0


@pytest.mark.parametrize("trials", [5, 50, 1000])
@pytest.mark.parametrize("probability", [1e-4, 0.01, 0.3])
def test_the_tail_is_a_bound(trials, probability):
    for successes in range(trials + 1):
        exact = binom.logsf(successes - 1, trials, probability) / np.log(10)
        assert _log10_tail(successes, trials, probability) >= exact - 1e-9


def test_the_density_of_projections_is_that_of_the_nearest():
    """Found by all distances: of even, crowded and far away projections."""
    generator = np.random.default_rng(0)
    projected = np.concatenate(
        [generator.uniform(0, 900, (300, 2)), generator.normal(500, 9, (300, 2))]
    )
    projected[0] = 1e9
    points2D = generator.uniform(0, 1000, (200, 2))
    visible = np.unique(projected.round(), axis=0)
    distance = np.linalg.norm(points2D[:, None] - visible, axis=2)
    ninth = np.sort(distance, axis=1)[:, measures.NEIGHBORS]
    expected = measures.NEIGHBORS / 600 / (np.pi * np.maximum(ninth, 1) ** 2)
    uniform = 1 / (CAMERA.width * CAMERA.height)
    assert 0.2 < (expected > uniform).mean() < 0.8
    found = measures._density(points2D, projected, CAMERA)
    np.testing.assert_allclose(found, np.maximum(expected, uniform))


@pytest.mark.parametrize("free", [False, True])
def test_uncertainty_is_the_spread_of_poses(free):
    """As measured with keypoints of other noise."""
    camera, config = (GUESS, FREE) if free else (CAMERA, {})
    found = [solve(*matches(60, 0, noise=0), camera=camera, config=config)]
    keypoints, points = matches(60, 0, noise=0)
    generator = np.random.default_rng(0)
    for _ in range(30):
        noisy = keypoints + 2 * generator.standard_normal(keypoints.shape)
        found.append(solve(noisy, points, camera=camera, config=config))
    centres = [pose.cam_from_world.inverse().translation for pose in found]
    depth = 8
    measured = np.sqrt(np.var(centres[1:], axis=0).sum()) / depth
    noisy = keypoints + 2 * generator.standard_normal(keypoints.shape)
    expected, *_ = uncertainty(noisy, points, TRUE, CAMERA, 8 if free else 6)
    assert 0.6 < expected / measured < 1.6


def test_the_covariance_of_a_pose_is_that_of_the_estimator():
    """COLMAP's own, up to its loss, in its parameters: half angles and the moved origin."""
    keypoints, points = matches(200, 0, noise=0.3)
    found = pycolmap.estimate_and_refine_absolute_pose(keypoints, points, CAMERA, {}, {}, True)
    pose = found["cam_from_world"]
    found_here = covariance(keypoints, points, pose, CAMERA)
    x, y, z = pose.translation
    motion = np.eye(6)
    motion[3:, :3] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    motion[:3] /= 2
    expected, measured = found["covariance"], motion @ found_here @ motion.T
    scale = np.trace(measured) / np.trace(expected)
    np.testing.assert_allclose(measured, scale * expected, atol=0.05 * measured.max())


@pytest.mark.parametrize("wrong", [1, 2])
def test_wrong_matches_far_from_a_facade_do_not_bend_the_pose(wrong):
    """They agree with another pose, which fits the small, distant facade nearly as well."""
    true = pose_of(35, (0, 0, 8))
    trusted = []
    for seed in range(20):
        generator = np.random.default_rng(seed)
        bent = pose_of(35 + generator.choice([-1, 1]) * generator.uniform(4, 9), (0, 0, 8))
        facade = generator.uniform([-1, -0.7, 0], [1, 0.7, 0.02], (12, 3))
        nearer = generator.uniform([-3, -2, -4], [3, 2, -1.5], (wrong, 3))
        chance = generator.uniform(-3, 3, (10, 3))
        points = np.concatenate([facade, nearer, chance])
        _, keypoints = reprojection_errors(np.zeros((12, 2)), facade, true, CAMERA)
        _, wrong_ones = reprojection_errors(np.zeros((wrong, 2)), nearer, bent, CAMERA)
        keypoints = np.concatenate([keypoints, wrong_ones])
        keypoints += 0.6 * generator.standard_normal(keypoints.shape)
        keypoints = np.concatenate([keypoints, generator.uniform(0, [1600, 1200], (10, 2))])
        images = np.split(np.arange(len(points)), [12 + wrong])
        found = solve(keypoints, points, images)
        if not found.refusal:
            trusted.append(motion(found.cam_from_world, true)[0])
    # one never does; where two do, neither is the only one that tells much
    assert len(trusted) > 15 and sum(np.array(trusted) > 0.04 * 8) < wrong


def test_a_match_that_contradicts_all_others_does_not_bend_a_certain_pose():
    """45 matches of a facade with a noise of 1.5 pixels, and a wrong one of a nearer point."""
    true, errors = pose_of(35, (0, 0, 8)), []
    for seed in range(40):
        generator = np.random.default_rng(seed)
        bent = pose_of(35 + generator.choice([-1, 1]) * generator.uniform(2, 6), (0, 0, 8))
        facade = generator.uniform([-1, -0.7, 0], [1, 0.7, 0.02], (45, 3))
        nearer = generator.uniform([-3, -2, -4], [3, 2, -1.5], (1, 3))
        points = np.concatenate([facade, nearer, generator.uniform(-3, 3, (10, 3))])
        _, keypoints = reprojection_errors(np.zeros((45, 2)), facade, true, CAMERA)
        _, wrong = reprojection_errors(np.zeros((1, 2)), nearer, bent, CAMERA)
        keypoints = np.concatenate([keypoints, wrong])
        keypoints += 1.5 * generator.standard_normal(keypoints.shape)
        keypoints = np.concatenate([keypoints, generator.uniform(0, [1600, 1200], (10, 2))])
        found = solve(keypoints, points, np.split(np.arange(len(points)), [46]))
        if not found.refusal:
            errors.append(motion(found.cam_from_world, true)[0])
            assert found.confidence > absolute_pose.CERTAIN
    assert len(errors) > 38 and max(errors) < 0.03 * 8


def test_a_few_wrong_matches_together_do_not_bend_a_certain_pose():
    """Four of a nearer object, on several places, agree with another pose, which fits the rest."""
    true, errors = pose_of(35, (0, 0, 36)), []
    for seed in range(10):
        generator = np.random.default_rng(seed)
        bent = pose_of(35 + generator.choice([-1, 1]) * generator.uniform(1, 2), (0, 0, 36))
        facade = generator.uniform([-6, -4, 0], [6, 4, 1], (130, 3))
        nearer = generator.uniform([-9, -4, -24], [9, 4, -22], (1, 3))
        nearer = nearer + generator.uniform(-0.4, 0.4, (4, 3))
        points = np.concatenate([facade, nearer])
        _, keypoints = reprojection_errors(np.zeros((130, 2)), facade, true, CAMERA)
        _, wrong = reprojection_errors(np.zeros((4, 2)), nearer, bent, CAMERA)
        keypoints = np.concatenate([keypoints, wrong])
        keypoints += 0.4 * generator.standard_normal(keypoints.shape)
        found = solve(keypoints, points)
        assert found.refusal is None and found.confidence > absolute_pose.CERTAIN
        errors.append(motion(found.cam_from_world, true)[0])
    assert max(errors) < 0.01 * 36


def test_a_pose_is_as_certain_as_it_is_without_the_keypoint_that_tells_most():
    """One of them is much nearer than the others, and has another scale at the same place."""
    generator = np.random.default_rng(0)
    points = generator.uniform([-1, -1, 0], [1, 1, 0.02], (20, 3))
    points[-2:] = [[0.5, 0.3, -4], [0.5005, 0.3, -4]]
    pose = pose_of(0, (0, 0, 8))
    _, keypoints = reprojection_errors(np.zeros((20, 2)), points, pose, CAMERA)
    keypoints += generator.standard_normal(keypoints.shape)
    keypoints[-1] = keypoints[-2] + 0.5
    seen = Seen(keypoints, points, pose, CAMERA, 12.0)
    found = uncertainty_without_one(seen)
    assert found == uncertainty(keypoints[:-2], points[:-2], pose, CAMERA)
    assert found.position > 2 * uncertainty(keypoints, points, pose, CAMERA).position
    # also where it is matched with many points, each of which tells less than another keypoint
    rows = [*range(20), *[18] * 7]
    repeated = Seen(keypoints[rows], points[rows], pose, CAMERA, 12.0)
    _, telling = most_telling([repeated], [pycolmap.Rigid3d()])
    np.testing.assert_array_equal(np.flatnonzero(~telling), np.arange(18))
    alone = Seen(*(values[-2:] for values in (keypoints, points)), pose, CAMERA, 12.0)
    assert uncertainty_without_one(alone) == measures.UNDETERMINED
    # so it is with a rig, whose second camera sees only that point
    cams_from_rig = [pycolmap.Rigid3d(), pose_of(20, (0.1, 0, 0))]
    own = cams_from_rig[1] * pose
    _, others = reprojection_errors(keypoints[-1:], points[-1:], own, CAMERA)
    photos = [
        Seen(keypoints[:-2], points[:-2], pose, CAMERA, 12.0),
        Seen(others, points[-1:], own, CAMERA, 12.0),
    ]
    camera, telling = most_telling(photos, cams_from_rig)
    assert camera == 1 and telling.all()


def test_matches_that_determine_no_pose_have_no_precision():
    """On two points, so that the matrix of their derivatives is singular."""
    points = np.array([[-1.0, 0, 3]] * 4 + [[-1, -2, 5]] * 2)
    keypoints = CAMERA.img_from_cam(points)
    seen = Seen(keypoints, points, pycolmap.Rigid3d(), CAMERA, 12.0)
    most, telling = most_telling([seen], [pycolmap.Rigid3d()])
    assert most == 0 and telling.any()
    assert uncertainty_without_one(seen) == measures.UNDETERMINED


def test_matches_of_a_keypoint_count_once_in_how_certain_a_pose_is():
    generator = np.random.default_rng(0)
    points, pose = generator.uniform([-1, -1, 0], [1, 1, 1], (20, 3)), pose_of(0, (0, 0, 8))
    _, keypoints = reprojection_errors(np.zeros((20, 2)), points, pose, CAMERA)
    keypoints += generator.standard_normal(keypoints.shape)
    seen = Seen(keypoints, points, pose, CAMERA, 12.0)
    rows = np.repeat(np.arange(20), 3)
    repeated = seen._replace(points2D=keypoints[rows], points3D=points[rows])
    assert independent_of([seen]) == pytest.approx(20) == independent_of([repeated])
    assert independent_of([repeated] * 9) == measures.INDEPENDENT
    once, thrice = uncertainty_without_one(seen), uncertainty_without_one(repeated)
    np.testing.assert_allclose(thrice[:2], once[:2], rtol=0.1)


def test_inliers_that_do_not_fix_the_pose_are_refused():
    """All of them lie in a narrow band of the image, and nearly in a plane."""
    generator = np.random.default_rng(0)
    points = generator.uniform([-0.005, -0.2, -0.005], [0.005, 0.2, 0.005], (20, 3))
    _, keypoints = reprojection_errors(np.zeros((20, 2)), points, pose_of(0, (0, 0, 2)), CAMERA)
    keypoints += generator.standard_normal(keypoints.shape)
    found = solve(keypoints, points)
    assert "the inliers do not fix the pose" in found.refusal
    assert "known intrinsics would help" not in found.refusal
    free = replace(found.measures, is_focal_length_free=True, focal_length=1400)
    assert "known intrinsics would help" in refusal(free, DEFAULT_GATE)
    assert uncertainty(keypoints[:3], points[:3], TRUE, CAMERA) == (np.inf, np.inf, np.inf)


@pytest.mark.parametrize(("uncertain", "is_refused"), [(0.029, False), (0.031, True)])
def test_a_position_is_certain_to_3_percent(uncertain, is_refused):
    found = solve(*matches(20, 0)).measures
    reason = refusal(replace(found, uncertainty=Uncertainty(uncertain, 0.1, 0)), DEFAULT_GATE)
    assert ("% of the distance (at most 3 %)" in (reason or "")) == is_refused
    reason = refusal(replace(found, uncertainty=measures.UNDETERMINED), DEFAULT_GATE)
    assert "by at least 100 % of" in reason and "by at least 180 degrees" in reason


def test_a_focal_length_that_no_lens_has_is_refused():
    """Seen from close by with a fisheye's focal length, and from afar with a telescope's."""
    for focal_length in (150, 20_000):
        camera = pycolmap.Camera(
            model="SIMPLE_PINHOLE", width=1600, height=1200, params=[focal_length, 800, 600]
        )
        pose = pose_of(10, (0, 0, 6 * focal_length / 1400 + 3))
        points = np.random.default_rng(0).uniform(-1, 1, (300, 3)) * [1, 1, 0.9]
        _, keypoints = reprojection_errors(np.zeros((300, 2)), points, pose, camera)
        found = solve(keypoints, points, camera=GUESS, config=FREE)
        assert found.refusal.startswith("no plausible focal length") or (
            "do not fix" in found.refusal
        )


def test_one_image_at_a_time_finds_what_is_rare_among_all():
    """Of 4,000 matches 40 are right, nearly all of them in one of the images."""
    keypoints, points = matches(40, 4000)
    order = np.r_[np.arange(40), 40 + np.arange(4000)]
    images = [order[:100], *np.array_split(order[100:], 30)]
    alone = solve(keypoints, points)
    found = solve(keypoints, points, images)
    assert alone.refusal is not None
    assert found.refusal is None and found.num_inliers >= 38
    moved = found.cam_from_world * TRUE.inverse()
    assert np.degrees(moved.rotation.angle()) < 1 and np.linalg.norm(moved.translation) < 0.3


def test_two_poses_that_fit_as_well_are_ambiguous():
    """Half of the matches are those of another place that looks the same."""
    first, second = matches(60, 0), matches(60, 0, pose=pose_of(40, (2, 0, 9)), seed=1)
    wrong = matches(0, 500, seed=2)
    keypoints, points = (np.concatenate(part) for part in zip(first, second, wrong, strict=True))
    images = [np.r_[:60, 120:200], np.r_[60:120, 200:280], np.r_[280:620]]
    found = solve(keypoints, points, images)
    assert found.refusal.startswith("ambiguous: another pose has ")


def test_a_gate_is_of_numbers():
    with pytest.raises(InputError, match="min_confidence is nan"):
        Gate(float("nan"))
    with pytest.raises(InputError, match="min_inliers is -1"):
        Gate(min_inliers=-1)
    with pytest.raises(InputError, match="min_probability is 30"):
        Gate(min_probability=30)


@pytest.mark.parametrize("kind", MATCH_KINDS)
def test_each_piece_of_evidence_speaks_for_a_pose(kind):
    gate = Gate(match_kind=kind)
    doubtful = Measures(confidence=10, agreement=0.5)
    better = [
        replace(doubtful, confidence=200),
        replace(doubtful, agreement=0.6),
    ]
    assert all(probability(one, gate) > probability(doubtful, gate) for one in better)
    assert probability(Measures(), gate) < 0.01
    sure = Measures(confidence=500, agreement=1)
    assert probability(sure, gate) > 0.99
    assert probability(replace(sure, confidence=5000), gate) == probability(sure, gate)


def test_fewer_matches_of_few_dimensions_agree():
    """A query of a real room was refused, by 16 numbers: 0.65 of the matches of an image agreed."""
    found = Measures(confidence=529, agreement=0.65)
    strict = {"ratio_threshold": 0.8}
    few, many = (DEFAULT_GATE.of_matches(strict, dim) for dim in (16, 64))
    assert probability(found, few) > few.least_probability
    assert probability(found, many) < many.least_probability
    assert DEFAULT_GATE.of_matches({}, 16) == DEFAULT_GATE.of_matches({}, 64)


def test_a_user_may_ask_for_another_probability():
    given = *matches(60, 5), [np.arange(65)]
    gate = DEFAULT_GATE.of_matches({"ratio_threshold": 0.8}, 64)
    found = solve(*given, gate=gate)
    assert found.refusal is None
    least = probability(found.measures, gate) + 0.001
    refused = solve(*given, gate=replace(gate, min_probability=least))
    assert f"at least {least:g} is needed" in refused.refusal


def test_a_pose_that_no_image_agrees_with_is_refused():
    """As that of a mirrored photo of a symmetric facade: a third of the matches of each image."""
    keypoints, points = matches(60, 120)
    images = np.split(np.random.default_rng(0).permutation(180), 3)
    gate = DEFAULT_GATE.of_matches({"ratio_threshold": 0.8}, 64)
    found = solve(keypoints, points, images, gate=gate)
    assert found.confidence > 100
    assert found.refusal.startswith(
        "too few matches of any image agree with the pose: agreement 0."
    )
    # without a strict ratio test most matches of any image are wrong
    for matcher in ({}, {"ratio_threshold": 0.95}):
        lenient = DEFAULT_GATE.of_matches(matcher, 64)
        assert solve(keypoints, points, images, gate=lenient).refusal is None
    one = [np.arange(60), np.arange(60, 180)]
    assert solve(keypoints, points, one, gate=gate).refusal is None
    assert agreement(np.ones(8, bool), [np.arange(8)]) == pytest.approx(8 / 9)
    few = np.r_[np.ones(5, bool), np.zeros(15, bool)]
    assert agreement(few, [np.arange(5)]) < 0.25  # five of an image tell nothing
    assert agreement(few, []) == agreement(few, [np.arange(5)])
    assert agreement(np.zeros(0, bool), []) == 0


def test_values_below_a_limit_are_not_printed_as_the_limit():
    """A photo was refused with 'agreement 0.86, at least 0.86 is needed'."""
    given = *matches(60, 20), [np.arange(80)]
    found = solve(*given)
    for strict in (
        Gate(min_probability=probability(found.measures, DEFAULT_GATE) + 1e-4),
        Gate(min_confidence=found.confidence + 1e-4),
    ):
        reason = solve(*given, gate=strict).refusal
        value, least = re.search(
            r"(?:probability|confidence) ([\d.]+), at least ([\d.]+)", reason
        ).groups()
        assert float(value) < float(least)


@pytest.mark.parametrize(("number", "repeated"), [(3, 8), (3, 12), (5, 3), (8, 4)])
def test_clusters_of_matches_of_few_points_are_refused(number, repeated):
    """Three points fit a pose always, however many keypoints beside each other match them."""
    for seed in range(3):
        generator = np.random.default_rng(seed)
        points = generator.uniform([-4, -3, -2], [4, 3, 2], (number, 3))
        spots = generator.uniform(0, [1600, 1200], (number, 2))
        around = np.repeat(spots, repeated, axis=0)
        around += generator.uniform(-3, 3, around.shape)
        noise = matches(0, 20, seed)
        keypoints = np.concatenate([around, noise[0]])
        world = np.concatenate([np.repeat(points, repeated, axis=0), noise[1]])
        assert solve(keypoints, world, [np.arange(len(world))]).refusal is not None


def test_the_likeliest_matches_are_only_a_start(monkeypatch):
    """All that are near the first pose are tried then, not only those that agree with it."""
    first = matches(500, 0, pose=pose_of(11.5, (0.3, 0.1, 8)))  # of a part that is turned
    others = matches(1500, 500, seed=1, noise=5.0)
    keypoints, points = (np.concatenate(part) for part in zip(first, others, strict=True))
    estimate_pose, tried, poses = colmap.estimate_pose, [], []

    def recorded(points2D, *options):
        tried.append(len(points2D))
        poses.append(estimate_pose(points2D, *options))
        return poses[-1]

    monkeypatch.setattr(colmap, "estimate_pose", recorded)
    found = solve(keypoints, points, [np.arange(500), np.arange(500), np.arange(500, 2500)])
    assert tried[0] == absolute_pose.SAMPLE and poses[0]["num_inliers"] > 490
    assert tried[1] > 1990
    assert found.num_inliers > 1700


@pytest.mark.parametrize("number", [12, 40, 120])
def test_wrong_matches_do_not_bend_a_pose(number):
    """Points of a wall fit another pose, too, up to some pixels; wrong matches that fit it exactly
    give it more inliers, but it is less likely than the pose that the right ones fit closely.
    """
    generator = np.random.default_rng(number)
    points = generator.uniform([-1.9, -1.9, -0.02], [1.9, 1.9, 0.02], (number + 2, 3))
    bent = pose_of(15, (0, 0, 8))
    points[number:] = [[3, 1, -2], [-2, 2, 3]]
    projected = [
        reprojection_errors(np.zeros((len(points), 2)), points, pose, CAMERA)[1]
        for pose in (pose_of(10, (0, 0, 8)), bent)
    ]
    assert np.linalg.norm(projected[0] - projected[1], axis=1)[:number].max() < 12
    keypoints = np.concatenate([projected[0][:number], projected[1][number:]])
    keypoints += 0.5 * generator.standard_normal(keypoints.shape)
    found = solve(keypoints, points, [np.arange(number + 2)])
    turned = (found.cam_from_world * pose_of(10, (0, 0, 8)).inverse()).rotation.angle()
    assert np.degrees(turned) < 1 and found.inliers[:number].all()


@pytest.mark.parametrize("number", [51, 62])
def test_a_rival_is_looked_for_where_many_matches_disagree(number):
    """Of two places that look the same, one with fewer photos, the matches are divided."""
    other = 100 - number
    first, second = matches(number, 0), matches(other, 0, pose=pose_of(0, (50, 0, 8)), seed=1)
    keypoints, points = (np.concatenate(part) for part in zip(first, second, strict=True))
    found = solve(keypoints, points, [np.arange(0, 100, 2), np.arange(1, 100, 2)])
    assert found.refusal == f"ambiguous: another pose has {other} inliers, this one {number}"


def test_a_rival_is_found_in_a_sample_of_many_matches(monkeypatch):
    first = matches(800, 0)
    # the right ones come last
    second = (part[::-1] for part in matches(600, 1600, seed=1, pose=pose_of(0, (50, 0, 8))))
    keypoints, points = (np.concatenate(part) for part in zip(first, second, strict=True))
    estimate, numbers = absolute_pose._estimate, []

    def counted(its_matches, chosen, *options):
        numbers.append(len(chosen))
        return estimate(its_matches, chosen, *options)

    monkeypatch.setattr(absolute_pose, "_estimate", counted)
    found = solve(keypoints, points, [np.arange(800), np.arange(800, 3000)])
    assert numbers[-1] == absolute_pose.SAMPLE
    assert found.refusal is not None
    assert re.fullmatch("ambiguous: another pose has [56].. inliers, this one 8..", found.refusal)


@pytest.mark.parametrize("replaced", [False, True])
@pytest.mark.parametrize("workers", [1, 3])
def test_a_rival_is_found_in_another_thread(replaced, workers, monkeypatch):
    """Also if other intrinsics have replaced the pose in the meantime."""
    first, second = matches(60, 0), matches(40, 0, pose=pose_of(0, (50, 0, 8)), seed=1)
    parts = (np.concatenate(part) for part in zip(first, second, strict=True))
    images = [np.arange(0, 100, 2), np.arange(1, 100, 2)]
    try_others = absolute_pose.with_other_intrinsics

    def tried(its_matches, pose):
        best, others = try_others(its_matches, pose)
        # one whose rival has other matches
        kept = best.inliers & (np.arange(100) < 59)
        return (replace(best, inliers=kept) if replaced else best), others

    monkeypatch.setattr(absolute_pose, "with_other_intrinsics", tried)
    found = absolute_pose.estimate(*parts, images, CAMERA, {}, DEFAULT_GATE, True, workers)
    number = 59 if replaced else 60
    assert found.refusal == f"ambiguous: another pose has 40 inliers, this one {number}"


def test_the_size_of_a_photo_changes_nothing():
    keypoints, points = matches(12, 30)
    large = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=4800, height=3600, params=[4200, 2400, 1800]
    )
    at_once = confidence(keypoints, points, TRUE, CAMERA, 12.0)
    assert abs(confidence(3 * keypoints, points, TRUE, large, 36.0) - at_once) < 0.5


def test_a_focal_length_in_millimetres_is_named():
    keypoints, points = matches(100, 0)
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1600, height=1200, params=[28, 800, 600])
    found = solve(keypoints, points, camera=camera)
    expected = "no lens has its listed focal length of 28 pixels: is it in millimetres?"
    assert found.refusal == expected
