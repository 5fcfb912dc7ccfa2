"""Networks that find and describe keypoints: weights, keypoints, noise."""

import io
import os
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import kornia
import numpy as np
import pytest
import torch
from torch import nn

from hloc_reduce import extract_features, extractors, networks
from hloc_reduce.confs import features
from hloc_reduce.extractors.edgepoint2 import EdgePoint2 as EdgePoint2Extractor
from hloc_reduce.networks import EDGEPOINT2, NETWORKS, loading
from hloc_reduce.networks.edgepoint2 import EdgePoint2
from hloc_reduce.networks.keypoints import refined, strongest, strongest_fixed
from hloc_reduce.utils import downloads
from hloc_reduce.utils.cli import InputError

COLOUR = {"grayscale": False}
SMALL = ("edgepoint2_t32", "xfeat", "aliked_t16")


@pytest.fixture
def random_weights(tmp_path, monkeypatch):
    """Replaces the weights of a network by random ones, which nothing checks."""
    (tmp_path / "hub/checkpoints").mkdir(parents=True)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))

    def make(name: str, module: nn.Module, changed: dict | None = None) -> Path:
        network = replace(NETWORKS[name], sha256=None, computes=())
        monkeypatch.setitem(networks.NETWORKS, name, network)
        path = tmp_path / "hub/checkpoints" / network.file
        torch.save(module.state_dict() | (changed or {}), path)
        return path

    return make


def random_network(seed: int = 0) -> nn.Module:
    """Return a T32 whose normalizations do something."""
    torch.manual_seed(seed)
    network = EdgePoint2("T", 32)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean.uniform_(-0.1, 0.1)
            module.running_var.uniform_(0.5, 2)
            module.weight.data.uniform_(0.5, 2)
            module.bias.data.uniform_(-0.1, 0.1)
    return network


def in_colour(grey: np.ndarray) -> np.ndarray:
    return np.repeat(grey[:, :, None], 3, axis=2)


def test_strongest_are_the_highest_strict_maxima():
    scores = torch.zeros(40, 50)
    scores[10, 20], scores[10, 23], scores[30, 40], scores[2, 25] = 3.0, 2.0, 5.0, 9.0
    scores[20, 10:12] = 7.0  # a plateau
    keypoints, found = strongest(scores, 2, 0.5, 4, -1)
    assert keypoints.tolist() == [[40, 30], [20, 10], [23, 10]] and found.tolist() == [5, 3, 2]
    keypoints, _ = strongest(scores, 3, 0.5, 4, -1)
    assert keypoints.tolist() == [[40, 30], [20, 10]]
    assert len(strongest(scores, 2, 0.5, 4, 1)[0]) == 1
    assert len(strongest(scores, 2, 6.0, 4, -1)[0]) == 0
    assert len(strongest(scores[:6, :6], 2, 0.5, 4, -1)[0]) == 0


def test_refined_keypoints_are_the_maxima_of_parabolas():
    y, x = torch.meshgrid(torch.arange(30.0), torch.arange(40.0), indexing="ij")
    scores = torch.maximum(4 - (x - 10.3) ** 2 - (y - 7.8) ** 2, 3 - (x - 30) ** 2 - (y - 20) ** 2)
    scores[15, 20] = 50.0  # a single pixel
    keypoints, _ = strongest(scores, 2, -10.0, 4, 3)
    assert keypoints.tolist() == [[20, 15], [10, 8], [30, 20]]
    found = refined(keypoints, scores)
    torch.testing.assert_close(found[1:], torch.tensor([[10.3, 7.8], [30, 20]]))
    assert (found[0] - keypoints[0]).abs().max() < 0.5
    flat = torch.zeros(30, 40)
    torch.testing.assert_close(refined(keypoints, flat), keypoints)
    assert refined(keypoints[:0], scores).shape == (0, 2)


