"""From images with poses to projections: the stages fit together, and what is refused."""

import hashlib
import json
import re
import sys

import pytest
import torch
from synthetic_tracks import held_out_precision, noisy_tracks

from hloc_reduce import projections
from hloc_reduce.projections import network
from hloc_reduce.training import __main__ as training
from hloc_reduce.training import nested, sv, tracks
from hloc_reduce.utils.cli import InputError


@pytest.fixture
def place(tmp_path, monkeypatch):
    """Folders of images and a model, whose tracks are there without computing them."""
    monkeypatch.setattr(tracks, "main", lambda *_: tmp_path / "tracks.safetensors")
    monkeypatch.setattr(tracks, "load", lambda _: noisy_tracks())
    (tmp_path / "tracks.safetensors").touch()
    folders = tmp_path / "town/images", tmp_path / "town/sparse"
    for folder in folders:
        folder.mkdir(parents=True)
    return folders


def test_a_map_is_trained_on(place, tmp_path):
    arguments = {"place": place}, [], "sift", "pca"
    (path,) = training.main(*arguments, [16], tmp_path / "out", tmp_path)
    projection = projections.load(path)
    assert projection.sizes == (128, 16)
    assert projection.metadata["training_data"] == {
        "place": {"points": 400, "observations": 1600, "sha256": hashlib.sha256(b"").hexdigest()}
    }
    assert json.dumps(projection.metadata["versions"])
    written = path.stat().st_mtime_ns
    assert len(training.main(*arguments, [16, 8], tmp_path / "out", tmp_path)) == 2
    assert path.stat().st_mtime_ns == written


def test_a_projection_of_another_training_is_not_replaced(place, tmp_path):
    others = [], "sift", "pca", [16], tmp_path, tmp_path
    (path,) = training.main({"a": place}, *others)
    written = path.read_bytes()
    with pytest.raises(InputError, match="exists, trained with another training_data. Choose"):
        training.main({"b": place}, *others)
    assert path.read_bytes() == written


def test_nested_is_trained_once(place, tmp_path, monkeypatch):
    recipe = {**nested.RECIPES["best"], "steps": 2, "batch_size": 16}
    monkeypatch.setitem(nested.RECIPES, "best", recipe)
    arguments = {"a": place}, [], "sift", "nested", [], tmp_path, tmp_path
    (path,) = training.main(*arguments)
    written = path.stat().st_mtime_ns
    assert training.main(*arguments) == [path] and path.stat().st_mtime_ns == written


def test_tuning_begins_with_what_ships(place, tmp_path, monkeypatch):
    """Without a step of learning the weights are those that ship; with some they are better."""
    shipped, _ = network.read("sift_sv16")
    for steps, lr in ((1, 0.0), (60, 1e-3)):
        recipe = {**sv.RECIPES["tune"], "steps": steps, "lr": lr, "batch_size": 100}
        monkeypatch.setitem(sv.RECIPES, "tune", recipe)
        given = {"a": place}, [], "sift", "sv", [16], tmp_path / str(steps), tmp_path, "tune"
        (path,) = training.main(*given)
        tuned, metadata = network.read(path)
        assert metadata["recipe"]["begin_with"] == "sift_sv16" and metadata["recipe"]["lr"] == lr
        same = torch.equal(tuned.linears[0].weight, shipped.linears[0].weight)
        assert same == (steps == 1)
    assert held_out_precision(tuned) > 3 * held_out_precision(shipped.eval())


def run(monkeypatch, *arguments):
    """Run the command line."""
    monkeypatch.setattr(sys, "argv", ["training", *map(str, arguments)])
    training._main()


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("--scheme", "us"), "Unknown recipe of us 'tune'"),
        (("--dim", 48), "sift_sv48 does not ship"),
        (("--scheme", "nested", "--descriptor", "hardnet"), "hardnet_nested does not ship"),
    ],
)
def test_what_cannot_be_tuned(place, tmp_path, monkeypatch, arguments, message):
    monkeypatch.setattr(training, "check_weights", lambda name: None)
    given = ("--map", ":".join(map(str, place)), "--cache", tmp_path / "cache")
    with pytest.raises(InputError, match=message):
        run(monkeypatch, *given, "--recipe", "tune", *arguments)
    assert not (tmp_path / "cache").exists()


def test_a_sequence_is_called_otherwise_than_a_map(place, tmp_path, monkeypatch):
    (tmp_path / "sequences/town").mkdir(parents=True)
    given = ("--map", ":".join(map(str, place)))
    with pytest.raises(InputError, match="called town"):
        run(monkeypatch, *given, "--phototour", tmp_path / "sequences/town")
    with pytest.raises(InputError, match="--seed -1"):
        run(monkeypatch, *given, "--seed", -1)


def test_the_command_for_what_does_not_ship_is_one(tmp_path, monkeypatch):
    """The line that the message prints trains, when there is a map; here the map is not there."""
    monkeypatch.setattr(training, "check_weights", lambda name: None)
    with pytest.raises(InputError) as error:
        projections.load("hardnet_us24")
    command = re.search("python -m hloc_reduce.training ([^']*)", str(error.value))[1]
    with pytest.raises(InputError, match="there is no folder IMAGES"):
        run(monkeypatch, *command.split())


def test_maps_are_parsed(place):
    images, model = place
    given = f"{images}:{model}"
    assert tracks.parse_maps([given]) == {"town": place}
    with pytest.raises(InputError, match="images:model"):
        tracks.parse_maps([str(images)])
    with pytest.raises(InputError, match="another map"):
        tracks.parse_maps([given] * 2)
    model.rmdir()
    with pytest.raises(InputError, match="no folder"):
        tracks.parse_maps([given])
