"""Cameras and poses of OpenCV and ROS are the same as those of COLMAP."""

import cv2
import numpy as np
import pycolmap
import pytest

from hloc_reduce.localization.measures import covariance
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.ros import to_camera, to_ros_pose

MATRIX = np.array([[900.0, 0, 650], [0, 910, 355], [0, 0, 1]])
# coefficients, ROS's name, COLMAP's model
LENSES = [
    ([], "plumb_bob", "PINHOLE"),
    ([0.0] * 5, "plumb_bob", "PINHOLE"),
    ([-0.2, 0.05, 1e-3, -2e-3], "plumb_bob", "OPENCV"),
    ([-0.2, 0.05, 1e-3, -2e-3, 0], "plumb_bob", "OPENCV"),
    ([-0.2, 0.05, 1e-3, -2e-3, 0.01], "plumb_bob", "FULL_OPENCV"),
    ([0.1, 0.05, 1e-3, -2e-3, 0.01, 0.3, 0.02, 0.003], "rational_polynomial", "FULL_OPENCV"),
    ([0.1, 0.05, 1e-3, -2e-3, 0.01, 0.3, 0.02, 0.003, *[0] * 6], "plumb_bob", "FULL_OPENCV"),
    ([0.03, -0.01, 0.002, -1e-3], "equidistant", "OPENCV_FISHEYE"),
]


@pytest.mark.parametrize("distortion, name, model", LENSES)
def test_a_camera_projects_as_in_opencv(distortion, name, model):
    """OpenCV's pixels are half a pixel smaller."""
    points = np.random.default_rng(0).uniform([-3, -2, 4], [3, 2, 9], (50, 3))
    still, given = np.zeros(3), np.array(distortion)
    if name == "equidistant":
        expected, _ = cv2.fisheye.projectPoints(points[:, None], still, still, MATRIX, given)
    else:
        expected, _ = cv2.projectPoints(points, still, still, MATRIX, given)
    for matrix, shaped in ((MATRIX, given[None]), (MATRIX.ravel(), distortion)):
        camera = to_camera(matrix, shaped, 1280, 720, name)
        assert (camera.model.name, camera.width, camera.height) == (model, 1280, 720)
        np.testing.assert_allclose(camera.img_from_cam(points) - 0.5, expected[:, 0], atol=1e-8)


@pytest.mark.parametrize(
    "changed, message",
    [
        ({"matrix": np.eye(4)}, r"The camera matrix has 16 numbers, not 9\."),
        ({"matrix": "K"}, "The camera matrix is not an array of numbers"),
        ({"matrix": MATRIX * np.nan}, "The camera matrix has numbers that are not finite"),
        ({"matrix": np.zeros(9)}, "a focal length of 0: the camera is not calibrated"),
        ({"matrix": -MATRIX}, r"The camera matrix is \[\[-900.*, not \[\[fx, 0, cx\]"),
        ({"matrix": MATRIX.T}, r"The camera matrix is \[\[900.*, not \[\[fx, 0, cx\]"),
        ({"matrix": MATRIX + [[0, 1, 0], [0, 0, 0], [0, 0, 0]]}, "not .*fx, 0, cx"),
        ({"matrix": MATRIX * [[-1], [1], [1]]}, "not that of a camera: .* are positive"),
        ({"width": 0}, "The images have 0x720 pixels"),
        ({"height": -1}, "The images have 1280x-1 pixels"),
        ({"distortion": [0.1, 0.2]}, "has 2 numbers: plumb_bob has 0 or 4 or 5 or 8 or 12 or 14 c"),
        (
            {"distortion": [0.1] * 5, "distortion_model": "equidistant"},
            "has 5 numbers: equidistant has 0 or 4 coefficients",
        ),
        ({"distortion": [0] * 8 + [0.1] * 4}, "COLMAP has no camera model with thin prisms"),
        ({"distortion": [0.1, None, 0, 0]}, "The distortion has numbers that are not finite"),
        ({"distortion_model": "double_sphere"}, "Unknown distortion model 'double_sphere'"),
    ],
)
def test_what_is_no_camera(changed, message):
    given = {"matrix": MATRIX, "distortion": [], "width": 1280, "height": 720}
    with pytest.raises(InputError, match=message):
        to_camera(**{**given, **changed})


