"""Projections: folding, files, those that ship, those that the paper's authors released."""

import hashlib
import io
from pathlib import Path
from urllib.error import URLError

import numpy as np
import pytest
import torch
from torch import nn

from hloc_reduce import extractors, projections
from hloc_reduce.confs import features
from hloc_reduce.extractors.reduced import Reduced
from hloc_reduce.networks import MINI
from hloc_reduce.projections import network, released
from hloc_reduce.projections.files import WEIGHTS
from hloc_reduce.projections.network import MLP, Projection
from hloc_reduce.utils import downloads
from hloc_reduce.utils.cli import InputError


@pytest.mark.parametrize("name", projections.names())
def test_shipped_projections_say_where_they_come_from(name):
    metadata = projections.load(name).metadata
    scheme, dim = metadata["scheme"], metadata["dim"]
    suffix = {"raw": "", "nested": "_nested"}.get(scheme, f"_{scheme}{dim}")
    assert metadata["descriptor"] + suffix == name
    assert metadata["training_data"] and metadata["versions"] and "seed" in metadata
    assert metadata["recipe"]["name"] in ("best", "paper")
    assert metadata["input"] == "descriptors of unit L2 norm"


@pytest.mark.parametrize("content", [b"", b"garbage" * 100])
def test_a_file_that_is_no_projection_is_refused(content, tmp_path):
    path = tmp_path / "p.safetensors"
    path.write_bytes(content)
    with pytest.raises(InputError, match="not a projection"):
        projections.load(path)


def test_missing_projections_are_refused(tmp_path):
    with pytest.raises(InputError, match="no projection file"):
        projections.load(tmp_path / "absent.safetensors")
    with pytest.raises(InputError, match="There is no projection sift-x"):
        projections.load("sift-x")


def trained(sizes):
    """An MLP with statistics and affine parameters far from the initial ones."""
    torch.manual_seed(0)
    mlp = MLP(sizes).train()
    for _ in range(20):
        mlp(torch.randn(64, sizes[0]) + 0.3)
    for norm in mlp.norms:
        torch.nn.init.normal_(norm.weight)
        torch.nn.init.normal_(norm.bias)
    return mlp.eval()


@pytest.mark.parametrize("sizes", [(128, 512, 512, 64), (128, 96, 24), (128, 16)])
def test_folding_changes_nothing(sizes):
    mlp, descriptors = trained(sizes), torch.randn(50, 128)
    projection = Projection(mlp)
    torch.testing.assert_close(projection(descriptors), mlp(descriptors), atol=1e-5, rtol=1e-4)
    assert len(projection.linears) == len(sizes) - 1 and projection.dim == sizes[-1]


def test_saved_and_loaded(tmp_path):
    mlp, descriptors = trained((128, 32, 32, 16)), torch.randn(50, 128)
    path = tmp_path / "p.safetensors"
    network.save(mlp, {"descriptor": "sift", "dim": 16, "seed": 0}, path)
    loaded = projections.load(path)
    assert loaded.metadata == {
        "descriptor": "sift",
        "dim": 16,
        "seed": 0,
        "layers": [128, 32, 32, 16],
    }
    assert (loaded(descriptors) * mlp(descriptors)).sum(1).min() > 0.9999  # float16 weights
    assert not any(parameter.requires_grad for parameter in loaded.parameters())


def test_everything_ships_in_25_megabytes():
    expected = {
        name
        for descriptor in (
            "sift",
            "mkd",
            "tfeat",
            "colmap_sift",
            "xfeat",
            "edgepoint2_m64",
            "aliked",
        )
        for name in features.names(descriptor)
        if "@" not in name
    }
    expected |= {"xfeat", "edgepoint2_m32", "edgepoint2_m64", "aliked", *MINI}  # levels
    assert set(projections.names()) == expected and len(expected) == 95
    assert sum(path.stat().st_size for path in WEIGHTS.iterdir()) < 25e6


def test_what_does_not_ship_says_how_to_train_it():
    with pytest.raises(InputError, match="--descriptor hardnet --scheme us --dim 24 --map"):
        projections.load("hardnet_us24")
    with pytest.raises(InputError, match="--descriptor hardnet --scheme nested --map"):
        projections.load("hardnet_nested@24")
    with pytest.raises(InputError, match="weights/hardnet_nested.safetensors@24"):
        projections.load("hardnet_nested@24")
    for name, said in {
        "edgepoint2_m64_us32": "--descriptor edgepoint2_m64 --scheme us --dim 32",
        "colmap_sift_nested": "--descriptor colmap_sift --scheme nested",
        "sitf_sv64": "There is no projection sitf_sv64",
        "sitf": "There is no projection sitf",
    }.items():
        with pytest.raises(InputError, match=said):
            projections.load(name)


