"""Photos that networks see as their EXIF data turn them."""

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from hloc_reduce.utils.feature_files import upright
from hloc_reduce.utils.images import ORIENTATION, TURNS, Frame, in_original, resized, turned

UPRIGHT = {"grayscale": True, "resize_max": 1600, "upright": True}


def save(path, pixels, orientation):
    """Write a photo as it is, with an EXIF orientation."""
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    Image.fromarray(pixels).save(path, exif=exif)
    return path


@pytest.fixture
def pixels():
    """A photo of 40 x 30 pixels, all of them different."""
    return np.random.default_rng(0).permutation(1200).reshape(30, 40).astype(np.uint8)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_photo_is_shown_as_pillow_turns_it_but_not_mirrored(orientation, pixels, tmp_path):
    path = save(tmp_path / "a.png", pixels, orientation)
    with Image.open(path) as opened:
        expected = np.array(ImageOps.exif_transpose(opened))
    expected = expected[:, ::-1] if orientation in (2, 4, 5, 7) else expected
    shown, frame = resized(path, UPRIGHT)
    np.testing.assert_allclose(shown * 255, expected, atol=1e-3)
    assert frame.size.tolist() == [40, 30]
    assert frame.shown.tolist() == [*expected.shape[::-1]]
    mirrored, _ = resized(path, {**UPRIGHT, "mirrored": True})
    np.testing.assert_allclose(mirrored, shown[:, ::-1])
    as_stored, frame = resized(path, {**UPRIGHT, "upright": False})
    assert frame.turns == 0
    np.testing.assert_allclose(as_stored * 255, pixels, atol=1e-3)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_keypoints_come_back_in_stored_pixels(orientation, mirrored, pixels, tmp_path):
    """The pixel that a keypoint of the shown photo is at is the same one in the stored photo."""
    preprocessing = {**UPRIGHT, "mirrored": mirrored}
    shown, frame = resized(save(tmp_path / "a.png", pixels, orientation), preprocessing)
    y, x = np.nonzero(shown > 0.5)
    keypoints = np.stack([x, y], axis=1).astype(np.float32)
    oris = np.zeros(len(x), np.float32)
    found = in_original({"keypoints": keypoints, "oris": oris}, shown.shape, frame, 1.0)
    stored = pixels[:, ::-1] if mirrored else pixels
    x, y = found["keypoints"].astype(int).T
    np.testing.assert_allclose(stored[y, x] / 255, shown[shown > 0.5], atol=1e-6)
    assert found["keypoints"].dtype == np.float32
    assert found["image_size"].tolist() == [40, 30]
    # to the right of the shown photo
    right = in_original(
        {"keypoints": np.array([[3, 4], [4, 4]], np.float32)}, shown.shape, frame, 1
    )
    x, y = np.diff(right["keypoints"], axis=0)[0]
    assert np.rad2deg(np.arctan2(y, x)) % 360 == found["oris"][0]
    again = upright(found, found["turns"])
    np.testing.assert_allclose(again["keypoints"], keypoints)
    assert again["image_size"].tolist() == [*shown.shape[::-1]]


def test_of_a_resized_photo(tmp_path):
    """A bright square of a photo that is stored turned is where the shown one says."""
    pixels = np.zeros((300, 400), np.uint8)
    pixels[20:60, 300:360] = 255  # its centre is at (329.5, 39.5)
    path = save(tmp_path / "a.png", pixels, 6)
    shown, frame = resized(path, {**UPRIGHT, "resize_max": 100})
    assert shown.shape == (100, 75)
    moments = cv2.moments(shown)
    centre = np.array([[moments["m10"], moments["m01"]]]) / moments["m00"]
    found = in_original({"keypoints": centre.astype(np.float32)}, shown.shape, frame, 1.0)
    np.testing.assert_allclose(found["keypoints"], [[329.5, 39.5]], atol=0.1)


def test_turns_of_keypoints():
    corners = np.array([[0, 0], [3, 0]], np.float32)  # of the upper edge of a photo of 4 x 3
    size = np.array([4, 3])
    assert turned(corners, size, 1).tolist() == [[0, 3], [0, 0]]  # its left edge
    assert turned(corners, size, 2).tolist() == [[3, 2], [0, 2]]
    assert turned(corners, size, 3).tolist() == [[2, 0], [2, 3]]
    assert turned(corners, size, 4).tolist() == corners.tolist()
    for turns in TURNS.values():
        there = turned(corners, size, turns)
        assert turned(there, Frame(size, turns).shown, -turns).tolist() == corners.tolist()


@pytest.mark.parametrize("mirrored", [False, True])
def test_further_turns_add_to_those_of_exif_data(mirrored, pixels, tmp_path):
    path = save(tmp_path / "a.png", pixels, 6)
    preprocessing = {**UPRIGHT, "mirrored": mirrored}
    shown, frame = resized(path, preprocessing)
    for turns in (1, 2, 3):
        other, its_frame = resized(path, {**preprocessing, "turns": turns})
        number = -turns if mirrored else turns
        np.testing.assert_allclose(other, np.rot90(shown, number))
        assert its_frame.turns == (frame.turns + number) % 4


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        ({}, 40),
        ({"resize_min": 30}, 40),
        ({"resize_min": 80}, 80),
        ({"resize_min": 80, "resize_max": 60}, 60),
        ({"resize_max": 20}, 20),
        ({"resize_max": None}, 40),
        ({"resize_max": 60, "resize_force": True}, 60),
    ],
)
def test_the_longer_side_of_a_photo(limits, expected, pixels):
    shown, frame = resized(pixels, {**UPRIGHT, **limits})
    assert shown.shape == (0.75 * expected, expected)
    assert frame.size.tolist() == [40, 30]
