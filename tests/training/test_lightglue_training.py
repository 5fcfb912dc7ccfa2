"""LightGlue tuned to a mini: labels with true matches known in advance, and a short training."""

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from hloc_reduce.matchers.lightglue import LightGlue
from hloc_reduce.networks.lightglue import file_of, metadata_of
from hloc_reduce.training import lightglue as training
from hloc_reduce.training.lightglue import CROPS, SIDE, Labels
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError


@pytest.fixture
def labels(base_weights, plane, monkeypatch) -> Labels:
    """Of the photos of the plane, by few keypoints."""
    for name in ("xfeat", "xfeat+lightglue"):
        base_weights(name)
    monkeypatch.setattr(training, "NUM_KEYPOINTS", 256)
    return Labels("mini32", *training.read({"plane": (plane / "images", plane / "model")}))


def on_plane(photo, pixels: np.ndarray) -> np.ndarray:
    """The points (N, 2) of the plane z = 0 at pixels of a photo."""
    rays = np.pad(colmap.cam_from_img(photo.camera, pixels), ((0, 0), (0, 1)), constant_values=1)
    world_from_cam = photo.cam_from_world.inverse()
    directions = rays @ world_from_cam.rotation.matrix().T
    centre = world_from_cam.translation
    return (centre - directions * (centre[2] / directions[:, 2:]))[:, :2]


def test_photos_and_their_pairs(labels):
    assert len(labels.photos) == 5 and (labels.places == 0).all()
    assert {tuple(sorted(pair)) for pair in labels.pairs} <= {
        (i, j) for i in range(5) for j in range(i + 1, 5)
    }


def test_a_view_knows_its_place_in_the_photo(labels):
    """The pixel in its middle is the mean of those around that place."""
    photo = labels.photos[0]
    view = training.cut(photo, np.random.default_rng(0))
    assert view.pixels.shape == (SIDE, SIDE, 3)
    shorter = min(photo.pixels.shape[:2])
    assert CROPS[0] <= view.scale * SIDE / shorter <= CROPS[1]
    middle = np.array([[SIDE / 2, SIDE / 2]])
    x, y = np.round(view.in_photo(middle)[0] - 0.5).astype(int)
    around = photo.pixels[y - 1 : y + 2, x - 1 : x + 2].mean()
    assert view.pixels[SIDE // 2, SIDE // 2].mean() == pytest.approx(around, abs=8)


def test_labels_are_true_matches(labels, monkeypatch):
    """Also where the student sees the first view in the dark."""
    cut, views = training.cut, []
    monkeypatch.setattr(training, "cut", lambda *given: views.append(cut(*given)) or views[-1])
    monkeypatch.setattr(training, "APART", 0)
    errors = []
    for seed in range(4):
        first, second, matches, unmatched = labels.draw(np.random.default_rng(seed))
        assert first["descriptors"].shape[2] == 32 and second["keypoints"].shape[1] <= 256
        assert not set(matches[:, 0].tolist()) & set(unmatched[0].tolist())
        rng = np.random.default_rng(seed)
        rng.random()
        pair = labels.pairs[rng.integers(len(labels.pairs))]
        places = [
            on_plane(
                labels.photos[number],
                view.in_photo(one["keypoints"][0].numpy()[matches[:, i]].astype(float)),
            )
            for i, (number, view, one) in enumerate(
                zip(pair, views[-2:], (first, second), strict=True)
            )
        ]
        errors.append(np.linalg.norm(places[0] - places[1], axis=1))
    found = np.concatenate(errors)
    assert len(found) > 40
    assert np.mean(found < 0.03) > 0.9  # of a plane of side 2, seen at about 0.004 a pixel


def test_photos_of_different_places_have_no_matches(labels, monkeypatch):
    monkeypatch.setattr(training, "APART", 1)
    monkeypatch.setattr(labels, "places", np.arange(5))
    first, second, matches, unmatched = labels.draw(np.random.default_rng(0))
    assert not len(matches)
    assert [len(part) for part in unmatched] == [
        one["keypoints"].shape[1] for one in (first, second)
    ]


def test_a_training_lowers_the_loss_and_its_weights_match(labels, tmp_path, plane, monkeypatch):
    monkeypatch.setattr(training, "DARK", 0)
    student = LightGlue({"features": "mini32", **training.WHOLE}).net
    before = training.loss(student, labels, 1, 0, 0).item()
    output = tmp_path / "mini32.safetensors"
    maps = [f"{plane / 'images'}:{plane / 'model'}"]
    monkeypatch.setattr(training, "Labels", lambda *_: labels)
    draw = labels.draw
    monkeypatch.setattr(labels, "draw", lambda _: draw(np.random.default_rng((0, 0))))
    training.main(output, maps, "mini32", steps=4)
    monkeypatch.setattr("hloc_reduce.networks.lightglue.WEIGHTS", tmp_path)
    trained = LightGlue({"features": "mini32", **training.WHOLE})
    assert training.loss(trained.net, labels, 1, 0, 0).item() < 0.95 * before
    assert metadata_of("mini32")["network"] == "xfeat"
    assert all(torch.isfinite(part).all() for part in trained.parameters())
    assert not output.with_suffix(".checkpoint").exists()
    again = training.main(tmp_path / "again.safetensors", maps, "mini32", output, steps=0)
    for name, weights in load_file(output).items():
        torch.testing.assert_close(load_file(again)[name], weights)


def test_wrong_options(tmp_path, plane):
    maps = [f"{plane / 'images'}:{plane / 'model'}"]
    with pytest.raises(InputError, match="must end in .safetensors"):
        training.main(tmp_path / "mini32.pth", maps)
    with pytest.raises(InputError, match="--lr 0: it must be a number above 0"):
        training.main(tmp_path / "mini32.safetensors", maps, lr=0)
    with pytest.raises(InputError, match="--start .*none.safetensors: there is no such"):
        training.main(tmp_path / "o.safetensors", maps, start=tmp_path / "none.safetensors")
    with pytest.raises(InputError, match="--start .*mini64.*: these are not weights for mini32"):
        training.main(tmp_path / "o.safetensors", maps, "mini32", start=file_of("mini64"))