@pytest.mark.parametrize("number, radius, border", [(20, 2, 4), (4096, 2, 4), (4096, 3, 3)])
def test_strongest_of_fixed_length(number, radius, border):
    scores = torch.randn(40, 51, generator=torch.Generator().manual_seed(0)).round(decimals=1)
    expected, their_scores = strongest(scores, radius, 0.5, border, -1)
    keypoints, found = strongest_fixed(scores, radius, 0.5, border, number)
    some = min(number, len(expected))
    assert 20 < len(expected) < 200 and keypoints.shape == (number, 2)
    torch.testing.assert_close(found[:some], their_scores[:some])
    assert (found[some:] == -torch.inf).all()
    assert (scores[keypoints[:some, 1].long(), keypoints[:some, 0].long()] == found[:some]).all()
    assert set(map(tuple, keypoints[:some].tolist())) <= set(map(tuple, expected.tolist()))
    # weights change the order, and which ones are kept, but not which ones exceed min_score
    weights = 10 - scores
    keypoints, weighted = strongest_fixed(scores, radius, 0.5, border, number, weights)
    values = (their_scores * (10 - their_scores)).sort(descending=True).values
    torch.testing.assert_close(weighted[:some], values[:some])


def test_folded_networks_compute_the_same(random_weights):
    network = random_network().eval()
    random_weights("T32", network)
    folded = loading.load_weights(EdgePoint2("T", 32), "T32")
    assert not any(isinstance(module, nn.BatchNorm2d) for module in folded.modules())
    image = torch.rand(1, 3, 64, 96)
    with torch.no_grad():
        for expected, found in zip(network(image), folded(image), strict=True):
            torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("shape", [(5, 3), (31, 33), (64, 64), (10, 1600), (100, 150)])
def test_photos_of_any_size(random_weights, shape):
    random_weights("T32", random_network())
    model = extractors.load({"name": "edgepoint2", "model_name": "T32"}).eval()
    height, width = shape
    pixels = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)
    found = extractors.extract(model, pixels, COLOUR)
    number = len(found["keypoints"])
    assert found["descriptors"].shape == (32, number) and found["scores"].shape == (number,)
    assert (found["keypoints"] > -1).all()
    assert (found["keypoints"] <= [width, height]).all()
    norms = np.linalg.norm(found["descriptors"], axis=0)
    np.testing.assert_allclose(norms, 1, atol=1e-5)
    grey = extractors.extract(model, np.ascontiguousarray(pixels[:, :, 0]), {"grayscale": True})
    assert grey["descriptors"].shape[0] == 32


def test_photos_of_one_colour_have_no_keypoints(random_weights):
    random_weights("T32", random_network())
    model = extractors.load({"name": "edgepoint2", "model_name": "T32"}).eval()
    found = extractors.extract(model, np.full((640, 640, 3), 77, np.uint8), COLOUR)
    # the padding of convolutions shows near the borders only
    assert not (abs(found["keypoints"] - 319.5) < 100).all(axis=1).any()


@pytest.mark.parametrize("shape", [(1, 1), (5, 3), (17, 20), (31, 33), (10, 1600)])
def test_mini32_takes_photos_smaller_than_its_stride(shape):
    """With the weights that ship."""
    model = extractors.load(features.confs["mini32"]["model"]).eval()
    height, width = shape
    pixels = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)
    found = extractors.extract(model, pixels, COLOUR)
    number = len(found["keypoints"])
    assert (number > 0) == (height * width > 100)
    assert found["descriptors"].shape == (32, number) and found["scores"].shape == (number,)
    assert (found["keypoints"] >= 0).all() and (found["keypoints"] < [width, height]).all()
    np.testing.assert_allclose(np.linalg.norm(found["descriptors"], axis=0), 1, atol=1e-5)


