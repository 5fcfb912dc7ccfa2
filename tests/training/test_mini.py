"""Training of networks that find and describe keypoints."""

import sys

import cv2
import numpy as np
import pytest
import torch
from interruption import interrupted
from safetensors.torch import load_file
from torch.nn.functional import normalize

from hloc_reduce import extract_features, extractors
from hloc_reduce.confs import features as features_confs
from hloc_reduce.networks import NETWORKS
from hloc_reduce.networks.edgepoint2 import EdgePoint2
from hloc_reduce.training import degradation, mini, views
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.h5 import list_h5_names

CPU = torch.device("cpu")


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
        assert name in ("T32", "T48")
        torch.manual_seed(7)
        return EdgePoint2("T", int(name[1:])).eval()

    monkeypatch.setattr(mini, "load_weights", load)


def test_views_show_the_same_place(photos):
    """The homography maps the first view to the second, where both show the photo."""
    sources = views.of_folders([photos])
    pairs = views.Photos(sources, CPU).draw(6, (0, 0))
    inside = np.zeros((views.SIZE, views.SIZE), np.float32)
    inside[4:-4, 4:-4] = 1
    clean = pairs.clean[:, 0].numpy()
    for first, second, matrix in zip(clean[::2], clean[1::2], pairs.matrices.numpy(), strict=True):
        moved = cv2.warpPerspective(first, matrix, inside.shape)
        common = cv2.warpPerspective(inside, matrix, inside.shape) == 1
        assert common.mean() > 0.05
        error = np.abs(moved - second)[common].mean()
        assert error < 0.3 * np.abs(first - second)[common].mean()
    for part in (pairs.clean, pairs.degraded):
        assert part.dtype == torch.float32 and part.min() >= 0 and part.max() <= 1
    changes = (pairs.clean - pairs.degraded).abs().mean(dim=(1, 2, 3))
    assert changes.max() > 0.1 and 0 < (changes == 0).sum() < 12  # some are kept
    again = views.Photos(sources, CPU).draw(6, (0, 0))
    assert torch.equal(again.degraded, pairs.degraded)
    others = views.Photos(sources, CPU).draw(6, (0, 1))
    assert not torch.equal(others.clean, pairs.clean)


