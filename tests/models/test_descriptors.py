"""Base descriptors, and the download of their weights."""

import hashlib
import io
import pickle
import sys
from dataclasses import replace
from urllib.error import URLError

import cv2
import kornia
import numpy as np
import pytest
import torch
from hostile import Harm

from hloc_reduce import descriptors, extract_features, extractors
from hloc_reduce.confs import features
from hloc_reduce.descriptors import COLMAP_SIFT, DESCRIPTORS, Base
from hloc_reduce.descriptors.model import Descriptor
from hloc_reduce.extract_features import provenance
from hloc_reduce.training import __main__ as training
from hloc_reduce.training import tracks
from hloc_reduce.utils import downloads
from hloc_reduce.utils.cli import InputError


@pytest.mark.parametrize("name", DESCRIPTORS)
def test_descriptors_are_of_unit_norm_and_do_not_depend_on_the_batch(name, base_weights):
    base_weights(name)
    describe = Descriptor(name)
    patches = torch.rand(150, 1, 32, 32, generator=torch.Generator().manual_seed(0))
    described = describe(patches)
    assert described.shape == (150, 128) and described.dtype == torch.float32
    torch.testing.assert_close(described.norm(dim=1), torch.ones(150))
    torch.testing.assert_close(describe(patches[140:141]), described[140:141])
    assert describe(patches[:0]).shape == (0, 128)


def test_a_module_of_another_dimension_is_refused(monkeypatch):
    """Its features were written, and found to be wrong by their readers only."""
    monkeypatch.setitem(DESCRIPTORS, "small", Base(lambda: torch.nn.Flatten()))
    with pytest.raises(ValueError, match=r"small returned \(3, 1024\) instead of \(N, 128\)"):
        Descriptor("small")(torch.rand(3, 1, 32, 32))


@pytest.mark.parametrize(
    ("name", "module"),
    [
        ("sift", lambda: kornia.feature.SIFTDescriptor(32, 8, 4, rootsift=False)),
        ("mkd", kornia.feature.MKDDescriptor),
        ("tfeat", lambda: kornia.feature.TFeat(True)),
    ],
)
def test_descriptors_are_kornias(name, module, base_weights):
    base_weights(name)
    describe = Descriptor(name)
    patches = torch.rand(7, 1, 32, 32, generator=torch.Generator().manual_seed(0))
    patches[5] = 0.5  # flat
    patches[6] = torch.linspace(0, 1, 32)  # a ramp: one orientation, that of bin 0
    with torch.no_grad():
        expected = torch.nn.functional.normalize(module().eval()(patches), dim=1)
    torch.testing.assert_close(describe(patches), expected)


def test_hardnet_without_its_weights(monkeypatch):
    """The network is kornia's; its weights are not needed to try the rest."""
    base = descriptors.Base(lambda: kornia.feature.HardNet(pretrained=False))
    monkeypatch.setitem(DESCRIPTORS, "hardnet", base)
    torch.manual_seed(0)
    described = Descriptor("hardnet")(torch.rand(10, 1, 32, 32))
    assert described.shape == (10, 128)
    torch.testing.assert_close(described.norm(dim=1), torch.ones(10))


def test_missing_weights_are_named_at_once(tmp_path, monkeypatch):
    asked = []

    def unreachable(url, timeout):
        asked.append((url, timeout))
        raise URLError("no network")

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(downloads, "urlopen", unreachable)
    with pytest.raises(InputError, match="no network"):  # before anything is computed or written
        provenance(features.confs["tfeat"], True)
    asked.clear()
    with pytest.raises(InputError) as error:
        Descriptor("tfeat")
    message = str(error.value)
    assert "no network" in message and "kornia/tfeat/resolve/main/tfeat-liberty.params" in message
    assert str(tmp_path / "hub/checkpoints/tfeat-liberty.params") in message
    assert len(asked) == 2 and sum(timeout for _, timeout in asked) <= 10


