"""Masks of photos: which pixels they keep, and which keypoints."""

import cv2
import h5py
import numpy as np
import pytest
import torch
from command import write
from test_upright import UPRIGHT, save

from hloc_reduce import extract_features, extractors
from hloc_reduce.confs import features as features_confs
from hloc_reduce.detectors import dog
from hloc_reduce.maps.numpy_engine import NumpyEngine
from hloc_reduce.maps.numpy_features import ColmapSift
from hloc_reduce.networks.keypoints import strongest
from hloc_reduce.utils import masks
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.images import Frame, in_original, resized

FEATURES = ("colmap_sift_sv64", "sift_sv64", "mini32")


@pytest.fixture
def half() -> np.ndarray:
    """A mask of `textured`, (240, 320) bool, with a slanted border."""
    y, x = np.mgrid[:240, :320]
    return y + x // 4 < 140


@pytest.fixture
def folder(tmp_path, textured, half):
    """Two photos, one of them in a folder, of which the second has a mask."""
    photos, folder = tmp_path / "photos", tmp_path / "masks"
    for name in ("a.png", "in/b.png"):
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(photos / name), textured)
    (folder / "in").mkdir(parents=True)
    cv2.imwrite(str(folder / "in/b.png.png"), half.astype(np.uint8))  # 1 is kept, too
    return photos, folder


