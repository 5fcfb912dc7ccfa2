"""Levels of codes: fitted to numbers, kept in the projection, used by features."""

import h5py
import numpy as np
import pytest
import torch
from command import refused
from safetensors.torch import save as serialize

from hloc_reduce import extract_features, match_features, projections, storage
from hloc_reduce.confs import features as features_confs
from hloc_reduce.projections import files as projection_files
from hloc_reduce.projections import network
from hloc_reduce.training import levels, raw
from hloc_reduce.training.tracks import Tracks
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.feature_files import dimension, get_descriptors


def make_tracks(number=2000, dim=128):
    drawn = np.random.default_rng(0).standard_normal((number, 2, 1, dim))
    drawn /= np.linalg.norm(drawn, axis=-1, keepdims=True)
    track = np.arange(number) // 2
    xy = np.zeros((number, 2), np.float32)
    return Tracks(drawn.astype(np.float16), track, track % 5, xy, np.ones(number, bool))


@pytest.fixture
def projection(tmp_path):
    """A projection to 16 numbers with levels."""
    torch.manual_seed(0)
    mlp, metadata = network.MLP([128, 16]).eval(), {"descriptor": "sift", "scheme": "sv", "dim": 16}
    path = tmp_path / "mine_sv16.safetensors"
    network.save(mlp, metadata, path, levels.of_projection(mlp, metadata, [make_tracks()]))
    return path


def test_levels_of_a_normal_distribution():
    """Max (1960) lists them."""
    numbers = torch.randn(100_000, 2, generator=torch.Generator().manual_seed(0))
    found = levels.fit(numbers, 2)
    expected = torch.tensor([-1.510, -0.4528, 0.4528, 1.510]).expand(2, 4)
    torch.testing.assert_close(found, expected, atol=0.02, rtol=0)
    assert torch.equal(levels.fit(torch.ones(10, 1), 1), torch.ones(1, 2))


def test_a_projection_keeps_its_levels(projection):
    for kind, number in (("uint4", 16), ("uint2", 4), ("uint1", 2)):
        found = projections.levels(projection, kind)
        assert found.shape == (16, number) and (np.diff(found) > 0).all()
    assert projections.load(projection).dim == 16


def test_prefixes_have_levels_of_their_own(tmp_path):
    mlp, metadata = network.MLP([128, 64]).eval(), {"descriptor": "sift", "scheme": "nested"}
    path = tmp_path / "own_nested.safetensors"
    network.save(mlp, metadata, path, levels.of_projection(mlp, metadata, [make_tracks()]))
    whole = projections.levels(path, "uint4")
    part = projections.levels(f"{path}@24", "uint4")
    assert whole.shape == (64, 16) and part.shape == (24, 16)
    assert np.ptp(part) > np.ptp(whole[:24])  # fewer numbers of a unit vector are larger


def test_descriptors_without_a_projection_have_levels_in_a_file_of_their_own(tmp_path, monkeypatch):
    data = [make_tracks(dim=32)]
    mlp, metadata = raw.train(data), {"descriptor": "edgepoint2_t32", "scheme": "raw"}
    path = tmp_path / "edgepoint2_t32.safetensors"
    network.save(mlp, metadata, path, levels.of_projection(mlp, metadata, data))
    monkeypatch.setattr(projection_files, "WEIGHTS", tmp_path)
    descriptors = torch.nn.functional.normalize(torch.randn(5, 32), dim=1)
    torch.testing.assert_close(projections.load(path)(descriptors), descriptors)
    _, conf = features_confs.get("edgepoint2_t32", storage="uint2")
    assert conf["model"] == {"name": "edgepoint2", "model_name": "T32"}
    fewer = {**conf, "model": {**conf["model"], "max_keypoints": 500}}  # of a file of the user
    for each in (conf, fewer):
        found = features_confs.levels(each)
        np.testing.assert_array_equal(found, projections.levels(path, "uint2"))
    _, other = features_confs.get("edgepoint2_t48", storage="uint2")
    with pytest.raises(InputError, match="edgepoint2_t48 has no projection, but --storage uint2"):
        features_confs.levels(other)
    trained = {**conf, "model": {**conf["model"], "weights": "own.safetensors"}}
    with pytest.raises(InputError, match="edgepoint2_t32 has no projection, but --storage uint2"):
        features_confs.levels(trained)


