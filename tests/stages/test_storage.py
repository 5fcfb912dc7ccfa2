"""Stored descriptors: quantized, converted and matched."""

import h5py
import numpy as np
import pytest
from command import refused, run
from hypothesis import given, settings
from hypothesis import strategies as st

from hloc_reduce import extract_features, match_features, storage
from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import QUANTIZED, quantize, restore, store
from hloc_reduce.utils.feature_files import get_descriptors, stored_descriptors


def unit(number, dim, seed):
    descriptors = np.random.default_rng(seed).standard_normal((number, dim)).astype(np.float32)
    return descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)


def write(path, kind, *names):
    with GroupWriter(path, {}) as writer:
        for seed, name in enumerate(names):
            features = {
                "keypoints": np.full((50, 2), 1025.25, np.float32),
                "scores": np.ones(50, np.float32),
                "descriptors": unit(50, 16, seed).T,
            }
            arrays, attrs = store(features, kind)
            writer.add(name, arrays, attrs | {"keypoints": {"uncertainty": 2.0}})
    return path


@given(
    st.integers(0, 5), st.integers(1, 9), st.floats(-2, 2), st.floats(0.01, 2), st.integers(0, 99)
)
@settings(max_examples=50, deadline=None)
def test_quantized_within_half_a_step(number, dim, offset, width, seed):
    descriptors = offset + width * np.random.default_rng(seed).random((dim, number), np.float32)
    levels, scale, offset = quantize(descriptors)
    assert levels.dtype == np.uint8 and levels.shape == descriptors.shape
    if number:
        assert np.abs(offset + scale * levels - descriptors).max() <= 0.51 * scale + 1e-5
        assert levels.min() == 0 and levels.max() == (255 if np.ptp(descriptors) else 0)


@pytest.mark.parametrize(
    "kind, bytes_each, error", [("float32", 4, 0), ("float16", 2, 1e-3), ("uint8", 1, 6e-3)]
)
def test_stored_and_read(tmp_path, kind, bytes_each, error):
    path = write(tmp_path / "feats.h5", kind, "db/a.jpg")
    with h5py.File(path) as file:
        assert stored_descriptors(file, "db/a.jpg").dtype.itemsize == bytes_each
        assert ("descriptors" in file["db/a.jpg"]) == (kind != "uint8")  # what hloc looks for
        descriptors = get_descriptors(file, "db/a.jpg")
    assert descriptors.dtype == np.float32 and descriptors.flags.c_contiguous
    np.testing.assert_allclose(descriptors, unit(50, 16, 0), atol=error)
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1, atol=2e-3)


def test_no_keypoints():
    arrays, attrs = store({"descriptors": np.zeros((16, 0), np.float32)}, "uint8")
    assert restore(arrays, attrs).shape == (0, 16)


def test_command_converts_to_hlocs_format(tmp_path, monkeypatch):
    quantized = write(tmp_path / "feats.h5", "uint8", "db/a.jpg", "b.jpg")
    output = tmp_path / "hloc.h5"
    run(monkeypatch, storage, "--features", quantized, "--output", output)
    with h5py.File(quantized) as before, h5py.File(output) as after:
        for name in ("db/a.jpg", "b.jpg"):
            assert sorted(after[name]) == ["descriptors", "keypoints", "scores"]
            assert after[name]["descriptors"].dtype == np.float16
            assert after[name]["keypoints"].attrs["uncertainty"] == 2
            np.testing.assert_array_equal(after[name]["keypoints"], before[name]["keypoints"])
            np.testing.assert_allclose(
                get_descriptors(after, name), get_descriptors(before, name), atol=1e-3
            )
    run(monkeypatch, storage, "--features", quantized, "--output", output)  # all is there
    same = storage.main(quantized, tmp_path / "same.h5", "uint8")
    with h5py.File(quantized) as before, h5py.File(same) as after:
        levels = [file["b.jpg"][QUANTIZED["uint8"]] for file in (before, after)]
        assert (levels[0][()] == levels[1][()]).all()
        assert dict(levels[0].attrs) == dict(levels[1].attrs)
    back = storage.main(output, tmp_path / "back.h5", "uint8")
    with h5py.File(quantized) as before, h5py.File(back) as after:
        levels = [file["b.jpg"][QUANTIZED["uint8"]][()].astype(int) for file in (before, after)]
    assert np.abs(levels[0] - levels[1]).max() <= 1


def test_conversion_copies_other_data_sets_as_they_are(tmp_path):
    scores = np.array([1e5, 1.00001, 2], np.float32)
    with GroupWriter(tmp_path / "a.h5", {}) as writer:
        writer.add("a.jpg", {"descriptors": unit(3, 16, 0).T, "scores": scores})
    storage.main(tmp_path / "a.h5", tmp_path / "b.h5", "uint8")
    with h5py.File(tmp_path / "b.h5") as file:
        assert sorted(file["a.jpg"]) == [QUANTIZED["uint8"], "scores"]
        np.testing.assert_array_equal(file["a.jpg/scores"], scores)


def test_quantized_match_like_floats(tmp_path):
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("a.jpg b.jpg\n")
    matches = {}
    for kind in ("float16", "uint8"):
        path = tmp_path / f"{kind}.h5"
        first, second = unit(300, 16, 0), unit(300, 16, 1)
        second[:200] = first[:200] + 0.02 * second[:200]
        second /= np.linalg.norm(second, axis=1, keepdims=True)
        with GroupWriter(path, {}) as writer:
            for name, descriptors in (("a.jpg", first), ("b.jpg", second)):
                writer.add(name, *store({"descriptors": descriptors.T}, kind))
        conf = match_features.confs["NN-ratio"]
        match_features.main(conf, pairs, path, matches=tmp_path / f"m{kind}.h5")
        with h5py.File(tmp_path / f"m{kind}.h5") as file:
            matches[kind] = file["a.jpg/b.jpg/matches0"][()]
    assert (matches["uint8"][:200] == np.arange(200)).all()
    assert (matches["uint8"] == matches["float16"]).mean() > 0.99


def test_wrong_input(tmp_path, monkeypatch, caplog):
    path = write(tmp_path / "feats.h5", "uint8", "a.jpg")
    with pytest.raises(InputError, match="converted to itself"):
        storage.main(path, path)
    conf = {**extract_features.confs["sift"], "storage": "uint3"}
    with pytest.raises(InputError, match="Unknown storage 'uint3'"):
        extract_features.main(conf, tmp_path, tmp_path)
    with h5py.File(path, "a") as file:
        del file["a.jpg"][QUANTIZED["uint8"]].attrs["scale"]
    with pytest.raises(InputError, match="have no scale"):
        storage.main(path, tmp_path / "new.h5")
    command = ["--features", path, "--output", tmp_path / "c.h5", "--storage", "uint3"]
    assert "Unknown storage 'uint3'" in refused(monkeypatch, caplog, storage, *command)
