"""Matching of pairs, and what it refuses."""

import h5py
import numpy as np
import pytest
import torch
from command import refused
from small_map import MATCHER

from hloc_reduce import match_features, pairs_from_retrieval
from hloc_reduce.matchers.base import Matcher
from hloc_reduce.matchers.nearest_neighbor import mutual_nearest
from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.utils import best_two
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import CODED, store
from hloc_reduce.utils.feature_files import read_descriptors
from hloc_reduce.utils.h5 import list_h5_names
from hloc_reduce.utils.match_files import get_matches
from hloc_reduce.utils.parsers import parse_pairs, write_pairs

KEYS = ("descriptors",)


def test_a_pair_that_is_listed_again_and_reversed_is_matched_once(built, tmp_path):
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("db/0.jpg db/1.jpg\ndb/1.jpg db/2.jpg\n" * 50 + "db/1.jpg db/0.jpg\n" * 50)
    drawn = []
    with GroupWriter(tmp_path / "matches.h5", {}) as writer:
        for names in match_features.unmatched_pairs(parse_pairs(pairs), writer):
            drawn.append(names)  # and not written before the next is drawn
    assert drawn == [("db/0.jpg", "db/1.jpg"), ("db/1.jpg", "db/2.jpg")]
    conf = match_features.confs["NN-ratio"]
    matches = match_features.main(conf, pairs, built.features, matches=tmp_path / "m.h5")
    assert len(list_h5_names(matches)) == 2


def test_finished_matches_need_no_matcher(built, tmp_path, monkeypatch):
    """Which would take seconds to import torch."""
    pairs, conf = tmp_path / "pairs.txt", match_features.confs["NN-ratio"]
    pairs.write_text("db/0.jpg db/1.jpg\n")
    matches = match_features.main(conf, pairs, built.features, matches=tmp_path / "m.h5")
    monkeypatch.setattr("hloc_reduce.matchers.load", None)
    assert match_features.main(conf, pairs, built.features, matches=matches) == matches


@pytest.mark.parametrize(
    "pairs",
    [
        [("x/1.jpg", "db/0.jpg"), ("x-1.jpg", "db/0.jpg")],
        [("db/0.jpg", "x/1.jpg"), ("db/0.jpg", "x-1.jpg")],
        [("x/1.jpg", "db/0.jpg"), ("db/0.jpg", "x-1.jpg")],
    ],
)
def test_photos_that_a_match_file_cannot_tell_apart(built, tmp_path, pairs):
    """The second of them had the matches of the first."""
    write_pairs(pairs, tmp_path / "pairs.txt")
    conf, matches = match_features.confs["NN-ratio"], tmp_path / "m.h5"
    with pytest.raises(InputError, match="x-1.jpg and x/1.jpg have the same name in match files"):
        match_features.main(conf, tmp_path / "pairs.txt", built.features, matches=matches)
    assert not matches.exists()


def test_names_that_are_alike_in_other_columns_are_no_problem(built, tmp_path):
    pairs = tmp_path / "pairs.txt"
    write_pairs([("db-1.jpg", "db/0.jpg"), ("db-1.jpg", "db/1.jpg")], pairs)
    with h5py.File(built.features, "r+") as file:
        file.copy("db/2.jpg", "db-1.jpg")
    conf = match_features.confs["NN-ratio"]
    matches = match_features.main(conf, pairs, built.features, matches=tmp_path / "m.h5")
    assert len(list_h5_names(matches)) == 2


def test_matches_do_not_overwrite_features(built, tmp_path, monkeypatch, caplog):
    before = built.features.read_bytes()
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("db/0.jpg db/1.jpg\n")
    name = built.features.stem
    command = ["--pairs", pairs, "--export_dir", built.features.parent, "--features", name]
    command += ["--matches", built.features, "--overwrite"]
    assert "is an input of the matching" in refused(monkeypatch, caplog, match_features, *command)
    assert built.features.read_bytes() == before