def test_features_are_stored_as_codes_and_queries_as_floats(projection, textured, tmp_path):
    import cv2

    for name in ("map.png", "query.png"):
        cv2.imwrite(str(tmp_path / name), textured)
    _, conf = features_confs.get("sift", projection, "uint4")
    path = extract_features.main(
        conf, tmp_path, tmp_path, image_list=["map.png", "query.png"], queries=["query.png"]
    )
    with h5py.File(path) as file:
        coded, number = file["map.png/descriptors_uint4"], len(file["map.png/keypoints"])
        assert coded.shape == (8, number) and coded.dtype == np.uint8
        assert file["query.png/descriptors"].shape == (16, number)
        assert file["query.png/descriptors"].dtype == np.float16
        cosine = (get_descriptors(file, "map.png") * get_descriptors(file, "query.png")).sum(axis=1)
    assert dimension(path) == 16
    assert cosine.mean() > 0.95
    back = storage.main(path, tmp_path / "float.h5")
    again = storage.main(back, tmp_path / "codes.h5", "uint4", projection=projection)
    with h5py.File(path) as before, h5py.File(again) as after:
        codes = [file["map.png/descriptors_uint4"][()] for file in (before, after)]
    assert (codes[0] == codes[1]).mean() > 0.99  # normalized in between


def test_features_without_levels_are_refused(projection, tmp_path, monkeypatch, caplog):
    with pytest.raises(InputError, match="sift has no projection, but --storage uint4 needs"):
        extract_features.provenance(features_confs.get("sift", None, "uint4")[1])
    mlp, metadata = network.read(projection)
    network.save(mlp, metadata, projection)
    with pytest.raises(InputError, match="no levels for uint2: use --storage uint8, or add"):
        extract_features.provenance(features_confs.get("sift", projection, "uint2")[1])
    broken = {"levels.uint4": torch.zeros(16, 3)}
    network.save(mlp, metadata, projection, broken)
    with pytest.raises(InputError, match=r"levels of shape \(16, 3\), not \(D, 16\)"):
        projections.levels(projection, "uint4")
    network.save(mlp, metadata, projection, {"levels.uint2": torch.arange(32.0).reshape(8, 4)})
    with pytest.raises(InputError, match="has levels for 8 numbers, but its descriptors have 16"):
        projections.levels(projection, "uint2")
    for layers in ('{"a": 1}', "5", "[]", "["):
        projection.write_bytes(serialize({"levels.uint1": torch.zeros(16, 2)}, {"layers": layers}))
        with pytest.raises(InputError, match="mine_sv16.safetensors has "):
            projections.levels(projection, "uint1")
    features = tmp_path / "a.h5"
    with h5py.File(features, "w") as file:
        file["a.jpg/descriptors"] = np.eye(16, dtype=np.float16)
    command = ["--features", features, "--output", tmp_path / "b.h5", "--storage", "uint4"]
    said = refused(monkeypatch, caplog, storage, *command)
    assert said == "--storage uint4 needs --projection, the one of the features."
    before = features.read_bytes()
    for message, *wrong in (
        ("Unknown storage 'uint3'", "--storage", "uint3"),
        ("sift_sv99 does not ship", "--projection", "sift_sv99"),
        ("no projection file", "--projection", tmp_path / "gone.safetensors"),
        ("no levels, and a .pth file can have none", "--projection", tmp_path / "a.pth"),
        ("no levels for uint4: use --storage uint8, or add", "--projection", projection),
        ("needs no --projection", "--projection", projection, "--storage", "uint8"),
    ):
        (tmp_path / "a.pth").write_bytes(b"")
        network.save(mlp, metadata, projection)
        assert message in refused(monkeypatch, caplog, storage, *command, *wrong)
    # levels go to a copy of a shipped projection, which they would change
    monkeypatch.setattr(projections.files, "WEIGHTS", tmp_path)
    network.save(mlp, metadata, tmp_path / "shipped.safetensors")
    for shipped in ("shipped", "shipped@24"):
        said = refused(monkeypatch, caplog, storage, *command, "--projection", shipped)
        assert f"{shipped} has no levels for uint4: " in said and "--projection COPY --map" in said
    assert features.read_bytes() == before and not (tmp_path / "b.h5").exists()


