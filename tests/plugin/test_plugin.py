"""The plugin with a test double of hloc."""

import importlib
import re
from importlib.machinery import ModuleSpec

import hloc_double
import numpy as np
import pycolmap
import pytest
import torch
from command import refused, run
from hloc_double import INIT

import hloc_reduce
from hloc_reduce import extractors, projections, retrieval, training
from hloc_reduce import hloc as plugin
from hloc_reduce import matchers as matchers_package
from hloc_reduce.confs import features
from hloc_reduce.confs import retrieval as retrieval_confs
from hloc_reduce.confs.matchers import confs as matchers
from hloc_reduce.projections import network
from hloc_reduce.training import tracks
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from pipelines import aachen


@pytest.fixture
def forgotten():
    with hloc_double.forgotten():
        yield


@pytest.fixture
def double(tmp_path, monkeypatch, forgotten):
    """A package `hloc` to import, as a folder."""
    folder = hloc_double.write(tmp_path / "double")
    monkeypatch.syspath_prepend(str(folder.parent))
    return folder


def test_registered_extractors_are_loaded_by_name(double):
    hloc_reduce.register()
    package = importlib.import_module("hloc.extractors")
    load = importlib.import_module("hloc.utils.base_model").dynamic_load
    conf = importlib.import_module("hloc.extract_features").confs["sift_sv16"]["model"]
    image = {"image": torch.rand(1, 1, 120, 160)}
    found = load(package, conf["name"])(conf).eval()(image)
    expected = extractors.load(features.confs["sift_sv16"]["model"]).eval()(image)
    torch.testing.assert_close(found["descriptors"], expected["descriptors"])
    # as float32 hloc would round them to float16
    assert found["keypoints"].dtype == torch.float64
    assert load(package, "reduced")({"name": "reduced"}).detection_noise == 1
    vlad = load(package, "vlad")({"name": "vlad"})(image)["global_descriptor"]
    assert vlad.shape == (1, 64 * 64) and vlad.norm() == pytest.approx(1, abs=1e-5)


def test_confs_are_added_once_and_none_is_replaced(double):
    added = hloc_reduce.register()
    confs = importlib.import_module("hloc.extract_features").confs
    assert confs["sift"]["output"] == "feats-sift" and "sift" not in added
    assert features.confs.keys() <= confs.keys() and {"vlad", "sift_nested@24"} < set(added)
    assert confs["mkd"]["model"] == {"name": "reduced", "base": features.base("mkd")}
    matcher_confs = importlib.import_module("hloc.match_features").confs
    assert matcher_confs["NN-ratio"] == {"output": "hlocs own"}
    assert matcher_confs["NN-mutual"] == matchers["NN-mutual"]
    before = {**confs}
    assert hloc_reduce.register() == [] and confs == before
    assert matcher_confs["aliked_sv32+lightglue"] == {
        "output": "matches-aliked_sv32-lightglue",
        "model": {"name": "reduced_lightglue", "features": "aliked_sv32"},
    }
    assert matcher_confs["aliked+lightglue"] == matchers["aliked+lightglue"]  # hloc's
    assert "lightglue" not in matcher_confs  # hloc's matchers do not know the features
    for package in ("extractors", "matchers"):
        assert len(importlib.import_module(f"hloc.{package}").__path__) == 2


def test_a_registered_matcher_is_loaded_by_name(double, base_weights):
    base_weights("xfeat+lightglue")
    hloc_reduce.register()
    package = importlib.import_module("hloc.matchers")
    load = importlib.import_module("hloc.utils.base_model").dynamic_load
    conf = importlib.import_module("hloc.match_features").confs["mini32+lightglue"]["model"]
    data = {"image0": torch.empty(1, 1, 480, 640), "image1": torch.empty(1, 1, 480, 640)}
    for i in (0, 1):
        data[f"keypoints{i}"] = 480 * torch.rand(1, 9, 2)
        data[f"descriptors{i}"] = torch.nn.functional.normalize(torch.randn(1, 32, 9), dim=1)
        data[f"image_size{i}"] = torch.tensor([[640.0, 480.0]])
    found = load(package, conf["name"])(conf).eval()(data)
    own = matchers_package.load({**conf, "name": "lightglue"})(data)
    assert torch.equal(found["matches0"], own["matches0"]) and found["matches0"].shape == (1, 9)


def test_confs_are_copies(double):
    """hloc's users change an entry in place, for themselves only."""
    hloc_reduce.register()
    confs = importlib.import_module("hloc.extract_features").confs
    confs["sift_sv64"]["preprocessing"]["resize_max"] = 7
    for conf in (confs["sift_sv32"], confs["vlad"], features.confs["sift_sv64"]):
        assert conf["preprocessing"]["resize_max"] == 1600