def test_weights_are_downloaded_once_and_checked(tmp_path, monkeypatch):
    mirror, source = DESCRIPTORS["tfeat"].urls
    weights, other = io.BytesIO(), pickle.dumps(Harm(tmp_path / "harmed"))
    torch.save(kornia.feature.TFeat(pretrained=False).state_dict(), weights)
    weights = weights.getvalue()
    base = replace(DESCRIPTORS["tfeat"], sha256=hashlib.sha256(weights).hexdigest())
    monkeypatch.setitem(DESCRIPTORS, "tfeat", base)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    path, sent, asked = tmp_path / "hub/checkpoints/tfeat-liberty.params", {}, []

    def urlopen(url, timeout):
        asked.append(url)
        return io.BytesIO(sent[url])

    monkeypatch.setattr(downloads, "urlopen", urlopen)
    sent = {mirror: other, source: other[:9]}
    with pytest.raises(InputError, match="resolve/main/tfeat.*not have the sha256.*raw/master"):
        Descriptor("tfeat")
    assert not path.exists()
    sent[source] = weights
    for _ in range(2):
        assert Descriptor("tfeat")(torch.rand(2, 1, 32, 32)).shape == (2, 128)
    assert asked == [mirror, source] * 2 and path.read_bytes() == weights
    for broken in (other, weights[:-1], b""):
        path.write_bytes(broken)
        with pytest.raises(InputError, match="tfeat-liberty.params, are broken"):
            Descriptor("tfeat")
    assert not (tmp_path / "harmed").exists()


@pytest.mark.parametrize("name", ["mkd", "tfeat", "hardnet"])
def test_kornia_looks_for_the_same_files(name):
    """The addresses are kornia's own, so that what is found is what kornia loads."""
    module = {"mkd": kornia.feature.mkd, "tfeat": kornia.feature.tfeat}.get(
        name, kornia.feature.hardnet
    )
    listed = [[urls] if isinstance(urls, str) else urls for urls in module.urls.values()]
    assert list(DESCRIPTORS[name].urls) in listed


PATCHES = set(DESCRIPTORS)


PHOTOS = {*DESCRIPTORS, COLMAP_SIFT}


def command_line(*arguments):
    """Return what runs a training."""

    def run(tmp_path, monkeypatch):
        given = ["training", "--descriptor", "sfit", *arguments]
        monkeypatch.setattr(sys, "argv", [str(part).format(tmp_path) for part in given])
        training._main()

    return run


def of_file(read):
    """Return what reads a YAML file of a feature of an unknown descriptor."""

    def run(tmp_path, monkeypatch):
        (tmp_path / "mine.yaml").write_text("model: {name: dog, descriptor: sfit}")
        return read(tmp_path / "mine.yaml", tmp_path)

    return run


@pytest.mark.parametrize(
    "act, valid",
    [
        (lambda *_: Descriptor("sfit"), PATCHES),
        (lambda *_: extractors.load(features.base("sfit")), PHOTOS),
        (
            lambda *_: extractors.load(
                {"name": "reduced", "base": features.base("sfit"), "projection": "sift_sv64"}
            ),
            PHOTOS,
        ),
        (
            of_file(
                lambda path, folder: extract_features.main(
                    features.get(path)[1], folder / "images", folder
                )
            ),
            PHOTOS,
        ),
        (of_file(lambda path, _: features.of_patches(path)), PATCHES),
        (command_line("--phototour", "{0}"), PATCHES),
        (command_line("--map", "{0}/images:{0}", "--validate", "{0}"), PATCHES),
    ],
)
def test_an_unknown_descriptor_is_answered_by_all_that_are_valid(act, valid, tmp_path, monkeypatch):
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images/a.png"), np.zeros((40, 40), np.uint8))
    with pytest.raises(InputError, match="Unknown descriptor 'sfit'. There are: ") as error:
        act(tmp_path, monkeypatch)
    assert set(str(error.value).partition("There are: ")[2].rstrip(".").split(", ")) == valid


@pytest.mark.parametrize(
    "act",
    [
        command_line("--map", "{0}/images:{0}"),
        lambda path, _: tracks.main(path / "images", path, path / "out", "sfit"),
    ],
)
def test_an_unknown_base_is_answered_by_all(act, tmp_path, monkeypatch):
    (tmp_path / "images").mkdir()
    with pytest.raises(InputError, match=r"Unknown descriptor 'sfit'. There are: sift, ") as error:
        act(tmp_path, monkeypatch)
    assert set(str(error.value).rstrip(".").partition(": ")[2].split(", ")) == set(features.BASES)