def test_views_by_night_show_the_place_by_day(tmp_path):
    """The student sees the dark photo through the homography of the clean one."""
    day = np.tile(np.arange(0, 240, 0.5, np.float32)[None], (360, 1)).astype(np.uint8)
    for name, photo in (("day", day), ("night", day // 4)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), photo)
    source = views.Source(tmp_path / "day.png", tmp_path / "night.png")
    pairs = views.Photos([source], CPU).draw(8, (0, 0))
    errors = (pairs.degraded - pairs.clean / 4).abs().amax(dim=(1, 2, 3))
    assert 5 <= (errors < 0.01).sum() < 16


def test_lamps_shine_in_lit_views_only():
    lit = np.array([True, False, True])
    light = degradation._lamps(np.random.default_rng(0), lit, 64, CPU)
    assert light.shape == (3, 1, 64, 64) and light.min() >= 0
    assert torch.equal(light.amax(dim=(1, 2, 3)) > 1, torch.from_numpy(lit))


def test_blurs_keep_the_light():
    """A kernel sums up to 1; without a blur, a view stays as it is."""
    kernels = degradation._kernels(np.random.default_rng(0), 40)
    np.testing.assert_allclose(kernels.sum(axis=(1, 2)), 1, atol=1e-5)
    view = torch.rand(40, 1, 32, 32, generator=torch.Generator().manual_seed(0))
    blurred = degradation._blurred(view, kernels)
    sharp = kernels.reshape(40, -1).max(axis=1) == 1
    assert 2 < sharp.sum() < 30
    torch.testing.assert_close(blurred[sharp], view[sharp])
    assert (blurred.std(dim=(1, 2, 3)) < view.std(dim=(1, 2, 3)))[~sharp].all()


@pytest.mark.parametrize("quality", [42, 75, 95])
def test_jpeg_is_that_of_opencv(textured, quality):
    levels = cv2.resize(textured, (64, 48))
    buffer = cv2.imencode(".jpg", levels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    expected = cv2.imdecode(buffer, cv2.IMREAD_GRAYSCALE).astype(int)
    given = torch.from_numpy(levels).float()[None, None]
    found = degradation._jpeg(given, torch.full((1, 1, 1, 1), float(quality)))[0, 0].numpy()
    # libjpeg computes with integers
    assert np.abs(found - expected).mean() < 0.5
    assert np.abs(expected - levels).mean() > 1.4


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


@pytest.fixture
def shifted():
    """Descriptors that tell places apart, and scores, moved by 16 pixels between two views."""
    side = views.SIZE
    generator = torch.Generator().manual_seed(0)
    place = torch.randn(1, 16, side // 4 + 4, side // 4 + 4, generator=generator)
    heights = torch.randn(1, 1, side + 16, side + 16, generator=generator)
    dense = torch.cat([place[:, :, 4:, 4:], place[:, :, :-4, :-4]])
    scores = torch.cat([heights[:, :, 16:, 16:], heights[:, :, :-16, :-16]])
    matrices = torch.eye(3)[None].clone()
    matrices[0, :2, 2] = 16.0
    return dense, scores, matrices


def test_the_matching_loss_is_lower_for_the_right_place(shifted):
    dense, scores, matrices = shifted
    right = mini.matching_loss(*shifted)
    assert right < 0.5 * mini.matching_loss(dense, scores, torch.eye(3)[None])
    matrices[0, :2, 2] = 10_000.0  # nothing in common
    assert mini.matching_loss(dense, scores, matrices) == 0


def test_a_single_keypoint_leaves_the_gradient_finite(shifted):
    """In dark views there may be no other: it has no deviation from the mean."""
    dense, scores, matrices = shifted
    scores = torch.full_like(scores, -9.0)
    scores[0, 0, 100, 160] = 5.0
    dense = dense.clone().requires_grad_()
    mini.matching_loss(dense, scores, matrices).backward()
    assert dense.grad.isfinite().all()


def test_keypoints_at_infinity_leave_the_gradient_finite(shifted):
    """Of a homography that moves the pixels of a column to infinity, as a strong tilt can."""
    dense, scores, matrices = shifted
    matrices[0, 2] = torch.tensor([-1 / 160, 0, 1])  # the column x = 160
    scores = scores.clone()
    scores[0, 0, 100:200:10, 160] = 50.0
    dense = dense.clone().requires_grad_()
    mini.matching_loss(dense, scores, matrices).backward()
    assert dense.grad.isfinite().all() and dense.grad.abs().max() > 0


def test_keypoints_are_the_highest_maxima():
    scores = torch.full((1, 1, 64, 64), -9.0)
    for x, y, height in ((20, 30, 3.0), (40, 12, 5.0), (2, 30, 9.0), (21, 31, 2.0)):
        scores[0, 0, y, x] = height
    pixels, found = mini.find(scores)
    # not the one at the border, nor the one beside a higher one
    assert found.sum() == 2 and pixels[0, :2].tolist() == [[40, 12], [20, 30]]


def test_an_interrupted_training_resumes(photos, teacher, tmp_path, monkeypatch):
    """With the same weights as an uninterrupted one, which a feature then uses."""
    settings = {"teacher": "T32", "steps": 3, "batch": 1}
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
    wider = mini.main(
        [photos],
        tmp_path / "wider.safetensors",
        48,
        start=whole,
        teacher="T48",
        steps=1,
        batch=1,
        lr=0.002,
    )
    weights, before = load_file(wider), load_file(whole)
    assert weights[f"{EdgePoint2.last}.weight"].shape[0] == 48
    # one step of Adam moves each weight by the learning rate at most
    change = weights["block3.layer.0.weight"] - before["block3.layer.0.weight"]
    assert 0 < change.abs().max() < 1.01 * 0.002
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
        (["--output", "a.safetensors", "--batch", "0"], "must be at least 1"),
        (["--output", "a.safetensors", "--lr", "0"], "must be a number above 0"),
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
