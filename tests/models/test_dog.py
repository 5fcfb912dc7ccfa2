"""DoG keypoints and the descriptors of patches around them."""

import cv2
import numpy as np
import pytest
import torch
from kornia.feature.laf import extract_patches_from_pyramid, laf_from_center_scale_ori
from scipy.spatial import cKDTree

from hloc_reduce.detectors import dog, opencv
from hloc_reduce.extractors.dog import DoG, extract_patches
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError


def detect(image, **conf):
    with torch.no_grad():
        data = {"image": torch.from_numpy(image.astype(np.float32) / 255)[None, None]}
        return {key: value[0].numpy() for key, value in DoG(conf)(data).items()}


def test_keypoints_lie_at_pixel_centres():
    y, x = np.mgrid[:120, :160]
    image = 255 * (0.2 + 0.6 * np.exp(-((x - 80) ** 2 + (y - 50) ** 2) / (2 * 5**2)))
    features = detect(image)
    assert len(features["keypoints"]) >= 1
    np.testing.assert_allclose(
        features["keypoints"], [[80, 50]] * len(features["scales"]), atol=0.02
    )


def test_features_are_complete(textured):
    features = detect(textured)
    number = len(features["keypoints"])
    assert number > 100
    assert features["descriptors"].shape == (128, number)
    np.testing.assert_allclose(np.linalg.norm(features["descriptors"], axis=0), 1, atol=1e-5)
    for key in ("scales", "oris", "scores"):
        assert features[key].shape == (number,)
    assert (features["scores"] > 0).all()


def test_max_keypoints_keeps_the_best_scores(textured):
    everything, few = detect(textured), detect(textured, max_keypoints=50)
    assert len(few["keypoints"]) == 50
    assert few["scores"].min() >= np.sort(everything["scores"])[-50]


def test_uniform_image_has_no_features():
    features = detect(np.full((64, 64), 128, np.uint8))
    assert features["keypoints"].shape == (0, 2) and features["descriptors"].shape == (128, 0)


def test_unknown_option_is_refused():
    with pytest.raises(InputError, match="no option mr_sise"):
        DoG({"mr_sise": 3})


def test_patch_is_centred_on_its_keypoint_and_scaled():
    ramp = torch.arange(200.0).expand(1, 1, 200, 200) / 200
    patch = extract_patches(ramp, np.array([[100, 60, 2, 0]]))[0, 0] * 200
    assert patch.mean() == pytest.approx(100, abs=1e-3)
    # 32 samples over a side of 12 * scale
    assert (patch[:, -1] - patch[:, 0]).mean() == pytest.approx(24 * 31 / 32, abs=1e-3)


@pytest.mark.parametrize("size", [(240, 320), (201, 175), (70, 64), (40, 33)])
def test_patches_are_kornias(size):
    generator = np.random.default_rng(0)
    image = torch.from_numpy(generator.random((1, 1, *size), np.float32))
    keypoints = np.column_stack(
        [
            generator.uniform(-3, size[1] + 3, 300),
            generator.uniform(-3, size[0] + 3, 300),
            np.exp(generator.uniform(0, 4, 300)),
            generator.uniform(-360, 360, 300),
        ]
    ).astype(np.float32)
    x_y, scale, orientation = torch.from_numpy(keypoints).split([2, 1, 1], 1)
    lafs = laf_from_center_scale_ori(x_y[None], scale[None, ..., None] * 6, -orientation[None])
    expected = extract_patches_from_pyramid(image, lafs, PS=32)[0]
    torch.testing.assert_close(extract_patches(image, keypoints), expected, atol=1e-3, rtol=0)


def test_no_patches():
    patches = extract_patches(torch.zeros(1, 1, 50, 60), np.zeros((0, 4), np.float32))
    assert patches.shape == (0, 1, 32, 32)


@pytest.mark.parametrize("normalization", ["L2", "L1_ROOT"])
def test_colmaps_own_descriptors(textured, normalization):
    """They are of unit norm, and of the keypoints that patches would be cut around."""
    options = {"first_octave": 0, "peak_threshold": 0.01, "normalization": normalization}
    own = detect(textured, descriptor="colmap_sift", options=options)
    patches = detect(textured)
    np.testing.assert_array_equal(own["keypoints"], patches["keypoints"])
    np.testing.assert_allclose(np.linalg.norm(own["descriptors"], axis=0), 1, atol=1e-5)
    few = detect(textured, descriptor="colmap_sift", options=options, max_keypoints=20)
    best = np.argsort(-own["scales"], kind="stable")[:20]
    np.testing.assert_array_equal(few["descriptors"], own["descriptors"][:, best])
    assert detect(np.full((64, 64), 9, np.uint8), descriptor="colmap_sift")["scores"].size == 0


