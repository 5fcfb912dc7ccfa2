"""Photos whose intrinsics are not what they seem: distorted, cropped, stretched, wrongly listed."""

import cv2
import numpy as np
import pycolmap
import pytest

from hloc_reduce.localization import absolute_pose, gate, hypotheses, resection
from hloc_reduce.localization.gate import DEFAULT_GATE
from hloc_reduce.localization.intrinsics import REFINEMENTS
from hloc_reduce.localization.measures import INDEPENDENT, uncertainty
from hloc_reduce.localization.pose import Matches, Pose
from hloc_reduce.localization.projection import project, reprojection_errors
from hloc_reduce.localization.resection import (
    ALL,
    RADIAL,
    SKEW,
    linear,
    resect,
    resect_anew,
    undistort,
)

TURN = pycolmap.Rotation3d(np.array([0.1, 0.2, 0.04]))  # axis and angle
POSE = pycolmap.Rigid3d(TURN, [0.3, 0.1, 8.0])
GATE = DEFAULT_GATE.of_matches({"ratio_threshold": 0.8}, 64)


def camera_of(width: int, height: int, params: list[float], model: str) -> pycolmap.Camera:
    return pycolmap.Camera(model=model, width=width, height=height, params=params)


def guessed(width: int, height: int) -> pycolmap.Camera:
    params = [1.2 * max(width, height), width / 2, height / 2, 0]
    return camera_of(width, height, params, "SIMPLE_RADIAL")


# a camera of 1600 x 1200 pixels, and what becomes of its photos
WHOLE = camera_of(1600, 1200, [1400, 800, 600, 0], "SIMPLE_RADIAL")
PHOTOS = {
    "whole": WHOLE,
    "distorted": camera_of(1600, 1200, [1400, 800, 600, -0.2], "SIMPLE_RADIAL"),
    "left two thirds": camera_of(1066, 1200, [1400, 1400, 800, 600], "PINHOLE"),
    "corner": camera_of(1100, 800, [1400, 1400, 300, 200], "PINHOLE"),
    "squeezed": camera_of(1600, 720, [1400, 840, 800, 360], "PINHOLE"),
}


def matches(
    camera: pycolmap.Camera, number: int, depth: float = 3, noise: float = 1.0, wrong: int = 20
) -> tuple[np.ndarray, np.ndarray]:
    """Return image points inside a photo and their world points, the last of them wrong."""
    generator = np.random.default_rng(0)
    points = generator.uniform([-5, -4, -depth], [5, 4, depth], (20 * number, 3))
    _, projected = reprojection_errors(np.zeros((len(points), 2)), points, POSE, camera)
    inside = ((projected > 0) & (projected < [camera.width, camera.height])).all(axis=1)
    chosen = np.flatnonzero(inside)[: number + wrong]
    image = projected[chosen] + noise * generator.standard_normal((number + wrong, 2))
    image[number:] = generator.uniform(0, [camera.width, camera.height], (wrong, 2))
    return image, points[chosen]


def solve(points2D: np.ndarray, points3D: np.ndarray, camera, source: str) -> Pose:
    images = [np.arange(len(points2D))]
    return absolute_pose.estimate(points2D, points3D, images, camera, REFINEMENTS[source], GATE)


def error(pose: Pose) -> tuple[float, float]:
    """Return how far off a pose is, in units of the distance of 8, and in degrees."""
    moved = pose.cam_from_world * POSE.inverse()
    return np.linalg.norm(moved.translation) / 8, np.degrees(moved.rotation.angle())


