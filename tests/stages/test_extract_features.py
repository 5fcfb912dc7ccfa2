"""Extraction of photos: of all sizes, by all cores, for several features."""

from concurrent.futures import BrokenExecutor
from contextlib import ExitStack, nullcontext

import cv2
import h5py
import numpy as np
import pytest
import torch

from hloc_reduce import extract_features, extractors
from hloc_reduce.confs import features as features_confs
from hloc_reduce.descriptors.model import Descriptor
from hloc_reduce.extractors.dog import DoG
from hloc_reduce.runtime import parallel, processes
from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.feature_files import get_blur


def test_all_cores_extract_the_same(tmp_path, textured, monkeypatch):
    """Also if a network is given several images at once, and if one of them cannot be read."""
    monkeypatch.setattr(extract_features, "_workers", lambda *_: torch.get_num_threads())
    images = []
    for i in range(4):
        images.append(tmp_path / f"{i}.png")
        cv2.imwrite(str(images[-1]), np.roll(textured, 17 * i, axis=1))
    threads = torch.get_num_threads()
    for name in ("sift_sv16", "colmap_sift", "mini32"):
        extracted = []
        for number in (1, 2):
            torch.set_num_threads(number)
            conf = features_confs.confs[name]
            extracted.append(extract_features.main(conf, tmp_path, tmp_path / str(number)))
        torch.set_num_threads(threads)
        with h5py.File(extracted[0]) as alone, h5py.File(extracted[1]) as together:
            assert len(alone) == len(together) == len(images)
            for image in images:
                for key, array in alone[image.name].items():
                    np.testing.assert_array_equal(array[()], together[image.name][key][()])
    images[3].write_bytes(b"no image")
    torch.set_num_threads(2)
    for name in ("sift", "mini32"):
        with pytest.raises(InputError, match="Cannot read image .*3.png"):
            extract_features.main(features_confs.confs[name], tmp_path, tmp_path / "broken")
    torch.set_num_threads(threads)


@pytest.mark.parametrize(
    ("feature", "device", "number"),
    [
        ("mini32", "cuda", 8),
        ("mini32", "cpu", 8),
        ("colmap_sift_sv64", "cuda", 16),
        ("colmap_sift_sv64", "cpu", 16),
    ],
)
def test_images_at_once(feature, device, number, monkeypatch):
    """Reading takes long beside a GPU; on a CPU a small network uses a core for an image."""
    monkeypatch.setattr(parallel, "cores", lambda: 16)
    model = extractors.load(features_confs.confs[feature]["model"])
    assert extract_features._workers(model, device, 99) == number
    assert extract_features._workers(model, device, 1) == 1
    model.detect = None
    model.gpu_images = model.cpu_images = extractors.Extractor.gpu_images
    assert extract_features._workers(model, device, 99) == 1  # another's may not be thread-safe


def test_fast_keypoints_need_no_processes(tmp_path, textured, monkeypatch):
    """OpenCV lets other threads run, so that photos are detected in threads."""
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.roll(textured, 17 * i, axis=1))
    _, conf = features_confs.get("colmap_sift_sv32", keypoints="fast")
    monkeypatch.setattr(parallel, "cores", lambda: 1)
    one = extract_features.main(conf, tmp_path, tmp_path / "one")
    monkeypatch.setattr(parallel, "cores", lambda: 2)
    monkeypatch.setattr(processes, "pool", None)
    two = extract_features.main(conf, tmp_path, tmp_path / "two")
    with h5py.File(one) as first, h5py.File(two) as second:
        for name in first:
            for key, dataset in first[name].items():
                np.testing.assert_array_equal(dataset[()], second[name][key][()])


def test_several_features_at_once_are_those_of_each(tmp_path, textured, monkeypatch):
    """Keypoints are detected once, and each base descriptor is computed once."""
    names = ["sift", "sift_sv64", "colmap_sift_sv32", "sift_sv16"]
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.roll(textured, 17 * i, axis=1))
    for name in names:
        extract_features.main(features_confs.confs[name], tmp_path, tmp_path / "alone")
    detected, described = [], []
    monkeypatch.setattr(
        colmap, "detect_dog", lambda *a, f=colmap.detect_dog: detected.append(1) or f(*a)
    )
    forward = Descriptor.forward
    monkeypatch.setattr(Descriptor, "forward", lambda *a: described.append(1) or forward(*a))
    monkeypatch.setattr(parallel, "cores", lambda: 1)
    with ExitStack() as stack:
        features = {}
        for name in names:
            conf = {**features_confs.confs[name], "storage": "float16"}
            path = tmp_path / "together" / f"{conf['output']}.h5"
            writer = stack.enter_context(GroupWriter(path, {}))
            features[path] = conf, writer
        models = [extractors.load(conf["model"]) for conf, _ in features.values()]
        assert all(model.detection == models[0].detection for model in models)
        files = [f"{i}.png" for i in range(3)]
        extract_features.extract_several(features, tmp_path, files)
    assert len(detected) == len(described) == 3
    for path in features:
        with h5py.File(path) as together, h5py.File(tmp_path / "alone" / path.name) as alone:
            for name in files:
                assert alone[name].keys() == together[name].keys()
                for key, dataset in alone[name].items():
                    np.testing.assert_array_equal(dataset[()], together[name][key][()])


