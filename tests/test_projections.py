import json

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

import hloc_reduce
from confs.features import confs
from hloc_reduce import projections
from hloc_reduce.cli import InputError
from hloc_reduce.extract_features import load_extractor
from hloc_reduce.projections import MLP, Projection


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
    projections.save(mlp, {"descriptor": "sift", "dim": 16, "seed": 0}, path)
    loaded = projections.load(path)
    assert loaded.metadata == {
        "descriptor": "sift",
        "dim": 16,
        "seed": 0,
        "layers": [128, 32, 32, 16],
    }
    assert (loaded(descriptors) * mlp(descriptors)).sum(1).min() > 0.9999  # float16 weights
    assert not any(parameter.requires_grad for parameter in loaded.parameters())


def test_what_is_no_projection_is_refused(tmp_path):
    path = tmp_path / "p.safetensors"
    for content in (b"", b"garbage" * 100):
        path.write_bytes(content)
        with pytest.raises(InputError, match="not a projection"):
            projections.load(path)
    tensors = {"linears.0.weight": torch.zeros(3, 4), "linears.0.bias": torch.zeros(3)}
    for metadata in ({}, {"layers": "[]"}, {"layers": "[4, 5]"}, {"layers": "{"}):
        save_file(tensors, path, metadata)
        with pytest.raises(InputError, match="not a projection"):
            projections.load(path)
    save_file({**tensors, "x": torch.zeros(1)}, path, {"layers": json.dumps([4, 3])})
    with pytest.raises(InputError, match="unknown"):
        projections.load(path)
    with pytest.raises(InputError, match="no projection file"):
        projections.load(tmp_path / "absent.safetensors")
    with pytest.raises(InputError, match="There are: sift_sv64"):
        projections.load("sift_sv65")


@pytest.mark.parametrize("feature", confs)
def test_every_feature_describes_patches(feature):
    torch.manual_seed(0)
    patches = torch.rand(200, 1, 32, 32)
    descriptors = hloc_reduce.describe_patches(patches, feature)
    dim = int(feature.split("_")[1].lstrip("pcasv")) if "_" in feature else 128
    assert descriptors.shape == (200, dim) and descriptors.dtype == torch.float32
    np.testing.assert_allclose(descriptors.norm(dim=1), 1, atol=1e-5)
    # patches are described one by one: batches and their order do not matter
    again = hloc_reduce.describe_patches(patches[[150, 3]], feature)
    torch.testing.assert_close(again, descriptors[[150, 3]], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", projections.names())
def test_what_ships_says_where_it_comes_from(name):
    metadata = projections.load(name).metadata
    assert f"{metadata['descriptor']}_{metadata['scheme']}{metadata['dim']}" == name
    assert metadata["training_data"] and metadata["versions"] and "seed" in metadata
    assert metadata["recipe"]["name"] in ("best", "paper")


def test_all_features_ship():
    needed = {conf["model"].get("projection") for conf in confs.values()} - {None}
    assert needed == set(projections.names())


@pytest.mark.parametrize(
    "patches", [torch.rand(32, 32), torch.rand(5, 1, 64, 64), torch.zeros(5, 1, 32, 32).byte()]
)
def test_other_patches_are_refused(patches):
    with pytest.raises(ValueError, match="float"):
        hloc_reduce.describe_patches(patches)


def test_no_patches_and_unknown_features():
    assert hloc_reduce.describe_patches(torch.zeros(0, 1, 32, 32), "sift_sv16").shape == (0, 16)
    with pytest.raises(InputError, match="Unknown feature 'sift_sv63'. There are: sift_sv64"):
        hloc_reduce.describe_patches(torch.zeros(0, 1, 32, 32), "sift_sv63")


def test_projection_of_other_descriptors_is_refused(tmp_path, textured):
    projections.save(trained((256, 16)), {}, tmp_path / "p.safetensors")
    conf = {"name": "reduced", "projection": str(tmp_path / "p.safetensors")}
    image = torch.from_numpy(textured / np.float32(255))[None, None]
    with pytest.raises(InputError, match="for 256-D .* have 128"):
        load_extractor(conf)({"image": image})