@pytest.mark.parametrize("source", ["guess", "EXIF"])
@pytest.mark.parametrize("photo", PHOTOS)
def test_photos_are_localized_though_cropped_or_stretched(photo, source):
    """Off-centre crops were called localized, 5 to 20 degrees off."""
    camera = PHOTOS[photo]
    assumed = guessed(camera.width, camera.height)
    found = solve(*matches(camera, 300), assumed, source)
    assert found.refusal is None
    position, rotation = error(found)
    assert position < 0.02 and rotation < 0.5
    freedom = {"whole": (7, RADIAL), "distorted": (RADIAL,)}.get(photo, (ALL,))
    assert found.degrees_of_freedom in freedom
    if found.degrees_of_freedom == ALL:
        expected = camera.calibration_matrix()
        assert np.abs(found.camera.calibration_matrix() - expected).max() < 0.05 * expected[0, 0]


@pytest.mark.parametrize("photo", ["whole", "left two thirds", "corner", "squeezed"])
def test_a_projection_is_found_without_a_start(photo):
    """Though every fourth match is wrong."""
    camera = PHOTOS[photo]
    points2D, points3D = matches(camera, 300, wrong=100)
    pose, found = linear(points2D, points3D, camera, 12.0)
    expected = camera.calibration_matrix()
    assert np.abs(found.calibration_matrix() - expected).max() < 0.05 * expected[0, 0]
    moved = pose * POSE.inverse()
    assert np.linalg.norm(moved.translation) < 0.4 and np.degrees(moved.rotation.angle()) < 1
    assert linear(points2D[:11], points3D[:11], camera, 12.0) is None
    flat, _ = matches(WHOLE, 300, depth=0)
    linear(flat, np.zeros((len(flat), 3)), WHOLE, 12.0)  # whatever it finds


@pytest.mark.parametrize("wrong", [100, 200, 300])
def test_wrong_matches_near_a_wrong_start_do_not_keep_it(wrong):
    """They are nearer to it than the right ones; squeezed photos were localized 17 degrees off."""
    camera = PHOTOS["squeezed"]
    points2D, points3D = matches(camera, 300, depth=1, wrong=wrong)
    right = points2D[:300], points3D[:300]
    one_focal_length = guessed(camera.width, camera.height)
    its_matches = Matches(*right, one_focal_length, REFINEMENTS["guess"])
    start = absolute_pose._estimate(its_matches, np.arange(300))
    assert start.num_inliers < 50 and error(start)[1] > 20
    pinhole = camera_of(1600, 720, start.camera.params[[0, 0, 1, 2]], "PINHOLE")
    _, near = reprojection_errors(points2D, points3D, start.cam_from_world, pinhole)
    offsets = np.random.default_rng(1).uniform(-40, 40, (wrong, 2))
    points2D[300:] = near[300:] + offsets
    found = resect_anew(points2D, points3D, start.cam_from_world, pinhole, 12.0)
    assert found.inliers[:300].all()
    assert np.degrees((found.cam_from_world * POSE.inverse()).rotation.angle()) < 0.5


@pytest.mark.parametrize(("photo", "searches"), [("whole", 1), ("squeezed", 2)])
def test_a_search_that_gains_nothing_is_the_last_one(photo, searches, monkeypatch):
    camera, calls, search = PHOTOS[photo], [], resection._search
    points2D, points3D = matches(camera, 300)
    start = camera_of(camera.width, camera.height, [1400, 1400, 800, camera.height / 2], "PINHOLE")
    monkeypatch.setattr(resection, "_search", lambda *given: calls.append(1) or search(*given))
    found = resect_anew(points2D, points3D, POSE, start, 12.0)
    assert found.inliers[:300].all() and len(calls) == searches


@pytest.mark.parametrize("photo", ["left two thirds", "corner", "squeezed"])
@pytest.mark.parametrize("number", [15, 40, 300])
def test_few_matches_of_a_cropped_photo_are_refused_or_right(photo, number):
    camera = PHOTOS[photo]
    found = solve(*matches(camera, number, wrong=5), guessed(camera.width, camera.height), "guess")
    if found.refusal is None:
        position, rotation = error(found)
        assert position < 0.05 and rotation < 2


