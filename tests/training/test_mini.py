"""Training of networks that find and describe keypoints."""

import sys

import cv2
import numpy as np
import pytest
import torch
from interruption import interrupted
from torch.nn.functional import normalize

from hloc_reduce import extract_features, extractors
from hloc_reduce.confs import features as features_confs
from hloc_reduce.networks import NETWORKS
from hloc_reduce.networks.edgepoint2 import EdgePoint2
from hloc_reduce.training import mini, views
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.h5 import list_h5_names


@pytest.fixture
def photos(tmp_path, textured):
    """A folder of two photos of 640 x 480 pixels."""
    folder = tmp_path / "place/images"
    folder.mkdir(parents=True)
    for i, photo in enumerate((textured, textured[::-1])):
        cv2.imwrite(str(folder / f"{i}.png"), cv2.resize(photo, (640, 480)))
    return folder


@pytest.fixture
def teacher(monkeypatch):
    """A random teacher, which needs no download."""

    def load(network, name):
        assert name == "T32"
        torch.manual_seed(7)
        return EdgePoint2("T", 32).eval()

    monkeypatch.setattr(mini, "load_weights", load)


def test_views_show_the_same_place(photos):
    """The homography maps the first view to the second, where both show the photo."""
    pairs = list(views.draw(views.of_folders([photos]), 6, np.random.default_rng(0)))
    inside = np.zeros((views.SIZE, views.SIZE), np.float32)
    inside[4:-4, 4:-4] = 1
    for pair in pairs:
        size = (views.SIZE, views.SIZE)
        moved = cv2.warpPerspective(pair.clean[0], pair.matrix, size)
        common = cv2.warpPerspective(inside, pair.matrix, size) == 1
        assert common.mean() > 0.05
        error = np.abs(moved - pair.clean[1])[common].mean()
        assert error < 0.3 * np.abs(pair.clean[0] - pair.clean[1])[common].mean()
        for part in (pair.clean, pair.degraded):
            assert part.dtype == np.float32 and part.min() >= 0 and part.max() <= 1
    assert any(np.abs(pair.clean - pair.degraded).mean() > 0.1 for pair in pairs)
    again = list(views.draw(views.of_folders([photos]), 6, np.random.default_rng(0)))
    assert all(np.array_equal(a.degraded, b.degraded) for a, b in zip(pairs, again, strict=True))


def test_towns_by_day_and_by_night(tmp_path, monkeypatch):
    """Each photo twice; those that are there are not rendered again."""
    asked = []
    photo = cv2.imencode(".png", np.full((4, 4), 90, np.uint8))[1].tobytes()

    def take(scene, seen, seed):
        asked.append((seen.kind, seed))
        return photo

    monkeypatch.setattr(views, "take", take)
    built = type("Built", (), {"cache_clear": lambda self: None, "__call__": lambda *_: None})
    monkeypatch.setattr(views, "build_town", built())
    sources = views.render_towns([5], tmp_path)
    number = len(sources)
    assert number > 20 and len(asked) == 2 * number and {seed for _, seed in asked} == {5}
    assert all(source.clean.exists() and source.dark.exists() for source in sources)
    assert views.render_towns([5], tmp_path) == sources and len(asked) == 2 * number


def test_rounded_has_four_levels_a_number():
    generator = torch.Generator().manual_seed(0)
    descriptors = normalize(torch.randn(400, 3, generator=generator), dim=1).requires_grad_()
    values = mini.rounded(descriptors)
    torch.testing.assert_close(values.norm(dim=1), torch.ones(400))
    assert (descriptors * values).sum(dim=1).mean() > 0.9
    assert len(torch.unique(values.detach().round(decimals=4), dim=0)) <= 4**3
    values.sum().backward()  # straight through
    assert torch.equal(descriptors.grad, torch.ones_like(descriptors))