def moved(motion: np.ndarray) -> pycolmap.Rigid3d:
    """Return the motion of rotation vector (3,) and translation (3,)."""
    angle = np.linalg.norm(motion[:3])
    axis = motion[:3] / angle * np.sin(angle / 2)
    return pycolmap.Rigid3d(pycolmap.Rotation3d([*axis, np.cos(angle / 2)]), motion[3:])


def difference(one: pycolmap.Rigid3d, other: pycolmap.Rigid3d) -> list[float]:
    """Return how two poses of a camera in the world differ, as ROS's covariances have it."""
    turned = (one.rotation * other.rotation.inverse()).quat  # about fixed axes
    return [*(one.translation - other.translation), *(2 * np.sign(turned[3]) * turned[:3])]


def assert_similar(said: np.ndarray, measured: np.ndarray, tolerance: float) -> None:
    """Compare covariances, the second one of which is scaled to correlations."""
    scale = np.sqrt(np.outer(np.diag(measured), np.diag(measured)))
    np.testing.assert_allclose(said / scale, measured / scale, atol=tolerance)


def test_a_covariance_is_that_of_motions_drawn_from_it():
    """Positions and rotations about the world's axes, as ROS defines them, of drawn poses."""
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.5, -0.1, 0.7, 0.5])), [3.0, -2, 8])
    generator = np.random.default_rng(0)
    root = generator.normal(size=(6, 6)) * np.repeat([[2e-4], [3e-3]], 3, axis=0)
    covariance = root @ root.T
    found = to_ros_pose(pose, covariance)
    motions = (root @ generator.standard_normal((6, 20_000))).T
    drawn = [difference((moved(one) * pose).inverse(), pose.inverse()) for one in motions]
    said, measured = found.covariance.reshape(6, 6), np.cov(np.array(drawn).T)
    assert_similar(said, measured, 0.03)
    correlation = said / np.sqrt(np.outer(np.diag(said), np.diag(said)))
    assert np.abs(correlation[:3, 3:]).max() > 0.3  # so that signs matter


def test_a_ros_pose_is_world_from_camera():
    """A camera 2 m north of the origin of an east-north-up frame, which looks east."""
    east, north, up = np.eye(3)
    cam_from_world = np.array([-north, -up, east])  # rows: right, down, forward
    rotation = pycolmap.Rotation3d(cam_from_world)
    pose = pycolmap.Rigid3d(rotation, -cam_from_world @ (2 * north))
    variances = np.array([1.0, 2, 3, 4, 5, 6])  # about and along right, down, forward
    found = to_ros_pose(pose, np.diag(variances))
    np.testing.assert_allclose(found.position, 2 * north, atol=1e-12)
    x, y, z, w = found.orientation
    np.testing.assert_allclose(
        pycolmap.Rotation3d([x, y, z, w]).matrix() @ [0, 0, 1], east, atol=1e-12
    )
    expected = np.diag([6.0, 4, 5, 3, 1, 2])  # along and about east, north, up
    np.testing.assert_allclose(found.covariance.reshape(6, 6), expected, atol=1e-12)


def test_the_covariance_of_a_localized_photo_is_that_of_repeated_estimates():
    """In the world's frame, of a camera that is far from its origin and turned."""
    camera = to_camera(MATRIX, [], 1280, 720)
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.5, -0.1, 0.7, 0.5])), [30.0, -20, 80])
    generator = np.random.default_rng(0)
    keypoints = generator.uniform([0, 0], [1280, 300], (60, 2))
    rays = np.column_stack([camera.cam_from_img(keypoints), np.ones(60)])
    points = pose.inverse() * (rays * generator.uniform(4, 9, (60, 1)))
    estimates, said = [], []
    for _ in range(400):
        noisy = keypoints + generator.normal(0, 1, keypoints.shape)
        given = noisy, points, np.ones(60, bool), camera
        found = pycolmap.refine_absolute_pose(pose, *given, {"loss_function_scale": 1e3})
        one = found["cam_from_world"]
        said.append(to_ros_pose(one, covariance(noisy, points, one, camera)).covariance)
        estimates.append(difference(one.inverse(), pose.inverse()))
    assert_similar(np.mean(said, axis=0).reshape(6, 6), np.cov(np.array(estimates).T), 0.2)