@pytest.mark.parametrize(
    ("kind", "confidence", "is_trusted"),
    [
        ("stretched", 99, True),
        ("stretched", 103, False),
        ("cropped", 103, False),
        ("cropped", 90, False),  # 14 of 441 crops, 4 to 8 degrees off
        ("cropped", 75, True),
    ],
)
def test_an_equal_fit_turns_a_photo_that_may_be_cropped(kind, confidence, is_trusted):
    """7 of 98 accepted crops were turned by 5 to 16 degrees: the right pose had fitted better."""
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, 0.1, 0])), np.zeros(3))
    inliers, points3D = np.ones(50, bool), matches(WHOLE, 50, wrong=0)[1]
    assumed = Pose(turn * POSE, guessed(1600, 1200), inliers, confidence=100, degrees_of_freedom=7)
    right = Pose(POSE, WHOLE, inliers, confidence=confidence, degrees_of_freedom=ALL)
    other = hypotheses.alternative(assumed, right, points3D)
    assert gate.is_doubtful(kind, other) == (not is_trusted)


@pytest.mark.parametrize(
    "focal_length, photo, expected",
    [
        (1400, {}, False),
        (1400, {"cropped": True}, True),
        (1400, {"focal_lengths": [1200, 1350]}, False),
        (1400, {"focal_lengths": [1200, 1300]}, True),  # 1.08: one of 9 was wrong, 9 % off
        (1400, {"focal_lengths": [900, 1100]}, True),  # cropped and enlarged: 3 of 16 were wrong
        (1400, {"focal_lengths": [1700, 1900]}, True),
        (1400, {"focal_lengths": [900, 1900]}, False),
    ],
)
def test_other_focal_lengths_than_those_of_the_map_may_be_of_crops(focal_length, photo, expected):
    camera = camera_of(1600, 1200, [focal_length, 800, 600, 0], "SIMPLE_RADIAL")
    its_matches = Matches(*matches(WHOLE, 20), camera, {"photo": photo})
    assert its_matches.may_be_cropped(Pose(POSE, camera, np.ones(20, bool))) == expected


def test_the_principal_point_of_a_flat_scene_is_not_made_up():
    """A plane does not tell it, so it stays in the middle."""
    found = solve(*matches(WHOLE, 300, depth=0.05), guessed(1600, 1200), "guess")
    assert found.degrees_of_freedom < ALL
    assert found.camera.principal_point_x == 800 and found.camera.principal_point_y == 600


WRONG = {
    "focal length": [1800, 800, 600, 0],
    "distortion": [1400, 800, 600, 0.4],
    "principal point": [1400, 1000, 500, 0],
    "both": [1150, 800, 600, 0.2],
}


@pytest.mark.parametrize("params", WRONG.values(), ids=WRONG)
def test_intrinsics_that_contradict_the_map_are_refused(params):
    """Lists with a wrong focal length put cameras 15 % nearer or farther, called localized."""
    found = solve(*matches(WHOLE, 300), camera_of(1600, 1200, params, "SIMPLE_RADIAL"), "list")
    position, rotation = error(found)
    assert found.refusal is not None or (position < 0.05 and rotation < 1)
    assert solve(*matches(WHOLE, 300), WHOLE, "list").refusal is None


def test_a_listed_focal_length_that_moves_the_camera_is_refused():
    """In a flat scene no other intrinsics fit by 10 % better."""
    given = matches(WHOLE, 400, depth=1.2, noise=3, wrong=0)
    listed = camera_of(1600, 1200, [1.1 * 1400, 800, 600, 0], "SIMPLE_RADIAL")
    found = solve(*given, listed, "list")
    assert "a focal length of 1" in found.refusal
    assert solve(*given, WHOLE, "list").refusal is None