def test_extraction_in_original_pixels(tmp_path, textured):
    """A photo that is made twice as large and resized back gives keypoints of the large one."""
    large = cv2.resize(textured, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    cv2.imwrite(str(tmp_path / "small.png"), textured)
    cv2.imwrite(str(tmp_path / "large.png"), large)
    model = DoG({})
    preprocessing = {"grayscale": True, "resize_max": 320}
    small = extractors.extract(model, tmp_path / "small.png", preprocessing)
    large = extractors.extract(model, tmp_path / "large.png", preprocessing)
    assert large["image_size"].tolist() == [640, 480] and large["uncertainty"] == 2
    np.testing.assert_allclose(large["keypoints"], small["keypoints"] * 2 + 0.5, atol=1e-3)
    np.testing.assert_allclose(large["scales"], small["scales"] * 2, rtol=1e-5)


def test_the_blur_of_a_noisy_photo_is_stored_in_its_pixels(tmp_path, textured, monkeypatch):
    class Blurring(DoG):
        def _forward(self, data):
            return super()._forward(data) | {"blur": torch.tensor([1.5])}

    monkeypatch.setattr(extractors, "load", Blurring)
    cv2.imwrite(str(tmp_path / "a.png"), textured)
    conf = {
        "output": "feats",
        "model": {"name": "dog"},
        "preprocessing": {"grayscale": True, "resize_max": 160},
    }
    with h5py.File(extract_features.main(conf, tmp_path, tmp_path)) as file:
        assert get_blur(file, "a.png") == 3.0 and "blur" not in file["a.png"]


def test_a_killed_detector_is_said(tmp_path, textured, monkeypatch):
    """What the kernel does where memory is short."""
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), textured)

    class Broken:
        def submit(self, *_):
            raise BrokenExecutor

    monkeypatch.setattr(extract_features.processes, "pool", lambda _: nullcontext(Broken()))
    monkeypatch.setattr(extract_features.parallel, "cores", lambda: 2)
    with pytest.raises(InputError, match="lack of memory"):
        extract_features.main(extract_features.confs["sift"], tmp_path, tmp_path / "o")


SMALL = [(1, 1), (1, 300), (300, 1), (2, 2), (12_000, 40)]


@pytest.mark.parametrize(
    "size, feature",
    [
        *((size, feature) for size in SMALL for feature in ("sift_sv16", "colmap_sift")),
        ((3_000, 12_000), "sift_sv16"),
    ],
)
def test_photos_of_any_size(size, feature, tmp_path):
    image = cv2.resize(np.random.default_rng(0).integers(0, 256, (60, 80), np.uint8), size[::-1])
    cv2.imwrite(str(tmp_path / "a.jpg"), image)
    conf = features_confs.confs[feature]
    model = extractors.load(conf["model"])
    features = extractors.extract(model, tmp_path / "a.jpg", conf["preprocessing"])
    assert features["image_size"].tolist() == [size[1], size[0]]
    number = len(features["keypoints"])
    assert number == features["descriptors"].shape[1] == len(features["scales"])
    assert number > 100 if min(size) > 1000 else number < 100
    if number:
        assert (features["keypoints"] > -0.5).all()
        assert (features["keypoints"].max(axis=0) < features["image_size"] - 0.5).all()


def test_other_failures_are_not_those_of_an_image(textured, tmp_path):
    """Without `strict` only an image that cannot be read is passed over."""
    cv2.imwrite(str(tmp_path / "a.png"), np.dstack([textured] * 3))
    conf = {**features_confs.confs["sift"], "preprocessing": {"resize_max": 1600}}  # in colour
    with pytest.raises(InputError, match="DoG needs grey images"):
        extract_features.main(conf, tmp_path, tmp_path / "o", strict=False)