def test_a_broken_hloc_and_a_folder_of_its_name(double, monkeypatch):
    (double / "__init__.py").write_text("import not_there")
    with pytest.raises(InputError, match="hloc cannot be imported .*not_there"):
        hloc_reduce.register()
    # what Python finds where a folder has the name but is no package
    monkeypatch.setattr("hloc_reduce.utils.hloc.find_spec", lambda name: ModuleSpec(name, None))
    with pytest.raises(InputError, match="hloc is not installed"):
        hloc_reduce.register()


def test_features_of_files_are_registered_by_their_names(double, tmp_path):
    (tmp_path / "mine.yaml").write_text("model: {name: dog, max_keypoints: 7}")
    assert "mine" in hloc_reduce.register([tmp_path / "mine.yaml"])
    conf = importlib.import_module("hloc.extract_features").confs["mine"]
    base = {"name": "dog", "max_keypoints": 7, "keypoints": "adaptive"}
    assert conf["model"] == {"name": "reduced", "base": base}
    assert hloc_reduce.register([tmp_path / "mine.yaml"]) == []
    (tmp_path / "sift.yaml").write_text("model: {name: dog, max_keypoints: 7}")
    with pytest.raises(InputError, match="has a feature sift already: rename .*sift.yaml"):
        hloc_reduce.register([tmp_path / "sift.yaml"])


def test_a_missing_hloc_is_named(monkeypatch, forgotten):
    for module in ("utils.hloc", "extractors"):
        monkeypatch.setattr(f"hloc_reduce.{module}.is_installed", lambda: False)
    with pytest.raises(InputError, match="hloc is not installed: pip install"):
        hloc_reduce.register()
    with pytest.raises(InputError, match="Unknown extractor 'disk'.*need hloc to be installed"):
        extractors.load({"name": "disk"})
    with pytest.raises(InputError, match="hloc is not installed"):
        extractors.load({"name": "hloc.dog"})


@pytest.mark.parametrize(
    "init",
    ['__version__ = "1.4"', '__version__ = "1.5"', INIT.replace("3.13.0", "3.12.6")],
)
def test_an_old_hloc_is_refused(double, init):
    (double / "__init__.py").write_text(init)
    with pytest.raises(InputError, match="too old.*--upgrade"):
        hloc_reduce.register()


@pytest.mark.parametrize("init", ['__version__ = "1.6"', INIT.replace("3.13.0", "4.2.2")])
def test_a_newer_hloc_is_taken(double, init):
    (double / "__init__.py").write_text(init)
    assert "sift_sv64" in hloc_reduce.register()


@pytest.mark.parametrize(("version", "warned"), [("4.2.1", True), ("4.2.0", False), ("dev", True)])
def test_a_pycolmap_without_points_is_warned_of_once(double, version, warned, monkeypatch, caplog):
    monkeypatch.setattr(cli.logger, "propagate", True)
    caplog.clear()
    monkeypatch.setattr(pycolmap, "__version__", version)
    hloc_reduce.register()
    hloc_reduce.register()
    warnings = [record for record in caplog.records if record.levelname == "WARNING"]
    assert len(warnings) == warned
    assert all("\n" not in record.getMessage() for record in warnings)


def test_modules_run_with_the_confs(double, monkeypatch, capsys):
    run(monkeypatch, plugin, "extract_features", "--conf", "sift_sv64")
    assert capsys.readouterr().out == "feats-dog-sift_sv64\n"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("extract", "hloc.extract cannot be imported"),
        ("broken", "hloc.broken cannot be imported .*not_there"),
        ("match_features", "hloc.match_features has no command line"),
        ("extractors", "hloc.extractors has no command line"),
    ],
)
def test_what_cannot_run_is_one_clear_line(double, name, message, monkeypatch, caplog):
    assert re.search(message, refused(monkeypatch, caplog, plugin, name))


def test_an_extractor_of_hlocs_is_a_base(double, tmp_path):
    model = extractors.load({"name": "reduced", "base": {"name": "dots", "number": 3}})
    assert model.detection_noise == 2 and model.base.descriptor == "hloc.dots"
    found = model({"image": torch.rand(1, 3, 40, 40)})
    assert found["keypoints"].shape == (1, 3, 2) and found["scores"].shape == (1, 3)
    torch.testing.assert_close(found["descriptors"], torch.eye(256)[None, :, :3])
    with pytest.raises(InputError, match="for sift, not for hloc.dots"):
        extractors.load({"name": "reduced", "base": {"name": "dots"}, "projection": "sift_sv16"})
    with pytest.raises(InputError, match="hloc's extractor dots fails .*grayscale"):
        model({"image": torch.rand(1, 1, 40, 40)})
    with pytest.raises(InputError, match="Unknown extractor 'dosts'. There are: dots"):
        extractors.load({"name": "dosts"})


def test_descriptors_that_are_not_on_the_device_of_the_image(double):
    """As those of hloc's dog are not, which describes on the CPU."""
    model = extractors.load({"name": "dots"})
    found = model({"image": torch.empty(1, 3, 40, 40, device="meta")})
    assert found["descriptors"].device.type == "meta"