def test_a_wrong_gpu_memory_is_refused(tmp_path, monkeypatch, caplog):
    command = ["--pairs", tmp_path / "p.txt", "--export_dir", tmp_path, "--gpu_bytes", "0"]
    assert "--gpu_bytes 0: at least 1" in refused(monkeypatch, caplog, match_features, *command)


def test_matches_are_those_of_the_scene(built):
    assert len(list_h5_names(built.matches)) == 15  # each unordered pair once
    with h5py.File(built.matches) as file:
        assert file[list_h5_names(built.matches)[0]]["matches0"].dtype == np.int32
        for name0, name1 in (("db/0.jpg", "db/1.jpg"), ("db/4.jpg", "db/2.jpg")):
            matches, scores = get_matches(file, name0, name1)
            assert len(matches) == 300 and scores.min() > 0.99
            same = built.seen[name0][matches[:, 0]] == built.seen[name1][matches[:, 1]]
            assert same.all()


def test_matching_goes_on_with_what_is_missing(built):
    with h5py.File(built.matches, "a") as file:
        del file["db-0.jpg/db-1.jpg"]
        file["db-0.jpg/db-2.jpg/matches0"][:] = 7  # would be repaired if matched again
    match_features.main(MATCHER, built.pairs, built.features, matches=built.matches)
    with h5py.File(built.matches) as file:
        assert (file["db-0.jpg/db-1.jpg/matches0"][:] >= 0).all()
        assert (file["db-0.jpg/db-2.jpg/matches0"][:] == 7).all()


def test_descriptors_in_memory_are_bounded(tmp_path):
    path = tmp_path / "f.h5"
    with GroupWriter(path, {}) as writer:
        for name in "abcd":
            writer.add(name, {"descriptors": np.full((4, 10), ord(name), np.float16)})
    with h5py.File(path) as file:
        read = match_features.FeatureCache(2 * 4 * 10 * 4, KEYS)
        first = read(file, "a")
        assert first.keys() == {"descriptors"} and first["descriptors"].shape == (4, 10)
        assert first["descriptors"].T.flags["C_CONTIGUOUS"]
        read(file, "b")
        assert read(file, "a") is first  # and is the last one used now
        read(file, "c")
        assert read(file, "a") is first
        assert {name for _, name in read.kept} == {"a", "c"} and read.bytes == 320
        assert read(file, "d")["descriptors"][0, 0] == ord("d")
        small = match_features.FeatureCache(1, KEYS)
        for name in "ab":
            assert small(file, name)["descriptors"][0, 0] == ord(name)
        assert len(small.kept) == 1


@pytest.fixture
def coded(tmp_path):
    """A feature file of a float query and the same descriptors, changed a little, as codes."""
    generator = np.random.default_rng(0)
    query = generator.standard_normal((200, 32))
    path = tmp_path / "f.h5"
    with GroupWriter(path, {}) as writer:
        for storage in ("float16", "uint8", *CODED):
            own = query[::-1] + 0.3 * generator.standard_normal(query.shape)
            own /= np.linalg.norm(own, axis=1, keepdims=True)
            number = 2 ** CODED.get(storage, 0)
            levels = np.tile(np.linspace(-0.3, 0.3, number, dtype=np.float32), (32, 1))
            stored = store({"descriptors": own.T.astype(np.float32)}, storage, levels)
            writer.add(f"{storage}.jpg", *stored)
        query /= np.linalg.norm(query, axis=1, keepdims=True)
        writer.add("query.jpg", {"descriptors": query.T.astype(np.float16)})
    return path


def matched(path, names, output):
    write_pairs([names], output.with_suffix(".txt"))
    match_features.main(MATCHER, output.with_suffix(".txt"), path, matches=output)
    with h5py.File(output) as file:
        group = file[list_h5_names(output)[0]]
        return group["matches0"][()], group["matching_scores0"][()]