def test_the_first_numbers_of_a_nested_projection(tmp_path):
    mlp = trained((128, 32, 24))
    network.save(mlp, {"scheme": "nested"}, tmp_path / "p.safetensors")
    whole = projections.load(tmp_path / "p.safetensors")
    first = projections.load(f"{tmp_path / 'p.safetensors'}@8")
    descriptors = torch.rand(10, 128)
    expected = torch.nn.functional.normalize(whole(descriptors)[:, :8], dim=1)
    torch.testing.assert_close(first(descriptors), expected)
    assert first.dim == 8 and first.sizes == (128, 32, 8)
    for prefix in ("25", "0", "x"):
        with pytest.raises(InputError, match="first"):
            projections.load(f"{tmp_path / 'p.safetensors'}@{prefix}")
    network.save(mlp, {"scheme": "sv"}, tmp_path / "p.safetensors")
    with pytest.raises(InputError, match="not nested"):
        projections.load(f"{tmp_path / 'p.safetensors'}@8")


def test_a_path_may_have_an_at_sign(tmp_path):
    path = tmp_path / "me@home" / "a@b.safetensors"
    path.parent.mkdir()
    network.save(trained((128, 16)), {"scheme": "nested"}, path)
    assert projections.load(path).dim == 16 and projections.load(f"{path}@8").dim == 8
    assert projections.checksum(path) == projections.checksum(f"{path}@8")


def test_projection_of_other_descriptors_is_refused(tmp_path, textured):
    network.save(trained((256, 16)), {}, tmp_path / "p.safetensors")
    conf = {"name": "reduced", "projection": str(tmp_path / "p.safetensors")}
    image = torch.from_numpy(textured / np.float32(255))[None, None]
    with pytest.raises(InputError, match="for 256-D .* have 128"):
        extractors.load(conf)({"image": image})


def test_a_projection_of_another_descriptor_is_refused(base_weights):
    base_weights("mkd")
    with pytest.raises(InputError, match="is for sift, not for mkd"):
        Reduced({"base": {"name": "dog", "descriptor": "mkd"}, "projection": "sift_sv16"})


SHARED = Path(__file__).parents[3] / "shared"


def released_state(sizes):
    """A network as the authors' code saves it."""
    layers = []
    for before, after in zip(sizes[:-2], sizes[1:-1], strict=True):
        layers += [nn.Linear(before, after), nn.ReLU(), nn.BatchNorm1d(after)]
    network = nn.Sequential(*layers, nn.Linear(*sizes[-2:]))
    for _ in range(20):
        network(torch.rand(50, sizes[0]))
    return nn.Sequential(network.eval())


def test_released_networks_are_read(tmp_path):
    network = released_state((128, 96, 24))
    torch.save(network.state_dict(), tmp_path / "HardNet_sv_dim24.pth")
    project = projections.load(tmp_path / "HardNet_sv_dim24.pth")
    assert project.sizes == (128, 96, 24)
    descriptors = torch.rand(10, 128)
    with torch.no_grad():
        expected = nn.functional.normalize(network(descriptors), dim=1)
    torch.testing.assert_close(project(descriptors), expected, atol=1e-5, rtol=1e-4)


def test_released_networks_are_downloaded_once_and_checked(tmp_path, monkeypatch):
    buffer = io.BytesIO()
    torch.save(released_state((128, 96, 24)).state_dict(), buffer)
    content, asked = buffer.getvalue(), []
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(
        downloads, "urlopen", lambda url, timeout: asked.append(url) or io.BytesIO(content)
    )
    with pytest.raises(InputError, match="HardNet_sv_dim24.pth: .* does not have the sha256"):
        projections.load("hardnet_sv24")
    assert not list(tmp_path.rglob("*.pth"))
    known = ("HardNet_sv_dim24.pth", hashlib.sha256(content).hexdigest())
    monkeypatch.setitem(released.WEIGHT_FILES, "hardnet_sv24", known)
    for _ in range(2):
        assert projections.load("hardnet_sv24").sizes == (128, 96, 24)
    assert asked == [f"{released.URL}/HardNet_sv_dim24.pth"] * 2

    def unreachable(url, timeout):
        raise URLError("no network")

    monkeypatch.setattr(downloads, "urlopen", unreachable)
    with pytest.raises(InputError, match="hardnet_sv64 are missing.*no network.*checkpoints"):
        projections.load("hardnet_sv64")


@pytest.mark.parametrize("name", released.WEIGHT_FILES)
def test_the_real_released_networks(name):
    file, sha256 = released.WEIGHT_FILES[name]
    path = SHARED / "released_projections" / file
    if not path.is_file():
        pytest.skip(f"{path} is not on this machine")
    assert hashlib.sha256(path.read_bytes()).hexdigest() == sha256
    project = projections.load(path)
    assert project.sizes == (128, 96, int(name.removeprefix("hardnet_sv")))
    generator = torch.Generator().manual_seed(0)
    descriptors = nn.functional.normalize(torch.randn(100, 128, generator=generator), dim=1)
    np.testing.assert_allclose(project(descriptors).norm(dim=1), 1, atol=1e-5)


@pytest.mark.parametrize("dim", [64, 32, 24, 16])
def test_the_authors_sift_models(dim):
    path = SHARED / f"released_projections/SIFT_sv_dim{dim}.pth"
    if not path.is_file():
        pytest.skip(f"{path} is not on this machine")
    projection = projections.load(path)
    assert projection.sizes == (128, 512, 512, dim)
    descriptors = torch.nn.functional.normalize(torch.rand(10, 128), dim=1)
    torch.testing.assert_close(projection(descriptors).norm(dim=1), torch.ones(10))
