"""Hostile weights and confs are refused, and no code in them is run."""

import pickle
from contextlib import suppress

import numpy as np
import pytest
import torch
from hostile import Harm, check_text, fuzzed, refuses_or_reads
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import load, save_file

from hloc_reduce import projections
from hloc_reduce.confs import features as features_confs
from hloc_reduce.extract_features import provenance
from hloc_reduce.projections import network
from hloc_reduce.retrieval.vlad import read_vocabulary
from hloc_reduce.utils.cli import InputError


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Files of weights, one of each kind, and what reads them."""
    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    mlp = network.MLP((8, 6, 4))
    network.save(mlp, {"descriptor": "sift", "scheme": "sv"}, folder / "p.safetensors")
    state = {f"module.{key}": value for key, value in mlp.state_dict().items()}
    torch.save(state, folder / "p.pth")
    save_file({"vocabulary": torch.randn(4, 8)}, folder / "v.safetensors")
    kinds = {
        "p.safetensors": projections.load,
        "p.pth": projections.load,
        "v.safetensors": read_vocabulary,
    }
    return {name: ((folder / name).read_bytes(), read) for name, read in kinds.items()}


@pytest.mark.parametrize("name", ["p.safetensors", "p.pth", "v.safetensors"])
@fuzzed
@given(data=st.data())
def test_damaged_weights_are_read_or_refused(name, weights, tmp_path, data):
    content, read = weights[name]
    path = tmp_path / name
    path.write_bytes(content)
    read(path)
    start = data.draw(st.integers(0, len(content) - 1) | st.integers(0, 300))
    piece = data.draw(st.binary(max_size=9))
    end = data.draw(st.sampled_from([start, start + len(piece), len(content)]))
    path.write_bytes(content[:start] + piece + content[end:])
    refuses_or_reads(read, path)


METADATA = [
    '"[8, 6, 4]"',
    "8",
    "null",
    "[]",
    "[8]",
    "[8, 4]",
    "[8, 6, 6, 4]",
    "[8, -6, 4]",
    "[8, .5, 4]",
    "[8, 1000000000000, 4]",
    "[8, 3000000000, 4]",
    "[[8], 6, 4]",
    '["8", 6, 4]',
    "[8, null, 4]",
    "[true, 6, 4]",
    '{"8": 6}',
    "NaN",
    "[8, Infinity, 4]",
    "[8, 6, 4",
    "",
    "[" * 10**5,
]


@pytest.mark.parametrize("layers", [*METADATA, None])
def test_projections_of_other_layers_than_they_say_are_refused(layers, weights, tmp_path):
    path = tmp_path / "p.safetensors"
    tensors = load(weights[path.name][0])
    save_file(tensors, path, {} if layers is None else {"layers": layers})
    with pytest.raises(InputError, match="p.safetensors is not a projection"):
        projections.load(path)


def test_projections_whose_tensors_are_wrong_are_refused(weights, tmp_path):
    path = tmp_path / "p.safetensors"
    sound = load(weights[path.name][0])
    for key, tensor in sound.items():
        numbers = [torch.full_like(tensor, value) for value in (torch.nan, -torch.inf)]
        shapes = [tensor[:-1], tensor[None], tensor.flatten()[:1], torch.zeros(0)]
        for wrong in [None, *shapes, *numbers]:
            tensors = {**sound, key: wrong}
            if wrong is None:
                del tensors[key]
            save_file(tensors, path, {"layers": "[8, 6, 4]"})
            with pytest.raises(InputError, match="p.safetensors is not a projection"):
                projections.load(path)
    negative = {**sound, "norms.0.running_var": -torch.ones(6)}
    save_file(negative, path, {"layers": "[8, 6, 4]"})
    with pytest.raises(InputError, match="not a projection"):
        projections.load(path)


def test_projections_with_other_tensors_are_refused(weights, tmp_path):
    path = tmp_path / "p.safetensors"
    tensors = load(weights[path.name][0])
    save_file({**tensors, "x": torch.zeros(1)}, path, {"layers": "[8, 6, 4]"})
    with pytest.raises(InputError, match="unknown"):
        projections.load(path)


@pytest.mark.parametrize("content", [{"a": 1}, {}, [torch.zeros(2)], b"nothing"])
def test_a_pickle_that_is_no_network_is_refused(content, tmp_path):
    path = tmp_path / "p.pth"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    with pytest.raises(InputError, match="not a projection"):
        projections.load(path)


@pytest.mark.parametrize("shape", [(4,), (0, 8), (1, 2, 3), (2, 2)])  # the last is of NaN
def test_what_is_no_vocabulary_is_refused(shape, tmp_path):
    path = tmp_path / "v.safetensors"
    save_file({"vocabulary": torch.full(shape, np.nan if shape == (2, 2) else 1)}, path)
    with pytest.raises(InputError, match="v.safetensors is not a vocabulary"):
        read_vocabulary(path)
    save_file({"words": torch.zeros(2, 2)}, path)
    with pytest.raises(InputError, match="v.safetensors is not a vocabulary"):
        read_vocabulary(path)


@pytest.mark.parametrize("protocol", [0, 2, 4])
@pytest.mark.parametrize("zipped", [True, False])
def test_no_code_in_weights_is_run(protocol, zipped, tmp_path):
    harmed = tmp_path / "harmed"
    for name in ("p.pth", "p.safetensors", "v.safetensors"):
        path = tmp_path / name
        options = {"pickle_protocol": protocol, "_use_new_zipfile_serialization": zipped}
        torch.save({"linears.0.weight": Harm(harmed)}, path, **options)
        for content in (path.read_bytes(), pickle.dumps(Harm(harmed), protocol)):
            path.write_bytes(content)
            with pytest.raises(InputError, match=name):
                (read_vocabulary if name[0] == "v" else projections.load)(path)
    assert not harmed.exists()


@pytest.mark.parametrize("tag", ["object/apply:os.mkdir", "object/new:os.mkdir", "name:os.mkdir"])
def test_no_code_in_feature_files_is_run(tag, tmp_path):
    path = tmp_path / "f.yaml"
    path.write_text(f"model: {{name: !!python/{tag} ['{tmp_path / 'harmed'}']}}\n")
    with pytest.raises(InputError, match="f.yaml cannot be read"):
        features_confs.read(path)
    assert not (tmp_path / "harmed").exists()


def read_feature(path):
    conf = features_confs.read(path)
    with suppress(InputError):  # no such projection, for example
        provenance(conf)


def test_yaml_files_of_features_are_read_or_refused(tmp_path):
    lines = [
        "model:",
        "  name: reduced",
        "  base: {name: dog, descriptor: sift}",
        "  projection: sift_sv64",
        "preprocessing: {resize_max: 1000}",
    ]
    check_text(tmp_path / "f.yaml", lines, read_feature)