def test_keypoints_of_mini32_lie_between_pixels(textured, monkeypatch):
    """Descriptors and scores are those of the whole pixels that they belong to."""
    model = extractors.load(features.confs["mini32"]["model"]).eval()
    height, width = (side // 32 * 32 for side in textured.shape[:2])  # otherwise it is resized
    textured = np.ascontiguousarray(textured[:height, :width])
    found = extractors.extract(model, textured, COLOUR)
    monkeypatch.setattr(type(model), "_refined", EdgePoint2Extractor._refined)
    expected = extractors.extract(model, textured, COLOUR)
    moved = found["keypoints"] - expected["keypoints"]
    assert len(moved) > 100 and np.abs(moved).max() <= 0.5
    assert np.mean(np.abs(moved).max(axis=1) > 0.05) > 0.5
    for key in ("descriptors", "scores"):
        np.testing.assert_array_equal(found[key], expected[key])


def test_features_of_mini32_from_before_are_not_mixed_with_new_ones(tmp_path, textured):
    """Whose keypoints were in whole pixels."""
    cv2.imwrite(str(tmp_path / "a.png"), textured)
    conf = features.confs["mini32"]
    before = replace(NETWORKS["mini32"], version=0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(NETWORKS, "mini32", before)
        extract_features.main(conf, tmp_path, tmp_path)
    with pytest.raises(InputError, match="another configuration .network_version"):
        extract_features.main(conf, tmp_path, tmp_path)


def test_mini32_finds_nothing_in_one_colour(tmp_path, textured):
    """The file has such photos, without keypoints, beside the others."""
    for name, pixels in (
        ("black.png", np.zeros((480, 640, 3), np.uint8)),
        ("grey.png", np.full((20, 31, 3), 77, np.uint8)),
        ("white.png", np.full((480, 640, 3), 255, np.uint8)),
        ("textured.png", textured),
    ):
        cv2.imwrite(str(tmp_path / name), pixels)
    path = extract_features.main(features.confs["mini32"], tmp_path, tmp_path)
    with h5py.File(path) as file:
        numbers = {name: file[name]["descriptors"].shape for name in file}
    assert all(numbers.pop(name) == (32, 0) for name in ("black.png", "grey.png", "white.png"))
    dim, number = numbers.pop("textured.png")
    assert not numbers and dim == 32 and number > 200


def test_weights_are_checked(random_weights, monkeypatch):
    path = random_weights("T32", random_network())
    content = path.read_bytes()
    conf = {"name": "edgepoint2", "model_name": "T32"}
    extractors.load(conf)
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match="edgepoint2_T32.pth, are broken"):
        extractors.load(conf)
    torch.save(EdgePoint2("S", 32).state_dict(), path)
    with pytest.raises(InputError, match="edgepoint2_T32.pth, are those of another network"):
        extractors.load(conf)
    torch.save([1, 2], path)
    with pytest.raises(InputError, match="edgepoint2_T32.pth, are those of another network"):
        extractors.load(conf)
    monkeypatch.setitem(networks.NETWORKS, "T32", replace(NETWORKS["T32"], sha256="0" * 64))
    with pytest.raises(InputError, match="The weights of T32, .*, are broken: their sha256"):
        extract_features.provenance(features.confs["edgepoint2_t32"])


def test_weights_that_compute_something_else_are_refused(random_weights, monkeypatch):
    from kornia.feature import XFeat

    expected = NETWORKS["xfeat"].computes
    torch.manual_seed(0)
    random_weights("xfeat", XFeat().net)
    monkeypatch.setitem(
        networks.NETWORKS, "xfeat", replace(networks.NETWORKS["xfeat"], computes=expected)
    )
    with pytest.raises(InputError, match="are not the published ones: they compute "):
        extractors.load({"name": "xfeat"})


def test_a_page_in_place_of_weights_is_not_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(downloads, "urlopen", lambda url, timeout: io.BytesIO(b"<html>Log in"))
    with pytest.raises(InputError, match="the downloaded file is not one of torch's"):
        extractors.load({"name": "aliked", "model_name": "aliked-t16"})
    assert not list(tmp_path.rglob("*.pth"))


@pytest.mark.parametrize("name", ["xfeat", "aliked_t16", "edgepoint2_t32"])
def test_all_keypoints_or_some(name, base_weights, textured):
    base_weights(name)
    numbers = []
    for most in (50, 4096, -1):
        model = extractors.load({**features.confs[name]["model"], "max_keypoints": most}).eval()
        numbers.append(len(extractors.extract(model, in_colour(textured), COLOUR)["keypoints"]))
    assert numbers[0] == 50 < numbers[1] <= numbers[2]


def test_networks_of_a_file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("model: {name: aliked, denoise: false}\n")
    _, conf = features.get(str(path))
    assert not conf["preprocessing"]["grayscale"]
    assert features.network_of(conf["model"]) == "aliked-n16"
    assert features.matcher_of(conf) == "NN-mutual"
    path.write_text("model: {name: [1]}\n")
    with pytest.raises(InputError, match="Unknown extractor"):
        extractors.load(features.get(str(path))[1]["model"])


def test_an_unknown_model_is_answered_by_all_that_are_valid():
    with pytest.raises(InputError, match="There are: aliked-n16"):
        extractors.load({"name": "aliked", "model_name": "aliked-n18"})
    with pytest.raises(InputError, match="There are: T48"):
        extractors.load({"name": "edgepoint2", "model_name": "T64"})


@pytest.mark.parametrize("name", SMALL)
def test_features_of_networks(name, base_weights, textured):
    base_weights(name)
    model = extractors.load(features.confs[name]["model"]).eval()
    assert model.descriptor == name and model.dim == features.dimension(name)
    photo = in_colour(cv2.resize(textured, (640, 480), interpolation=cv2.INTER_CUBIC))
    found = extractors.extract(model, photo, COLOUR)
    assert 200 < len(found["keypoints"]) <= 4096
    assert found["descriptors"].shape == (model.dim, len(found["keypoints"]))
    np.testing.assert_allclose(np.linalg.norm(found["descriptors"], axis=0), 1, atol=1e-4)
    again = extractors.extract(model, photo, COLOUR)
    np.testing.assert_array_equal(found["keypoints"], again["keypoints"])
    # the same photo moved by 32 pixels: the same keypoints, moved
    moved = extractors.extract(model, np.ascontiguousarray(photo[32:, 32:]), COLOUR)
    near = np.linalg.norm(
        found["keypoints"][None] - 32 - moved["keypoints"][:300, None], axis=2
    ).argmin(axis=1)
    offset = found["keypoints"][near] - 32 - moved["keypoints"][:300]
    close = np.linalg.norm(offset, axis=1) < 2
    assert close.mean() > 0.6 and (abs(offset[close].mean(axis=0)) < 0.1).all()
    cosine = (found["descriptors"].T[near] * moved["descriptors"].T[:300]).sum(axis=1)
    assert np.median(cosine[close]) > 0.9


@pytest.mark.parametrize("name", ["xfeat", "aliked_t16"])
def test_features_are_kornias(name, base_weights, textured):
    base_weights(name)
    photo = in_colour(cv2.resize(textured, (500, 330), interpolation=cv2.INTER_CUBIC))
    image = torch.from_numpy(photo.transpose(2, 0, 1).astype(np.float32) / 255)[None]
    model = features.confs[name]["model"]
    if name == "xfeat":
        model = {**model, "subpixel": False}
    found = extractors.load(model).eval()({"image": image})
    if name == "xfeat":
        expected = kornia.feature.XFeat.from_pretrained(4096).detectAndCompute(image)[0]
        keypoints, scores = expected["keypoints"], expected["scores"]
        descriptors = expected["descriptors"]
        keypoints = keypoints + (torch.tensor([500 / 480, 330 / 320]) - 1) / 2  # pixel centres
    else:
        with torch.no_grad():
            (expected,) = kornia.feature.ALIKED.from_pretrained("aliked-t16", 4096, 0.0)(image)
        keypoints, scores = expected.keypoints, expected.keypoint_scores
        descriptors = expected.descriptors
    near = torch.cdist(keypoints, found["keypoints"][0]).argmin(dim=1)  # in any order
    assert len(near) == found["keypoints"].shape[1] > 200
    torch.testing.assert_close(found["keypoints"][0][near], keypoints, atol=1e-3, rtol=0)
    torch.testing.assert_close(found["scores"][0][near], scores, atol=1e-4, rtol=0)
    torch.testing.assert_close(found["descriptors"][0].T[near], descriptors, atol=1e-4, rtol=0)


def test_keypoints_of_xfeat_lie_between_pixels(base_weights, textured):
    base_weights("xfeat")
    photo = in_colour(cv2.resize(textured, (480, 320), interpolation=cv2.INTER_CUBIC))
    image = torch.from_numpy(photo.transpose(2, 0, 1).astype(np.float32) / 255)[None]
    model = features.confs["xfeat"]["model"]
    between, whole = (
        extractors.load({**model, "subpixel": subpixel}).eval()({"image": image})
        for subpixel in (True, False)
    )
    shift = between["keypoints"] - whole["keypoints"]
    assert shift.abs().max() <= 0.5 + 1e-3 and shift.abs().mean() > 0.05
    torch.testing.assert_close(between["descriptors"], whole["descriptors"])
    with pytest.raises(InputError, match="subpixl"):
        extractors.load({**model, "subpixl": True})


@pytest.mark.parametrize("model_name", EDGEPOINT2)
def test_edgepoint2_agrees_with_the_authors_code(model_name, base_weights, textured, monkeypatch):
    """EDGEPOINT2 is the folder of a clone of github.com/HITCSC/EdgePoint2."""
    base_weights(f"edgepoint2_{model_name.lower()}")
    clone = os.environ.get("EDGEPOINT2")
    if not clone:
        pytest.skip("EDGEPOINT2 does not name a clone of github.com/HITCSC/EdgePoint2")
    monkeypatch.chdir(clone)
    monkeypatch.syspath_prepend(clone)
    weights = networks.fetch_weights(model_name)
    load = torch.load
    monkeypatch.setattr(torch, "load", lambda file, _: load(weights, "cpu", weights_only=True))
    from edgepoint2 import EdgePoint2Wrapper

    photo = cv2.resize(textured, (500, 330), interpolation=cv2.INTER_CUBIC)
    image = torch.from_numpy(in_colour(photo).transpose(2, 0, 1).astype(np.float32) / 255)[None]
    expected = EdgePoint2Wrapper(model_name, None).eval()(image)[0]
    monkeypatch.setattr(torch, "load", load)
    conf = {"name": "edgepoint2", "model_name": model_name, "max_keypoints": -1}
    found = extractors.load(conf).eval()({"image": image})
    x, y = found["keypoints"][0].T.double()
    order = torch.argsort(y * 1000 + x)  # the authors' without a limit
    for key in ("keypoints", "scores"):
        torch.testing.assert_close(found[key][0][order], expected[key], atol=1e-4, rtol=1e-5)
    descriptors = found["descriptors"][0].T[order]
    torch.testing.assert_close(descriptors, expected["descriptors"], atol=1e-4, rtol=0)
    sys.modules.pop("edgepoint2")


def test_dedode_with_random_weights(tmp_path, textured, monkeypatch):
    from kornia.feature import DeDoDe

    def pretrained(detector, weights, amp_dtype):
        assert (detector, weights) == ("L-C4-v2", "B-upright")
        torch.manual_seed(0)
        return DeDoDe(descriptor_model="B", amp_dtype=amp_dtype)

    monkeypatch.setattr(DeDoDe, "from_pretrained", pretrained)
    cv2.imwrite(str(tmp_path / "a.png"), textured[:75, :110])
    (tmp_path / "dedode.yaml").write_text(
        "model: {name: dedode, max_keypoints: 40}\npreprocessing: {grayscale: false}\n"
    )
    name, conf = features.get(str(tmp_path / "dedode.yaml"))
    assert name == "dedode"
    network = extractors.load(conf["model"]).eval()
    found = extractors.extract(network, tmp_path / "a.png", conf["preprocessing"])
    x, y = found["keypoints"].T
    assert len(x) == 40 and min(x.min(), y.min()) >= 0 and x.max() <= 109 and y.max() <= 74
    np.testing.assert_allclose(x, x.round(), atol=1e-4)  # whole pixels, centres at integers
    np.testing.assert_allclose(np.linalg.norm(found["descriptors"], axis=0), 1, rtol=1e-4)
    gray = extractors.extract(network, tmp_path / "a.png", {"grayscale": True})
    np.testing.assert_allclose(gray["keypoints"], found["keypoints"])


def test_dedode_needs_a_number_of_keypoints():
    with pytest.raises(InputError, match="max_keypoints of DeDoDe is -1: at least 1"):
        extractors.load({"name": "dedode", "max_keypoints": -1})


def test_weights_of_dedode_that_cannot_be_loaded_are_named(monkeypatch):
    from kornia.feature import DeDoDe

    def fails(*_, **__):
        raise OSError("no network")

    monkeypatch.setattr(DeDoDe, "from_pretrained", fails)
    with pytest.raises(InputError, match="L-C4-v2 and B-upright of DeDoDe cannot be loaded"):
        extractors.load({"name": "dedode"})