@pytest.mark.parametrize("name", ["query.jpg", "uint8.jpg", "uint4.jpg"])
@pytest.mark.parametrize("storage", ["uint8", *CODED])
def test_codes_match_as_the_floats_they_stand_for(storage, name, coded, tmp_path, monkeypatch):
    names = name, f"{storage}.jpg"
    if names[0] == names[1]:
        names = name, "float16.jpg"
    matches, scores = matched(coded, names, tmp_path / "a.h5")
    with h5py.File(coded) as file:
        stored = [read_descriptors(file, one) for one in names]
    pair = [torch.from_numpy(one.restore(unbiased=True)) for one in stored]
    expected, cosine = mutual_nearest(*pair, MATCHER["model"].get("ratio_threshold"))
    assert matches.tolist() == expected.tolist() and (matches >= 0).sum() > 100
    is_match = matches >= 0
    np.testing.assert_allclose(scores[is_match], (cosine[is_match].clip(max=1) + 1) / 2, atol=2e-3)
    backward, _ = matched(coded, names[::-1], tmp_path / "b.h5")
    assert {(i, j) for i, j in enumerate(matches) if j >= 0} == {
        (i, j) for j, i in enumerate(backward) if i >= 0
    }
    monkeypatch.setattr(best_two, "instructions", list)  # as without a compiler
    by_torch = matched(coded, names, tmp_path / "c.h5")
    assert (by_torch[0] == matches).all() and (by_torch[1] == scores).all()


def test_codes_stay_codes_in_memory(coded):
    read = match_features.FeatureCache(10**9, KEYS)
    with h5py.File(coded) as file:
        sizes = [read.bytes, *(read(file, f"{name}.jpg") and read.bytes for name in CODED)]
    assert np.diff(sizes).tolist() == [200 * 32 * bits // 8 for bits in CODED.values()]


def test_only_matchers_that_take_codes_get_them(coded):
    class Nearest(Matcher):
        def _forward(self, data):
            assert all(data[f"descriptors{i}"].dtype == torch.float32 for i in (0, 1))
            number = data["descriptors0"].shape[2]
            return {"matches0": torch.zeros(1, number), "matching_scores0": torch.ones(1, number)}

    with h5py.File(coded) as file:
        read = match_features.FeatureCache(10**9, KEYS)
        pair = match_features._read(read, file, file, ("query.jpg", "uint4.jpg"))
    ((_, (name, arrays, _)),) = match_features._match_batch(Nearest({}), "cpu", 1, [pair])
    assert name == "query.jpg/uint4.jpg" and len(arrays["matches0"]) == 200


def test_features_made_anew_invalidate_their_matches(tmp_path):
    """The same configuration, but other photos: an h5 file's id tells."""
    features, pairs = tmp_path / "f.h5", tmp_path / "pairs.txt"
    write_pairs([("a", "b")], pairs)
    descriptors = {"descriptors": np.eye(4, 3, dtype=np.float16)}
    for overwrite in (False, True):
        with GroupWriter(features, {"x": 1}, overwrite) as writer:
            writer.add("a", descriptors)
            writer.add("b", descriptors)
        if overwrite:
            with pytest.raises(InputError, match="another configuration"):
                match_features.main(MATCHER, pairs, features, matches=tmp_path / "m.h5")
        else:
            match_features.main(MATCHER, pairs, features, matches=tmp_path / "m.h5")
            with GroupWriter(features, {"x": 1}) as writer:  # more images change nothing
                writer.add("c", descriptors)
            match_features.main(MATCHER, pairs, features, matches=tmp_path / "m.h5")


def test_files_of_another_kind_are_refused(built):
    with pytest.raises(InputError, match="not a file of global_descriptor"):
        pairs_from_retrieval.main(built.features, built.root / "p.txt", 3)
    with pytest.raises(InputError, match="not in the file|not a file of"):
        match_features.main(MATCHER, built.pairs, built.matches, matches=built.root / "m.h5")