def test_what_determines_descriptors_is_in_their_name(double):
    model = extractors.load({"name": "dots", "weights": "indoor"})
    assert model.descriptor == "hloc.dots.indoor"


def test_projections_of_other_dimensions_are_refused_with_both(double, tmp_path):
    file = tmp_path / "p.safetensors"
    network.save(network.MLP((128, 16)).eval(), {}, file)
    conf = {"name": "reduced", "base": {"name": "dots"}, "projection": str(file)}
    with pytest.raises(InputError, match="for 128-D .* have 256"):
        extractors.load(conf)({"image": torch.rand(1, 3, 40, 40)})


def test_a_base_of_hlocs_is_trained_on(double, tmp_path, monkeypatch, caplog):
    """The command line: the name of the file, the dimensions, and what the metadata say."""
    (tmp_path / "mine.yaml").write_text(
        "model: {name: dots, number: 3}\npreprocessing: {grayscale: false}"
    )
    maps = tmp_path / "town/images", tmp_path / "town/sparse"
    for folder in maps:
        folder.mkdir(parents=True)
    found = np.random.default_rng(0).standard_normal((90, 2, 2, 256)).astype(np.float16)
    columns = np.arange(90) // 3, np.arange(90), np.zeros((90, 2), np.float32), np.ones(90, bool)
    asked = []
    monkeypatch.setattr(tracks, "main", lambda *given: asked.append(given) or tmp_path / "t")
    monkeypatch.setattr(tracks, "load", lambda _: tracks.Tracks(found, *columns))
    (tmp_path / "t").touch()
    arguments = "--base", tmp_path / "mine.yaml", "--scheme", "pca", "--output", tmp_path
    arguments = *arguments, "--map", ":".join(map(str, maps))
    run(monkeypatch, training, *arguments, "--dim", 16)
    assert asked[0][3] == "mine" and asked[0][-1]["preprocessing"]["grayscale"] is False
    file = tmp_path / "mine_pca16.safetensors"
    projection = projections.load(file)
    assert projection.sizes == (256, 16)
    assert projection.metadata["descriptor"] == "hloc.dots"
    assert projection.metadata["base"]["model"] == {"name": "dots", "number": 3}
    _, conf = features.get(str(tmp_path / "mine.yaml"), file)
    reduced = extractors.load(conf["model"])({"image": torch.rand(1, 3, 40, 40)})
    assert reduced["descriptors"].shape == (1, 16, 3)
    with pytest.raises(InputError, match="for hloc.dots, not for sift"):
        extractors.load({**conf["model"], "base": features.base("sift")})
    message = refused(monkeypatch, caplog, training, *arguments, "--dim", 300)
    assert "mine descriptors are 256-D: --dim 300 is too large" in message
    message = refused(monkeypatch, caplog, training, *arguments, "--phototour", tmp_path)
    assert "not the patches of PhotoTour" in message


def test_global_descriptors_of_hloc_serve_retrieval(double):
    conf = retrieval_confs.confs["netvlad"]
    assert conf["output"] == "global-feats-netvlad"  # as hloc's
    model = retrieval.load(conf["model"])
    assert model.needs_image and not model.learns
    image = np.zeros((30, 40, 3), np.float32)
    image[..., 1] = 0.5
    np.testing.assert_allclose(model.describe({"image": image}), [0, 1, 0])
    with pytest.raises(InputError, match="hloc's extractor netvlad fails .AssertionError"):
        model.describe({"image": image[..., 0]})
    with pytest.raises(
        InputError, match="Unknown extractor 'eigenplaces'. There are: netvlad, dots"
    ):
        retrieval.load(retrieval_confs.confs["eigenplaces"]["model"])
    local = retrieval.load({"name": "hloc", "conf": {"name": "dots"}})
    with pytest.raises(InputError, match="dots gives no global descriptor"):
        local.describe({"image": image})


def test_retrieval_of_a_missing_hloc_fails_at_once(aachen_layout, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("hloc_reduce.utils.hloc.is_installed", lambda: False)
    given = ("--dataset", aachen_layout, "--outputs", tmp_path / "o", "--retrieval", "megaloc")
    assert "hloc is not installed: pip" in refused(monkeypatch, caplog, aachen, *given)
    assert not (tmp_path / "o").exists()


def test_keypoints_of_hlocs_extractors_are_masked(double):
    model = extractors.load({"name": "dots", "number": 3})  # at (0, 1), (2, 3) and (4, 5)
    mask = np.ones((40, 40), bool)
    mask[3, 2] = False
    photo = np.zeros((40, 40, 3), np.uint8)
    found = extractors.extract(model, photo, {}, mask=mask)
    assert found["keypoints"].tolist() == [[0, 1], [4, 5]] and found["scores"].shape == (2,)
    np.testing.assert_allclose(found["descriptors"], np.eye(256)[:, [0, 2]])