@pytest.mark.parametrize("angle", [30, 90, 200])
def test_descriptors_turn_with_the_image(textured, angle):
    """Keypoints turned by hand into a turned image have the descriptors that they had."""
    scaled = cv2.GaussianBlur(textured, (0, 0), 1.5)
    centre = (159.5, 119.5)
    turn = cv2.getRotationMatrix2D(centre, -angle, 1)  # positive angles of cv2 run from x to -y
    turned = cv2.warpAffine(scaled, turn, (320, 240), flags=cv2.INTER_CUBIC)
    features = detect(scaled)
    inside = np.linalg.norm(features["keypoints"] - centre, axis=1) < 80
    inside &= features["scales"] < 3
    keypoints = np.column_stack([features["keypoints"], features["scales"], features["oris"]])
    moved = keypoints[inside].copy()
    moved[:, :2] = moved[:, :2] @ turn[:, :2].T + turn[:, 2]
    moved[:, 3] += angle
    model = DoG({})
    image = torch.from_numpy(turned.astype(np.float32) / 255)[None, None]
    with torch.no_grad():
        descriptors = model.describe(extract_patches(image, moved)).numpy()
    similarity = (descriptors * features["descriptors"].T[inside]).sum(1)
    assert inside.sum() > 20 and np.median(similarity) > 0.98


def test_settings_follow_the_photo(textured):
    """A photo with enough keypoints keeps hloc's; a dark and a small one get more."""
    photo = np.tile(textured, (3, 4)).astype(np.float32) / 255
    assert max(photo.shape) > dog.SMALL_PHOTO_PIXELS
    keypoints, descriptors = dog.detect(photo, dog.HLOC_OPTIONS, adaptive=True)
    expected = colmap.detect_dog(photo, dog.HLOC_OPTIONS)
    assert len(keypoints) >= dog.ENOUGH_KEYPOINTS
    np.testing.assert_array_equal(keypoints, expected[0])
    np.testing.assert_array_equal(descriptors, expected[1])

    dark = np.round(photo * 0.06 * 255) / 255
    assert len(colmap.detect_dog(dark, dog.HLOC_OPTIONS)[0]) < 10
    found, _ = dog.detect(dark, dog.HLOC_OPTIONS, adaptive=True)
    distance, _ = cKDTree(expected[0][:, :2]).query(found[:, :2])
    assert len(found) >= dog.ENOUGH_KEYPOINTS and (distance < 2).sum() > 0.5 * len(expected[0])

    small = cv2.resize(0.15 * photo, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    few = colmap.detect_dog(small, dog.HLOC_OPTIONS)[0]
    assert len(few) < small.size / dog.PIXELS_PER_KEYPOINT
    assert len(dog.detect(small, dog.HLOC_OPTIONS, adaptive=True)[0]) > 2 * len(few)
    assert len(dog.detect(small, dog.HLOC_OPTIONS)[0]) == len(few)


@pytest.mark.parametrize(
    ("numbers", "searched"),
    [
        ({0.01: 400, 0.005: 3000}, [0.01, 0.005]),
        ({0.01: 20, 0.005: 900, 0.0025: 3000}, [0.01, 0.0025]),  # 0.005 is hopeless
        ({0.01: 400, 0.005: 20, 0.0025: 900, 0.001: 3000}, [0.01, 0.005, 0.001]),
        ({}, [0.01, 0.0025, 0.0033]),  # the last one is always tried
    ],
)
def test_steps_after_a_hopeless_one_are_skipped(monkeypatch, textured, numbers, searched):
    """Where a search finds less than 1 % of 2,500 keypoints, the next step is not tried."""
    tried = []

    def search(image, options):
        tried.append(options["peak_threshold"])
        number = numbers.get(options["peak_threshold"], 0)
        return np.zeros((number, 4), np.float32), np.zeros((number, 128), np.float32)

    monkeypatch.setattr(colmap, "detect_dog", search)
    photo = np.tile(textured, (3, 4)).astype(np.float32) / 255
    found, _ = dog.detect(photo, dog.HLOC_OPTIONS, adaptive=True)
    assert tried == searched
    assert len(found) == max(numbers.get(threshold, 0) for threshold in searched)


@pytest.mark.parametrize("octave", [0, -1])
@pytest.mark.parametrize("size", [(960, 720), (961, 723)])
def test_keypoints_of_opencv_are_those_of_colmap(textured, octave, size):
    """Where both find a keypoint, it has the same place, scale, orientation and descriptor."""
    photo = cv2.resize(textured, size, interpolation=cv2.INTER_CUBIC).astype(np.float32) / 255
    options = {"first_octave": octave, "peak_threshold": 0.0067}
    expected, described = colmap.detect_dog(photo, options)
    keypoints, descriptors = opencv.detect(photo, options)
    assert keypoints.dtype == descriptors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1, atol=1e-5)
    similarity = descriptors @ described.T
    distance = np.linalg.norm(keypoints[:, None, :2] - expected[:, :2], axis=2)
    near = np.where(distance < 2, similarity, 0)
    rows = np.flatnonzero(near.max(axis=1) > 0.95)
    others = expected[near[rows].argmax(axis=1)]
    assert len(rows) > 0.4 * len(expected)
    offset = keypoints[rows, :2] - others[:, :2]
    assert np.abs(np.median(offset, axis=0)).max() < 0.03
    assert np.median(np.linalg.norm(offset, axis=1)) < 0.2
    assert np.median(keypoints[rows, 2] / others[:, 2]) == pytest.approx(1, abs=0.02)
    turn = (keypoints[rows, 3] - others[:, 3] + 180) % 360 - 180
    assert np.abs(np.median(turn)) < 0.5 and np.median(np.abs(turn)) < 3