def inside(mask: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    """Tell which keypoints are in pixels that a mask keeps."""
    x, y = np.floor(keypoints + 0.5).astype(int).T
    return mask[y.clip(0, len(mask) - 1), x.clip(0, mask.shape[1] - 1)]


@pytest.mark.parametrize("feature", FEATURES)
@pytest.mark.parametrize(
    "how", [{}, {"resize_max": 200}, {"resize_min": 500}, {"turns": 1}, {"mirrored": True}]
)
def test_exactly_the_keypoints_in_black_pixels_are_dropped(feature, how, textured, half):
    """However the photo is shown; where no number of keypoints is chosen."""
    conf = features_confs.confs[feature]
    unlimited = {"max_keypoints": -1} | ({} if feature == "mini32" else {"keypoints": "hloc"})
    model = {**conf["model"], "base": {**features_confs.base_of(conf["model"]), **unlimited}}
    model = model if "projection" in model else model["base"]
    extractor, preprocessing = extractors.load(model).eval(), {**conf["preprocessing"], **how}
    photo = textured if preprocessing.get("grayscale") else np.dstack([textured] * 3)
    every = extractors.extract(extractor, photo, preprocessing)
    masked = extractors.extract(extractor, photo, preprocessing, mask=half)
    kept = inside(half[:, ::-1] if how.get("mirrored") else half, every["keypoints"])
    assert 20 < kept.sum() < len(kept) - 20
    assert every.keys() == masked.keys()
    for key, value in every.items():
        if key in ("keypoints", "scores", "scales", "oris"):
            value = value[kept]
        elif key == "descriptors":
            value = value[:, kept]
        np.testing.assert_allclose(masked[key], value, atol=1e-6)


def test_engines_without_torch_drop_the_same(textured, half):
    conf = features_confs.confs["colmap_sift"]
    with_torch = extractors.load(conf["model"])
    without = NumpyEngine(ColmapSift(features_confs.base_of(conf["model"]), None))
    expected = extractors.extract(with_torch, textured, conf["preprocessing"], mask=half)
    found = without.extract(textured, conf["preprocessing"], half)
    np.testing.assert_array_equal(found["keypoints"], expected["keypoints"])
    assert inside(half, found["keypoints"]).all() and len(found["keypoints"]) > 20


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_masks_are_in_stored_pixels(orientation, tmp_path):
    """EXIF data turn the photo, not the mask: a corner of the stored photo is masked."""
    path = save(tmp_path / "a.png", np.zeros((30, 40), np.uint8), orientation)
    mask = np.ones((30, 40), bool)
    mask[:10, :5] = False
    shown, frame = resized(path, UPRIGHT, mask)
    y, x = np.nonzero(np.ones_like(shown))
    keypoints = np.stack([x, y], axis=1).astype(np.float32)
    found = in_original({"keypoints": keypoints}, shown.shape, frame, 1.0)["keypoints"]
    assert len(found) == 30 * 40 - 50
    assert not ((found[:, 0] < 5) & (found[:, 1] < 10)).any()
    # the corner without its border
    near = frame.near_kept(shown.shape)
    assert (~near).sum() == 4 * 9 and np.rot90(near, -frame.turns)[9:, :].all()


def test_a_keypoint_is_in_the_pixel_that_it_is_rounded_to():
    mask = np.ones((3, 4), bool)
    mask[1, 2] = False
    frame = Frame(np.array([4, 3]), 0, mask)
    around = np.array([[1.49, 1], [1.5, 0.5], [2.49, 1.49], [2.5, 1], [-0.49, 1], [3.6, 2.6]])
    assert frame.keeps(around).tolist() == [True, False, False, True, True, True]


def test_what_is_masked_uses_up_no_keypoints(textured, half):
    """Of networks, and of DoG where a number of keypoints is asked for."""
    conf = features_confs.confs["mini32"]
    photo = np.dstack([textured] * 3)
    for base in ({"name": "mini"}, {"name": "dog", "descriptor": "colmap_sift"}):
        is_dog = base["name"] == "dog"
        shown = {"grayscale": True} if is_dog else conf["preprocessing"]
        extractor = extractors.load({**base, "max_keypoints": 40}).eval()
        every = extractors.extract(extractor, textured if is_dog else photo, shown)
        masked = extractors.extract(extractor, textured if is_dog else photo, shown, mask=half)
        assert inside(half, every["keypoints"]).sum() < 35
        # but for those beside what is kept
        assert 37 <= len(masked["keypoints"]) <= 40 and inside(half, masked["keypoints"]).all()


def test_what_is_masked_uses_up_no_keypoints_of_aliked(textured, half, base_weights):
    """Others are where they are without a mask."""
    base_weights("aliked_t16")
    photo, shown = np.dstack([textured] * 3), features_confs.confs["mini32"]["preprocessing"]
    model = {"name": "aliked", "model_name": "aliked-t16", "max_keypoints": 40}
    masked = extractors.extract(extractors.load(model).eval(), photo, shown, mask=half)
    every = extractors.extract(extractors.load(model | {"max_keypoints": -1}).eval(), photo, shown)
    assert 35 <= len(masked["keypoints"]) <= 40 and inside(half, masked["keypoints"]).all()
    all_points = {tuple(point) for point in every["keypoints"].tolist()}
    assert {tuple(point) for point in masked["keypoints"].tolist()} <= all_points


def test_dog_looks_on_where_too_few_keypoints_are_kept(textured):
    """A bumper full of keypoints does not end the search in a photo that has few."""
    photo = (0.5 + (textured / 255 - 0.5) * 0.1).astype(np.float32)
    photo[120:] = textured[120:] / 255
    mask = np.zeros(photo.shape, bool)
    mask[:110] = True
    found = dog.detect(photo, dog.HLOC_OPTIONS, adaptive=True)[0]
    once = dog.detect(photo, dog.HLOC_OPTIONS)[0]
    kept = dog.detect(photo, dog.HLOC_OPTIONS, adaptive=True, mask=mask)[0]
    assert inside(mask, kept[:, :2]).all()
    assert len(kept) > inside(mask, once[:, :2]).sum()
    assert len(kept) >= inside(mask, found[:, :2]).sum()


def test_maxima_beside_a_mask_are_no_others():
    """A score that is below one that is masked is not a maximum."""
    scores = torch.zeros(20, 20)
    scores[10, 10], scores[10, 11] = 2.0, 1.0
    mask = torch.ones(20, 20, dtype=torch.bool)
    mask[:, :12] = False
    keypoints, _ = strongest(scores, 2, 0.5, 2, -1)
    assert keypoints.tolist() == [[10, 10]]
    assert len(strongest(scores, 2, 0.5, 2, -1, mask)[0]) == 0


@pytest.mark.parametrize("feature", ["colmap_sift_sv32", "mini32"])
def test_photos_without_a_mask_are_as_before(feature, folder, tmp_path, half, caplog):
    photos, given = folder
    conf = features_confs.confs[feature]
    plain = extract_features.main(conf, photos, tmp_path / "plain")
    caplog.set_level("INFO")
    path = extract_features.main(conf, photos, tmp_path / "out", masks=given)
    assert "1 of 2 photos are masked" in caplog.text
    with h5py.File(plain) as before, h5py.File(path) as file:
        for key, value in before["a.png"].items():
            np.testing.assert_array_equal(file[f"a.png/{key}"][()], value[()])
        assert inside(half, file["in/b.png/keypoints"][()]).all()
        number = len(file["in/b.png/keypoints"])
        assert 0 < number < len(before["in/b.png/keypoints"])
        assert file["in/b.png/descriptors"].shape[1] == len(file["in/b.png/scores"]) == number


def test_one_mask_for_all_photos_of_its_size(folder, tmp_path, textured, half):
    photos, _ = folder
    cv2.imwrite(str(photos / "small.png"), textured[:100])
    path = tmp_path / "bumper.png"
    cv2.imwrite(str(path), 255 * half.astype(np.uint8))
    found = masks.find(path, photos, ["a.png", "in/b.png", "small.png"])
    assert set(found) == {"a.png", "in/b.png"} and len({*found.values()}) == 1
    assert masks.find(path, photos, ["small.png"]) == {}
    np.testing.assert_array_equal(masks.read(path), half)
    assert masks.find(None, photos, ["a.png"]) == {}


@pytest.mark.parametrize("kind", ["colour", "bits", "one bit", "transparent"])
def test_every_pixel_that_is_not_black_is_kept(kind, tmp_path, half):
    path = tmp_path / "mask.png"
    if kind == "one bit":
        cv2.imwrite(str(path), 255 * half.astype(np.uint8), [cv2.IMWRITE_PNG_BILEVEL, 1])
    elif kind == "bits":  # a number of an object, beside a large one
        pixels = half.astype(np.uint16)
        pixels[0, 0] = 60_000
        cv2.imwrite(str(path), pixels)
    else:
        pixels = np.zeros((*half.shape, 3 + (kind == "transparent")), np.uint8)
        pixels[..., 0][half] = 1  # so dark a blue that it is black in grey
        pixels[..., 3:] = 255
        cv2.imwrite(str(path), pixels)
    np.testing.assert_array_equal(masks.read(path), half)


def test_changed_masks_are_noticed(folder, tmp_path, half):
    """A mask that changed, that is gone, and one that is new."""
    photos, given = folder
    conf = features_confs.confs["colmap_sift"]

    def extract(**options):
        return extract_features.main(conf, photos, tmp_path / "out", **options)

    path = extract(masks=given)
    done = path.stat().st_mtime_ns
    assert extract(masks=given).stat().st_mtime_ns == done
    with pytest.raises(InputError, match=r"features of 1 photos .*: in/b.png\. Give the same"):
        extract()
    cv2.imwrite(str(given / "a.png.png"), half.astype(np.uint8))
    with pytest.raises(InputError, match=r"features of 1 photos .*: a.png\."):
        extract(masks=given)
    (given / "a.png.png").unlink()
    cv2.imwrite(str(given / "in/b.png.png"), (~half).astype(np.uint8))
    with pytest.raises(InputError, match=r"in/b.png\. .*or --overwrite"):
        extract(masks=given)
    assert path.stat().st_mtime_ns == done
    extract(masks=given, overwrite=True)
    assert path.stat().st_mtime_ns != done
    extract(masks=given)


def test_wrong_masks(folder, tmp_path, textured, half):
    """Nothing is deleted for them, also with --overwrite."""
    photos, given = folder
    conf = features_confs.confs["colmap_sift"]
    path = extract_features.main(conf, photos, tmp_path / "out")
    done = path.stat().st_mtime_ns

    def refused(found):
        with pytest.raises(InputError) as error:
            extract_features.main(conf, photos, tmp_path / "out", masks=found, overwrite=True)
        assert path.stat().st_mtime_ns == done and "\n" not in str(error.value)
        return str(error.value)

    mask = given / "in/b.png.png"
    assert refused(tmp_path / "no") == f"There is no folder or file {tmp_path / 'no'} of masks."
    cv2.imwrite(str(mask), np.ones((320, 240), np.uint8))
    message = refused(given)
    assert message.startswith(f"The mask {mask} has 240x320 pixels, its photo {photos}/in/b.png")
    assert message.endswith(
        "has 320x240. Masks have the pixels of the photo's file, before EXIF data turn it."
    )
    cv2.imwrite(str(mask), np.ones((24, 32), np.uint8))
    assert refused(given).endswith("Masks have the pixels of the photo's file.")
    cv2.imwrite(str(mask), np.zeros((240, 320), np.uint8))
    assert f"The mask {mask} is all black" in refused(given)
    for text in ("no image", ""):
        write(mask, text)
        assert refused(given) == f"The mask {mask} is not an image, or it is truncated."
    mask.rename(given / "in/b.png")  # as some name them
    message = refused(given)
    assert f"No mask in {given} belongs to a photo in {photos}." in message
    assert f"That of a.png would be {given / 'a.png.png'}." in message or (
        f"That of in/b.png would be {given / 'in/b.png.png'}." in message
    )
    small = tmp_path / "small.png"
    cv2.imwrite(str(small), np.ones((24, 32), np.uint8))
    message = refused(small)
    assert message == f"No photo in {photos} has the size of the mask {small}, 32x24 pixels."
    cv2.imwrite(str(small), np.zeros((240, 320), np.uint8))
    assert "all black" in refused(small)
    assert "not an image" in refused(write(tmp_path / "text.png", "no image"))
    for wrong in (
        np.ones((240, 320), np.float32),
        np.ones(240, np.uint8),
        np.ones((9, 9, 4), bool),
    ):
        with pytest.raises(InputError, match="The mask is not .H, W., bool or uint8"):
            masks.kept(wrong)
    with pytest.raises(InputError, match="The mask has 2x3 pixels, the photo has 320x240"):
        resized(textured, {}, np.ones((3, 2), bool))