def test_broken_codes_are_refused(projection, tmp_path):
    path, codes = tmp_path / "a.h5", np.zeros((8, 3), np.uint8)
    with h5py.File(path, "w") as file:
        for name in ("whole", "narrow", "lost"):
            file[f"{name}/descriptors_uint4"] = codes[: 4 if name == "narrow" else 8]
            if name != "lost":
                file[f"{name}/descriptors_uint4"].attrs["levels"] = np.tile(
                    np.arange(16.0), (16, 1)
                )
        assert get_descriptors(file, "whole").shape == (3, 16)
        with pytest.raises(
            InputError, match="narrow in .*: its .* have 4 bytes a descriptor, but levels of 16"
        ):
            get_descriptors(file, "narrow")
        with pytest.raises(InputError, match="lost in .* have no levels"):
            get_descriptors(file, "lost")


def test_codes_of_different_levels_are_not_matched(projection, tmp_path):
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("a b\n")
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        for name, factor in (("a", 1), ("b", 2)):
            dataset = file.create_dataset(
                f"{name}/descriptors_uint4", data=np.eye(8, dtype=np.uint8)
            )
            dataset.attrs["levels"] = factor * np.tile(np.arange(16.0), (16, 1))
    conf = match_features.confs["NN-ratio"]
    with pytest.raises(InputError, match="other levels than those of a in .* different project"):
        match_features.main(conf, pairs, path, matches=tmp_path / "m.h5")


def test_codes_of_another_projection_are_not_converted(projection, tmp_path):
    path, codes = tmp_path / "a.h5", tmp_path / "codes.h5"
    with h5py.File(path, "w") as file:
        file["a.jpg/descriptors"] = np.eye(16, dtype=np.float16)
    storage.main(path, codes, "uint2", projection=projection)
    output = tmp_path / "b.h5"
    for wanted in ("uint2", "uint4"):
        with pytest.raises(InputError, match="a.jpg in .* other levels than those of sift_sv16"):
            storage.main(codes, output, wanted, projection="sift_sv16")
        assert not output.exists()
        storage.main(codes, tmp_path / f"{wanted}.h5", wanted, projection=projection)


def test_codes_without_levels_are_not_converted(projection, tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["a.jpg/descriptors_uint2"] = np.zeros((4, 3), np.uint8)
    for wanted in ({"storage": "float16"}, {"storage": "uint2", "projection": projection}):
        with pytest.raises(InputError, match="a.jpg in .* have no levels"):
            storage.main(path, tmp_path / "b.h5", **wanted)


def test_codes_of_two_projections_are_not_matched(projection, tmp_path):
    """Their levels cannot be compared, as one file has 16 and the other 4 a number."""
    pairs, path = tmp_path / "pairs.txt", tmp_path / "a.h5"
    pairs.write_text("a b\n")
    with h5py.File(path, "w") as file:
        for name in "ab":
            file[f"{name}/descriptors"] = np.eye(16, dtype=np.float16)
    conf, matches = match_features.confs["NN-mutual"], tmp_path / "matches.h5"
    coded = {
        kind: storage.main(path, tmp_path / f"{kind}.h5", kind, projection=whose)
        for kind, whose in (("uint4", projection), ("uint2", projection), ("uint1", "sift_sv16"))
    }
    with h5py.File(coded["uint2"], "r+") as file:
        file.create_group("a0")["keypoints"] = np.zeros((1, 2))  # no descriptors, and in no pair
    match_features.main(conf, pairs, coded["uint4"], matches=matches, features_ref=coded["uint2"])
    with pytest.raises(InputError, match="The codes in .*uint1.h5 are of another projection"):
        match_features.main(
            conf, pairs, coded["uint4"], matches=tmp_path / "m.h5", features_ref=coded["uint1"]
        )
    assert not (tmp_path / "m.h5").exists()
