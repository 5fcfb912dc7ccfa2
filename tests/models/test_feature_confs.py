"""Features by name and by YAML file, and what they make of patches."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

import hloc_reduce
from hloc_reduce import extract_features, extractors, projections
from hloc_reduce.confs import features
from hloc_reduce.confs.features import confs
from hloc_reduce.utils.cli import InputError


def test_the_papers_68_features_have_names():
    bases = [name.partition("_")[0] for name in confs if "nested" not in name]
    paper = [base for base in bases if base in ("sift", "mkd", "tfeat", "hardnet")]
    assert len(paper) == 68
    for name in ("hardnet_us24", "tfeat_ss16", "mkd_pca32", "mkd", "mkd_nested@32"):
        assert confs[name]["output"] == f"feats-dog-{name}"


def test_features_of_a_file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(
        "model: {name: reduced, base: {name: dog, descriptor: sift}, projection: sift_sv16}\n"
        "preprocessing: {resize_max: 800}\n"
    )
    name, conf = features.get(str(path))
    assert name == "mine" and conf["output"] == "feats-mine"
    assert conf["model"]["projection"] == "sift_sv16"
    assert conf["preprocessing"] == {"grayscale": True, "resize_max": 800}
    with pytest.raises(InputError, match="cannot be read"):
        features.get(str(tmp_path / "absent.yaml"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("model: [", "cannot be read"),
        ("- 1", "no model"),
        ("model: dog", "no model"),
        ("model: {name: reduced, base: dog}", "no model"),
        ("model: {name: dog}\ncolour: 1", "unknown keys colour"),
        ("model: {name: dog}\npreprocessing: {resize: 9}", "unknown keys resize"),
        ("model: {name: dog}\npreprocessing: 5", "cannot be 5"),
        ("model: {name: dog}\npreprocessing: {resize_max: big}", "resize_max is"),
    ],
)
def test_a_wrong_feature_file_is_refused(content, message, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(content)
    with pytest.raises(InputError, match=message):
        features.get(str(path))


def test_another_projection_of_a_feature():
    name, conf = features.get("hardnet_sv64", Path("copies/mine.pth"))
    assert name == "mine" and conf["output"] == "feats-dog-mine"
    assert conf["model"] == {
        "name": "reduced",
        "base": features.base("hardnet"),
        "projection": "copies/mine.pth",
    }
    assert features.get("sift", Path("mine.pth"))[1]["model"]["base"] == features.base("sift")


def test_a_feature_is_called_after_file_and_prefix(tmp_path):
    name, conf = features.get("sift", f"{tmp_path}/mine.safetensors@24")
    assert name == "mine@24" and conf["output"] == "feats-dog-mine@24"
    assert conf["model"]["projection"] == f"{tmp_path}/mine.safetensors@24"


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ({"name": "dgo"}, "Unknown extractor 'dgo'"),
        ({"name": 5}, "Unknown extractor '5'"),
        ({"name": "dog", "max_keypoints": "many"}, "max_keypoints cannot be 'many'"),
        ({"name": "dog", "options": [1]}, "options cannot be"),
        ({"name": "dog", "descriptor": ["sift"]}, "descriptor cannot be"),
        ({"name": "dog", "descriptor": "sfit"}, "Unknown descriptor 'sfit'"),
        ({"name": "dog", "options": {"threshold": 1}}, "The DoG options"),
        ({"name": "dog", "options": {"peak_threshold": "low"}}, "The DoG options"),
        ({"name": "vlad"}, "Unknown extractor 'vlad'"),
        ({"name": "hloc"}, "needs the name of one of hloc's|hloc is not installed"),
    ],
)
def test_a_wrong_model_is_one_clear_error(model, message):
    with pytest.raises(InputError, match=message):
        extractors.load(model)({"image": torch.rand(1, 1, 64, 64)})


def test_a_feature_file_chooses_settings_of_dog(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("model: {name: dog, descriptor: sift}")
    adaptive = features.get(str(path))[1]
    assert adaptive["model"]["keypoints"] == "adaptive"
    hloc = features.get(str(path), keypoints="hloc")[1]
    assert hloc["model"]["keypoints"] == "hloc"
    made_from = [json.dumps(extract_features.provenance(conf)) for conf in (adaptive, hloc)]
    assert made_from[0] != made_from[1]
    path.write_text("model: {name: dog, descriptor: sift, keypoints: hloc}")
    assert features.get(str(path))[1]["model"]["keypoints"] == "hloc"


def test_settings_of_dog_reach_the_base_of_a_projection():
    model = features.get("sift_sv64", keypoints="hloc")[1]["model"]
    assert model["base"]["keypoints"] == "hloc"
    assert features.confs["sift_sv64"]["model"]["base"]["keypoints"] == "adaptive"


@pytest.mark.parametrize("feature", ["mini32", "xfeat_sv32", "edgepoint2_t32"])
def test_features_of_networks_have_no_settings_of_dog(feature):
    for keypoints in ("fast", "hloc"):
        message = f"--keypoints {keypoints} is for DoG keypoints, and {feature} finds its own"
        with pytest.raises(InputError, match=message):
            features.get(feature, keypoints=keypoints)
    assert features.get(feature, keypoints="adaptive") == features.get(feature)


OF_PATCHES = [
    name
    for name in confs
    if confs[name]["model"].get("projection") in projections.names()
    and features.descriptor_of(confs[name]["model"]) not in (None, features.COLMAP_SIFT)
]


@pytest.mark.parametrize("feature", ["sift", *OF_PATCHES])
def test_every_feature_describes_patches(feature, base_weights):
    base_weights(features.of_patches(feature)[0])
    torch.manual_seed(0)
    patches = torch.rand(200, 1, 32, 32)
    descriptors = hloc_reduce.describe_patches(patches, feature)
    dim = int(re.search(r"\d*$", feature)[0] or 64) if "_" in feature else 128
    assert descriptors.shape == (200, dim) and descriptors.dtype == torch.float32
    np.testing.assert_allclose(descriptors.norm(dim=1), 1, atol=1e-5)
    # patches are described one by one: batches and their order do not matter
    again = hloc_reduce.describe_patches(patches[[150, 3]], feature)
    torch.testing.assert_close(again, descriptors[[150, 3]], atol=1e-5, rtol=1e-4)


def test_patches_are_rounded_as_a_storage_would():
    """The fewer bits, the farther from the floats."""
    patches = torch.rand(200, 1, 32, 32, generator=torch.Generator().manual_seed(0))
    exact = hloc_reduce.describe_patches(patches, "sift_sv32")
    cosines = []
    for storage in ("uint8", "uint4", "uint2", "uint1"):
        rounded = hloc_reduce.describe_patches(patches, "sift_sv32", storage=storage)
        assert rounded.shape == (200, 32) and rounded.dtype == torch.float32
        np.testing.assert_allclose(rounded.norm(dim=1), 1, atol=1e-5)
        cosines.append(float((rounded * exact).sum(dim=1).mean()))
    assert cosines == sorted(cosines, reverse=True) and cosines[0] > 0.999 and cosines[-1] > 0.5
    with pytest.raises(InputError, match="Unknown storage 'uint3'"):
        hloc_reduce.describe_patches(patches, "sift_sv32", storage="uint3")
    with pytest.raises(InputError, match="sift has no projection, but --storage uint4 needs"):
        hloc_reduce.describe_patches(patches, "sift", storage="uint4")


@pytest.mark.parametrize(
    "patches",
    [
        torch.rand(32, 32),
        torch.rand(5, 1, 64, 64),
        torch.zeros(5, 1, 32, 32).byte(),
        np.zeros((5, 1, 32, 32), np.float32),
    ],
)
def test_other_patches_are_refused(patches):
    with pytest.raises(ValueError, match="float|torch.Tensor"):
        hloc_reduce.describe_patches(patches)


def test_no_patches_and_unknown_features():
    assert hloc_reduce.describe_patches(torch.zeros(0, 1, 32, 32), "sift_sv16").shape == (0, 16)
    for name in ("sift_sv63", "SIFT_sv64"):
        with pytest.raises(InputError, match=rf"feature '{name}'. The nearest of \d+: sift_sv64"):
            hloc_reduce.describe_patches(torch.zeros(0, 1, 32, 32), name)
    with pytest.raises(InputError, match="colmap_sift_sv16 describes photos, not patches"):
        hloc_reduce.describe_patches(torch.zeros(0, 1, 32, 32), "colmap_sift_sv16")