def test_fast_keypoints_follow_the_photo(textured):
    """They are sought in a dark photo again, at twice the size in a small one; a blank has none."""
    photo = np.tile(textured, (3, 4)).astype(np.float32) / 255
    dark = np.round(photo * 0.06 * 255) / 255
    once = opencv.detect(dark, dog.SETTINGS["fast"][0])[0]
    fast = DoG({"keypoints": "fast", "descriptor": "colmap_sift"})
    assert len(fast.detect(dark)[0]) > 2 * len(once)
    small = np.round(textured * 0.15).astype(np.float32) / 255
    few = opencv.detect(small, dog.SETTINGS["fast"][0])[0]
    assert len(few) < small.size / dog.PIXELS_PER_KEYPOINT
    assert len(fast.detect(small)[0]) > 2 * len(few)
    for size in ((1, 1), (1, 9), (40, 30)):
        keypoints, descriptors = fast.detect(np.full(size, 0.5, np.float32))
        assert keypoints.shape == (0, 4) and descriptors.shape == (0, 128)


@pytest.mark.parametrize("noise", [0, 0.003, 0.02, 0.1])
@pytest.mark.parametrize("size", [(480, 640), (1024, 1536)])
def test_noise_does_not_become_keypoints(noise, size):
    """A covered lens gives no more keypoints than with hloc's settings."""
    view = 0.05 + noise * np.random.default_rng(0).standard_normal(size)
    view = (np.round(view.clip(0, 1) * 255) / 255).astype(np.float32)
    assert dog.is_noise(view)
    found = dog.detect(view, dog.HLOC_OPTIONS, adaptive=True)
    assert len(found[0]) == len(colmap.detect_dog(view, dog.HLOC_OPTIONS)[0])


def test_a_very_dark_photo_is_not_noise(textured):
    generator = np.random.default_rng(0)
    view = np.tile(textured, (3, 4)) / 255 * 0.06
    view = view + 0.01 * generator.standard_normal(view.shape)
    assert not dog.is_noise((np.round(view.clip(0, 1) * 255) / 255).astype(np.float32))


def test_options_of_ones_own_are_used_as_they_are(textured):
    image = torch.from_numpy(textured.astype(np.float32) / 255)[None, None]
    options = {"first_octave": 0, "peak_threshold": 0.02}
    found = DoG({"options": options})({"image": image})["keypoints"][0].numpy()
    expected, _ = colmap.detect_dog(image[0, 0].numpy(), options)
    np.testing.assert_array_equal(found, expected[:, :2])
    hloc = DoG({"keypoints": "hloc"})({"image": image})["keypoints"][0].numpy()
    np.testing.assert_array_equal(
        hloc, colmap.detect_dog(image[0, 0].numpy(), dog.HLOC_OPTIONS)[0][:, :2]
    )
    colmaps = DoG({"keypoints": "colmap"})({"image": image})["keypoints"][0].numpy()
    np.testing.assert_array_equal(
        colmaps, colmap.detect_dog(image[0, 0].numpy(), dog.COLMAP_OPTIONS)[0][:, :2]
    )
    with pytest.raises(
        InputError, match="Unknown keypoints 'many'. There are: colmap, fast, adaptive, hloc"
    ):
        DoG({"keypoints": "many"})