def test_matching_loss_is_lower_for_the_right_place():
    """Descriptors that tell places apart, moved by 16 pixels between the views."""
    side = views.SIZE
    generator = torch.Generator().manual_seed(0)
    place = torch.randn(1, 16, side // 4 + 4, side // 4 + 4, generator=generator)
    dense = torch.cat([place[:, :, 4:, 4:], place[:, :, :-4, :-4]])
    scores = torch.randn(2, 1, side, side, generator=generator)
    moved = torch.eye(3)[None].clone()
    moved[0, :2, 2] = 16.0
    right = mini.matching_loss(dense, scores, moved)
    assert right < 0.5 * mini.matching_loss(dense, scores, torch.eye(3)[None])
    moved[0, :2, 2] = 10_000.0  # nothing in common
    assert mini.matching_loss(dense, scores, moved) == 0


def test_an_interrupted_training_resumes(photos, teacher, tmp_path, monkeypatch):
    """With the same weights as an uninterrupted one, which a feature then uses."""
    monkeypatch.setattr(mini, "BATCH", 1)
    settings = {"teacher": "T32", "steps": 3}
    whole = mini.main([photos], tmp_path / "whole.safetensors", **settings)
    monkeypatch.setattr("hloc_reduce.training.loop.CHECKPOINT_STEPS", 1)
    part = tmp_path / "part.safetensors"
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        interrupted(patch, mini, "loss", 3)
        mini.main([photos], part, **settings)
    assert part.with_suffix(".checkpoint").exists() and not part.exists()
    mini.main([photos], part, **settings)
    assert part.read_bytes() == whole.read_bytes()
    assert not part.with_suffix(".checkpoint").exists()

    feature = tmp_path / "own.yaml"
    feature.write_text(f"model: {{name: mini, weights: {whole}, max_keypoints: 50}}\n")
    _, conf = features_confs.get(str(feature))
    features = extract_features.main(conf, photos, tmp_path)
    assert list_h5_names(features) == ["0.png", "1.png"]
    adapted = mini.main([photos], tmp_path / "more.safetensors", start=whole, **settings)
    assert adapted.read_bytes() != whole.read_bytes()
    whole.write_bytes(adapted.read_bytes())  # features of other weights are not mixed
    with pytest.raises(InputError, match="another configuration .weights_sha256"):
        extract_features.main(conf, photos, tmp_path)
    whole.unlink()
    with pytest.raises(InputError, match="There is no file .*whole.safetensors of weights"):
        extract_features.main(conf, photos, tmp_path)
    whole.write_bytes(b"nothing")
    with pytest.raises(InputError, match="The weights of mini32, .*, are broken"):
        extractors.load(conf["model"])


@pytest.mark.parametrize(
    "options, message",
    [
        (["--output", "a.pth"], "it must end in .safetensors"),
        (["--output", "a.safetensors"], "Give photos, --images, or seeds of --towns"),
        (["--output", "a.safetensors", "--teacher", "M64"], "another dimension than 32"),
        (["--output", "a.safetensors", "--teacher", "XL"], "Unknown teacher 'XL'"),
        (["--output", "a.safetensors", "--images", "nowhere"], "nowhere"),
    ],
)
def test_refusals(options, message, monkeypatch, tmp_path, caplog):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["mini", *options])
    with pytest.raises(SystemExit) as exit:
        cli.run(mini._main)
    assert exit.value.code == 2 and message in caplog.text


@pytest.mark.parametrize("name", [name for name in features_confs.MODELS if "mini" in name])
def test_shipped_weights(name, textured):
    """Keypoints and descriptors of a photo, with and without noise."""
    conf = features_confs.confs[name]
    model = extractors.load(conf["model"]).eval()
    photo = np.repeat(textured[:, :, None], 3, axis=2)
    features = extractors.extract(model, photo, conf["preprocessing"])
    number, dim = features["descriptors"].T.shape
    assert number > 100 and dim == NETWORKS[name].dim
    np.testing.assert_allclose(np.linalg.norm(features["descriptors"], axis=0), 1, atol=1e-5)
    noise = np.random.default_rng(0).normal(0, 20, textured.shape)
    noisy = (textured + noise).clip(0, 255).astype(np.uint8)
    others = extractors.extract(
        model, np.repeat(noisy[:, :, None], 3, axis=2), conf["preprocessing"]
    )
    distances = np.linalg.norm(features["keypoints"][:, None] - others["keypoints"][None], axis=2)
    assert (distances.min(axis=1) < 3).mean() > 0.5
    cosines = features["descriptors"].T @ others["descriptors"]
    near = distances.min(axis=1) < 1.5
    assert np.median(cosines[near, distances.argmin(axis=1)[near]]) > 0.5