@pytest.mark.parametrize(
    ("model", "params", "expected"),
    [
        ("SIMPLE_PINHOLE", [900, 800, 600], True),
        ("PINHOLE", [900, 900, 800, 600], True),
        ("PINHOLE", [900, 910, 800, 600], False),
        ("PINHOLE", [900, 900, 810, 600], False),
        ("OPENCV", [900, 900, 800, 600, 0.1, 0, 0, 0], False),
        ("OPENCV_FISHEYE", [900, 900, 800, 600, 0, 0, 0, 0], False),
    ],
)
def test_which_intrinsics_centring_leaves_as_they_are(model, params, expected):
    camera = pycolmap.Camera(model=model, width=1600, height=1200, params=params)
    assert resection.is_plain(camera) == expected
    points = np.random.default_rng(0).uniform(0, 1000, (9, 2))
    moved = np.abs(resection.undistort(points, camera)[0] - points).max() > 1e-6
    _, pinhole = resection.centred(pycolmap.Rigid3d(), camera)
    changed = moved or not np.array_equal(pinhole.calibration_matrix(), camera.calibration_matrix())
    assert changed != expected


def test_a_centred_principal_point_of_a_cropped_photo_is_refused():
    """Half of such lists were accepted, and the camera turned by 4 to 8 degrees."""
    right = camera_of(1600, 1000, [1400, 1400, 800, 400], "PINHOLE")  # the upper sixth is cut off
    listed = camera_of(1600, 1000, [1400, 1400, 800, 500], "PINHOLE")
    given = matches(right, 300)
    assert "its intrinsics contradict the map" in solve(*given, listed, "list").refusal
    assert solve(*given, right, "list").refusal is None


def test_given_intrinsics_stay_as_they_are():
    """Errors of up to 5 % of listed focal lengths are no contradiction."""
    lens = [1400, 1400, 800, 600, -0.2, 0.03, 0.001, 0]
    camera = camera_of(1600, 1200, lens, "OPENCV")
    for factor in (1, 0.95, 1.05):
        listed = camera_of(1600, 1200, [factor * 1400, factor * 1400, *lens[2:]], "OPENCV")
        found = solve(*matches(camera, 300), listed, "list")
        assert found.refusal is None and found.degrees_of_freedom == 6
        assert found.camera.params.tolist() == listed.params.tolist()


def test_a_negative_focal_length_is_not_refined():
    """RANSAC may return one; the gate refuses it."""
    camera = camera_of(1600, 1200, [-1400, 800, 600, 0], "SIMPLE_RADIAL")
    pose = Pose(POSE, camera, np.ones(50, bool), confidence=50)
    given = Matches(*matches(WHOLE, 30), camera, REFINEMENTS["guess"])
    assert hypotheses.with_other_intrinsics(given, pose) == (pose, {})


def test_derivatives_of_a_projection():
    local = np.array([[0.3, -0.2, 1.5], [-1, 0.5, 2], [0, 0, 1]])

    def projected(step: np.ndarray) -> np.ndarray:
        turn = pycolmap.Rotation3d(step[:3]).matrix()
        (u, v), _ = project(local @ turn.T + step[3:6], 0.2 + step[7])
        fx, fy = np.exp(step[6]), np.exp(step[6] + step[8])
        return np.array([fx * (u + step[11] * v) + step[9], fy * v + step[10]])

    _, derivatives = project(local, 0.2)
    steps = 1e-6 * np.eye(SKEW)
    measured = [(projected(step) - projected(-step)) / 2e-6 for step in steps]
    np.testing.assert_allclose(derivatives, np.stack(measured, axis=1), atol=1e-8)


