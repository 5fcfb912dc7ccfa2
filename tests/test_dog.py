import cv2
import numpy as np
import pytest
import torch

from hloc_reduce import extract_features
from hloc_reduce.cli import InputError
from hloc_reduce.extractors.dog import DoG, extract_patches


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


def test_extraction_in_original_pixels(tmp_path, textured):
    """A photo that is made twice as large and resized back gives keypoints of the large one."""
    large = cv2.resize(textured, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    cv2.imwrite(str(tmp_path / "small.png"), textured)
    cv2.imwrite(str(tmp_path / "large.png"), large)
    model = DoG({})
    preprocessing = {"grayscale": True, "resize_max": 320}
    small = extract_features.extract(model, tmp_path / "small.png", preprocessing)
    large = extract_features.extract(model, tmp_path / "large.png", preprocessing)
    assert large["image_size"].tolist() == [640, 480] and large["uncertainty"] == 2
    np.testing.assert_allclose(large["keypoints"], small["keypoints"] * 2 + 0.5, atol=1e-3)
    np.testing.assert_allclose(large["scales"], small["scales"] * 2, rtol=1e-5)
