"""Photos that are localized near a guessed pose, on synthetic points and on a small map."""

import copy

import numpy as np
import pycolmap
import pytest

from hloc_reduce import Localizer, compact
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.localization.near import TURNED, Guess, Surroundings
from hloc_reduce.utils.cli import InputError

CAMERA = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500, 500, 320, 240])


def moved(pose, degrees=(0, 0, 0), shift=(0, 0, 0)):
    """Return the pose of a camera that was turned and shifted in its own frame."""
    turn = pycolmap.Rotation3d(np.deg2rad(np.array(degrees, float)))
    return pycolmap.Rigid3d(turn, np.array(shift, float)) * pose


def test_matches_that_fit_a_guess():
    """Points 5 units away may be off by the radius, and by what a turn of 10 degrees moves them."""
    points3D = np.array([[0, 0, 5], [1, 0, 5], [0, -1, 5], [0, 0, -5]], float)
    seen = np.array([[320, 240], [420, 240], [320, 140], [320, 240]], float)
    still = Guess(pycolmap.Rigid3d(), 1e-6, [])
    assert still.fits(seen, points3D, CAMERA).tolist() == [True, True, True, False]
    allowed = 500 * np.tan(np.deg2rad(TURNED))
    for pixels, expected in ((0.9 * allowed, True), (1.1 * allowed, False)):
        assert still.fits(seen[:1] + [pixels, 0], points3D[:1], CAMERA).tolist() == [expected]
    # seen 16 degrees off, of which a radius of a tenth of the distance explains 5.6
    for radius, expected in ((0.5, False), (1.5, True)):
        guess = Guess(pycolmap.Rigid3d(), radius, [])
        assert guess.fits(seen[1:2] + [1.8 * allowed, 0], points3D[1:2], CAMERA).tolist() == [
            expected
        ]
    assert still.fits(np.zeros((0, 2)), np.zeros((0, 3)), CAMERA).shape == (0,)


class Room:
    """A map of images in a row, of which each sees ten points in front of it."""

    def __init__(self, number):
        self.poses = {
            f"{i}.png": pycolmap.Rigid3d(pycolmap.Rotation3d(), [-2.0 * i, 0, 0])
            for i in range(number)
        }
        self.poses["back.png"] = moved(self.poses["0.png"], (0, 180, 0))

    def num_keypoints(self, name):
        return 10

    def lift(self, name, keypoints):
        local = np.stack([np.linspace(-1, 1, 10), np.zeros(10), np.full(10, 4.0)], axis=1)
        return np.arange(10), self.poses[name].inverse() * local

    def views(self):
        poses = [pose.inverse() for pose in self.poses.values()]
        axes = [pose.rotation.matrix()[:, 2] for pose in poses]
        return np.array([pose.translation for pose in poses]), np.array(axes)


def test_images_that_see_the_same_come_first():
    room = Room(30)
    surroundings = Surroundings(room, [*room.poses], room.views)
    guess = surroundings.guess(room.poses["7.png"], None, CAMERA)
    assert guess.images[0] == "7.png" and set(guess.images[1:3]) == {"6.png", "8.png"}
    assert "back.png" not in guess.images
    assert guess.radius == pytest.approx(0.2 * np.sqrt(17), rel=0.1)
    back = surroundings.guess(room.poses["back.png"], 0.5, CAMERA)
    assert (back.images, back.radius) == (["back.png"], 0.5)
    nothing = surroundings.guess(moved(room.poses["7.png"], (90, 0, 0)), None, CAMERA)
    assert nothing.images == []


def test_a_guess_of_another_frame():
    room = Room(5)
    surroundings = Surroundings(room, [*room.poses], room.views)
    far = moved(room.poses["0.png"], shift=(1e3, 0, 0))
    assert surroundings.is_far(far) and not surroundings.is_far(room.poses["0.png"])
    with pytest.raises(InputError, match="is it of another frame, or world from camera"):
        surroundings.check(far)
    first = [part[:1] for part in room.views()]
    alone = Surroundings(room, ["0.png"], lambda: first)  # whose positions have no extent
    assert not alone.is_far(room.poses["0.png"])
    for radius in (0, -1, np.nan, np.inf):
        with pytest.raises(InputError, match=r"radius is .*: a distance above 0"):
            surroundings.guess(room.poses["0.png"], radius, CAMERA)


@pytest.fixture(params=[False, True], ids=["folder", "compact"])
def seen(request, build_map, plane, place, tmp_path):
    """A map in memory, a photo of it, its camera and its true pose."""
    path, (_, images, _) = build_map(), place
    if request.param:
        compact.main(tmp_path / "map.hlm", path)
        path = tmp_path / "map.hlm"
    model = pycolmap.Reconstruction(plane / "model")
    [image] = [image for image in model.images.values() if image.name == "4.png"]
    camera, true = copy.deepcopy(image.camera), image.cam_from_world()
    return Localizer(path), images / "query/day/a.png", camera, true, images


def test_a_guess_changes_no_pose(seen):
    localizer, photo, camera, true, _ = seen
    pose, info = localizer.localize(photo, camera)
    assert not info["near"]
    about = moved(true, (4, -3, 2), (0.1, 0.05, -0.1))
    near, its = localizer.localize(photo, camera, near=about)
    assert its["near"] and its["reason"] is None and len(its["retrieved"]) <= 8
    assert max(pose_error(near, pose)) < 0.02
    assert its["num_inliers"] > 0.9 * info["num_inliers"]


def test_a_wrong_guess_costs_no_photo(seen):
    """The camera looks the other way, or was carried away: it is localized as without a guess."""
    localizer, photo, camera, true, _ = seen
    pose, info = localizer.localize(photo, camera)
    for wrong in (moved(true, (0, 180, 0)), moved(true, (0, 0, 40)), moved(true, shift=(2, 1, 0))):
        near, its = localizer.localize(photo, camera, near=wrong, radius=0.01)
        assert max(pose_error(near, pose)) < 0.02, its["near"]


def test_a_photo_that_does_not_belong_is_refused_near_any_pose(seen):
    localizer, _, camera, true, images = seen
    noise = np.random.default_rng(0).integers(0, 255, (camera.height, camera.width), np.uint8)
    pose, info = localizer.localize(noise, camera, near=true)
    assert pose is None and info["reason"]


def test_frames_are_tracked(seen):
    localizer, photo, camera, true, _ = seen
    tracker, blank = localizer.track(camera), np.zeros((camera.height, camera.width), np.uint8)
    used = []
    for frame in (photo, photo, blank, photo, photo):
        pose, info = tracker.localize(frame)
        assert (pose is None) == (frame is blank)
        assert pose is None or max(pose_error(pose, true)) < 0.05
        used.append(pose is not None and info["near"])
    assert used == [False, True, False, True, True]


DOUBLE = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, 0, 0, 2.0])), np.zeros(3))


@pytest.mark.parametrize("near", [np.eye(4), 7, "pose", DOUBLE])
def test_what_is_no_pose(near, seen):
    localizer, photo, camera, *_ = seen
    with pytest.raises(InputError, match="near is a pose, camera from world"):
        localizer.localize(photo, camera, near=near)