def test_a_pose_of_all_parameters_is_as_precise_as_measured():
    camera = PHOTOS["corner"]
    start, centres = guessed(1100, 800), []
    for seed in range(30):
        points2D, points3D = matches(camera, 200, noise=0, wrong=0)
        points2D += 2 * np.random.default_rng(seed).standard_normal(points2D.shape)
        # the right one first, so that all are of the same inliers
        pose, lens, inliers, same = resect(points2D, points3D, POSE, camera, 12.0, ALL)
        centres.append(pose.inverse().translation)
        assert inliers.all() and lens.width == start.width and same is points2D
    measured = np.sqrt(np.var(centres, axis=0).sum()) / 8
    expected, *_ = uncertainty(points2D, points3D, pose, lens, ALL)
    expected /= np.sqrt(len(points2D) / INDEPENDENT)  # here the errors of all are independent
    assert 0.6 < expected / measured < 1.6
    assert resect(points2D[:9], points3D[:9], POSE, camera, 12.0, ALL) is None


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("points", ["equal", "behind", "on a line", "far off"])
def test_points_that_fix_nothing_are_survived(points):
    points2D, points3D = matches(WHOLE, 40, wrong=0)
    centre = POSE.inverse().translation
    if points == "far off":
        points2D = 1e5 * points2D
    else:
        share = np.linspace(0, 1, 40)[:, None]
        towards = {"equal": 0 * share, "on a line": share, "behind": -2 + 0 * share}[points]
        points3D = points3D[0] + towards * (points3D[0] - centre)
    pinhole = guessed(1600, 1200)
    pinhole = camera_of(1600, 1200, [*pinhole.params[[0, 0, 1, 2]]], "PINHOLE")
    for freedom in (RADIAL, ALL, SKEW):
        found = resect(points2D, points3D, POSE, pinhole, 12.0, freedom, np.ones(40, bool))
        assert found is None or np.isfinite(found.camera.params).all()


def homography(camera: pycolmap.Camera, amount: float) -> np.ndarray:
    """Return what moves the corners of a photo unevenly, as when a print is photographed aslant."""
    width, height = camera.width, camera.height
    corners = np.float32([[0, 0], [width, 0], [width, height], [0, height]])
    moved = corners + amount * np.float32(
        [[width, height / 2], [0, 0], [-width / 3, 0], [width / 5, -height]]
    )
    return cv2.getPerspectiveTransform(corners, moved.astype(np.float32))


@pytest.mark.parametrize(("source", "amount"), [("guess", 0.06), ("list", 0.03)])
def test_photos_of_pictures_are_refused(source, amount):
    """They were called localized, at 15 to 67 % of the distance from where they were taken."""
    image, points3D = matches(WHOLE, 300, depth=0.5)
    warped = cv2.perspectiveTransform(image[None], homography(WHOLE, amount))[0]
    camera = guessed(1600, 1200) if source == "guess" else WHOLE
    reason = "photo of a picture" if source == "guess" else "its intrinsics contradict the map"
    assert reason in solve(warped, points3D, camera, source).refusal
    assert solve(image, points3D, camera, source).refusal is None


def test_a_skew_is_undone():
    image, points3D = matches(WHOLE, 300, noise=0)
    sheared = image + 0.2 * np.stack([image[:, 1] - 600, np.zeros(len(image))], axis=1)
    _, pinhole = undistort(image, WHOLE)
    found = resect(sheared, points3D, POSE, pinhole, 12.0, SKEW, np.arange(320) < 300)
    assert found.inliers[:300].all() and np.abs(found.points2D - image)[:300].max() < 0.5
    position, rotation = error(Pose(found.cam_from_world, found.camera, found.inliers))
    assert position < 1e-3 and rotation < 0.01


def test_undistorted_points_are_those_of_a_pinhole():
    camera = PHOTOS["distorted"]
    points2D, points3D = matches(camera, 50, noise=0, wrong=0)
    image, pinhole = undistort(points2D, camera)
    errors, _ = reprojection_errors(image, points3D, POSE, pinhole)
    assert errors.max() < 1e-3
    beyond = camera_of(1600, 1200, [300, 800, 600, -5.0], "SIMPLE_RADIAL")  # undoes only the middle
    image, _ = undistort(points2D, beyond)
    assert np.isfinite(image).all() and np.abs(image).max() == 1e6
