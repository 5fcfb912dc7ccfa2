"""Descriptors that exist, reduced without the photos."""

import cv2
import h5py
import numpy as np
import pycolmap
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hloc_reduce import localize_sfm, match_features, projections, reduce
from hloc_reduce.descriptors.normalization import NORMALIZATIONS, detect, to_colmap_sift
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.utils import colmap, parsers
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.feature_files import get_descriptors, get_keypoints
from pipelines import aachen

PIPELINE = reduce


def sift(normalization="L1_ROOT"):
    """Detect SIFT of COLMAP in a picture with as much of all sizes as photos have."""
    image = sum(
        size
        * cv2.resize(np.random.default_rng(size).random((360 // size, 360 // size)), (360, 360))
        for size in (1, 2, 4, 8, 16, 32)
    ).astype(np.float32)
    return colmap.detect_dog(
        image / image.max(), {"normalization": normalization, "first_octave": 0}
    )


def of_hloc(descriptors):
    """Take roots as hloc's `dog` does, of descriptors with float16 zeros."""
    descriptors = descriptors / (np.abs(descriptors).sum(1, keepdims=True) + 1e-6)
    descriptors = np.sqrt(descriptors.clip(min=1e-6))
    norms = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return (descriptors / (norms + 1e-6)).astype(np.float16).astype(np.float32)


def write(path, descriptors, names=("db/a.jpg", "b c.jpg")):
    with GroupWriter(path, {}) as writer:
        for name in names:
            arrays = {
                "keypoints": np.arange(2 * len(descriptors), dtype=np.float32).reshape(-1, 2),
                "descriptors": descriptors.T.astype(np.float16),
                "scores": np.zeros(len(descriptors)),
            }
            writer.add(name, arrays, {"keypoints": {"uncertainty": 1.5}})
    return path


def test_normalizations_are_told_apart():
    _, expected = sift()
    found = {
        "L1_ROOT": expected,
        "L2": sift("L2")[1],
        "rootsift": of_hloc(expected),
    }
    assert found.keys() == NORMALIZATIONS.keys()
    for name, descriptors in found.items():
        assert detect(descriptors) == name
        np.testing.assert_allclose(to_colmap_sift(descriptors, name), expected, atol=0.015)
    for wrong, message in (
        (-expected, "these have numbers below 0"),
        (expected[:, :64], "these have 64 numbers"),
        (expected[:0], "there are none"),
    ):
        with pytest.raises(InputError, match=message):
            detect(wrong)
    between = expected * (7.35 / expected.sum(axis=1, keepdims=True))
    with pytest.raises(InputError, match="may be L2 or L1_ROOT"):
        detect(between)


@given(st.integers(0, 4), st.sampled_from(sorted(NORMALIZATIONS)))
@settings(deadline=None)
def test_norms_are_one_or_zero(number, name):
    descriptors = np.random.default_rng(number).random((number, 128), np.float32)
    descriptors[:1] = 0
    norms = np.linalg.norm(to_colmap_sift(descriptors, name), axis=1)
    np.testing.assert_allclose(norms[1:], 1, rtol=1e-5)
    assert (norms[:1] == 0).all()


@pytest.mark.parametrize("storage", ["float16", "uint4"])
def test_a_file_of_hloc(run, tmp_path, storage):
    """Everything but the descriptors is as before; these are those of this project's extractor."""
    keypoints, expected = sift()
    features = write(tmp_path / "feats-sift.h5", of_hloc(expected))
    output = tmp_path / "small.h5"
    given = ("--features", features, "--output", output, "--storage", storage)
    run(*given, "--feature", "colmap_sift_sv32")
    projected = projections.load("colmap_sift_sv32")(torch.from_numpy(expected)).numpy()
    with h5py.File(features) as before, h5py.File(output) as after:
        for name in ("db/a.jpg", "b c.jpg"):
            for key in ("keypoints", "scores"):
                np.testing.assert_array_equal(after[name][key], before[name][key])
            assert get_keypoints(after, name)[1] == 1.5
            found = get_descriptors(after, name)
            cosine = (found * projected).sum(1) / np.linalg.norm(found, axis=1)
            assert cosine.min() > (0.999 if storage == "float16" else 0.97)
    written = output.stat().st_mtime_ns
    run(*given, "--feature", "colmap_sift_sv32")  # all is there
    assert output.stat().st_mtime_ns == written


def test_it_resumes_and_images_without_keypoints_stay(run, tmp_path, monkeypatch):
    _, descriptors = sift()
    features = write(tmp_path / "feats.h5", descriptors)
    with GroupWriter(features, {}) as writer:
        arrays = {"keypoints": np.zeros((0, 2)), "descriptors": np.zeros((128, 0), np.float16)}
        writer.add("empty.jpg", arrays, {"": {"failure": "Cannot read it"}})
    given = ("--features", features, "--feature", "colmap_sift_sv16")
    whole = tmp_path / "whole.h5"
    run(*given, "--output", whole)
    read = reduce.get_descriptors

    def fail(file, name):
        if fail.after == 0:
            raise InputError("no longer there")
        fail.after -= 1
        return read(file, name)

    fail.after = 3 + 1  # three are read to tell the normalization
    monkeypatch.setattr(reduce, "get_descriptors", fail)
    stopped = tmp_path / "stopped.h5"
    with pytest.raises(SystemExit):
        run(*given, "--output", stopped)
    fail.after = 3 + 2  # the first one is there
    run(*given, "--output", stopped)
    with h5py.File(whole) as one, h5py.File(stopped) as other:
        assert one["empty.jpg"].attrs["failure"] == other["empty.jpg"].attrs["failure"]
        for name in ("db/a.jpg", "b c.jpg", "empty.jpg"):
            np.testing.assert_array_equal(one[name]["descriptors"], other[name]["descriptors"])


def test_an_old_model_localizes_with_reduced_features(aachen_layout, tmp_path, monkeypatch):
    """The model, the pairs and the keypoints are those of the unreduced features."""
    outputs = tmp_path / "outputs"
    aachen.main(aachen_layout, outputs, "colmap_sift")
    sfm = outputs / "sfm_colmap_sift+NN-ratio"
    (pairs,) = outputs.glob("pairs-query-*.txt")
    small = reduce.main(
        outputs / "feats-dog-colmap_sift.h5", tmp_path / "small.h5", "colmap_sift_sv32"
    )
    matches = match_features.main(
        match_features.confs["NN-ratio"], pairs, small, matches=tmp_path / "matches.h5"
    )
    poses = tmp_path / "poses.txt"
    queries = aachen_layout / "queries/*_time_queries_with_intrinsics.txt"
    found = localize_sfm.main(sfm, queries, pairs, small, matches, poses)
    truth = parsers.parse_poses(aachen_layout / "queries/ground_truth_poses.txt")
    errors = []
    for name, pose in truth.items():
        w, *xyz = found[name]["qvec"]
        estimate = pycolmap.Rigid3d(pycolmap.Rotation3d([*xyz, w]), found[name]["tvec"])
        errors.append(pose_error(estimate, pose)[0])
    assert sorted(errors)[1] < 0.01  # two of three queries show the place


@pytest.mark.parametrize(
    "options, message",
    [
        (("--feature", "colmap_sift_sv3"), "Unknown feature 'colmap_sift_sv3'"),
        (
            ("--feature", "xfeat_sv32"),
            "the descriptors of b c.jpg are 128-D, xfeat_sv32 needs 64-D",
        ),
        (("--feature", "colmap_sift_sv32", "--output", "feats.h5"), "cannot be reduced to itself"),
        (("--feature", "colmap_sift_sv32", "--features", "none.h5"), "none.h5"),
        (("--feature", "colmap_sift_sv32", "--storage", "uint3"), "uint3"),
        (("--feature", "colmap_sift_sv32", "--normalization", "L3"), "L3"),
        (("--feature", "sift_sv32", "--normalization", "L2"), "is for features of colmap_sift"),
        (("--feature", "colmap_sift_sv32", "--features", "signed.h5"), "numbers below 0"),
        (("--feature", "colmap_sift_sv32", "--features", "text.h5"), "text.h5"),
    ],
)
def test_wrong_input(options, message, refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    _, descriptors = sift()
    write(tmp_path / "feats.h5", descriptors)
    write(tmp_path / "signed.h5", -descriptors)
    (tmp_path / "text.h5").write_text("no h5")
    default = ("--features", "feats.h5", "--output", "small.h5")
    assert message in refused(*default, *options)
    assert not (tmp_path / "small.h5").exists()
