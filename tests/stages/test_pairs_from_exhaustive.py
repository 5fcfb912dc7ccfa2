"""All pairs of images, of lists and feature files."""

import h5py
import numpy as np
import pytest
from command import refused, run

from hloc_reduce import pairs_from_exhaustive
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.parsers import parse_pairs

NAMES = ["db/b.jpg", "db/a.jpg", "db/c.jpg"]


QUERIES = ["query/2.jpg", "query/1.jpg"]


def pairs(path, **given):
    return list(parse_pairs(pairs_from_exhaustive.main(path, **given)))


def listed(path, names):
    path.write_text("".join(f"{name} PINHOLE 640 480 500 501 320 240\n" for name in names))
    return path


def described(path, names):
    with h5py.File(path, "w") as file:
        for name in names:
            file[f"{name}/keypoints"] = np.zeros((1, 2), np.float32)
    return path


def test_images_are_paired_with_each_other_once(tmp_path):
    b, a, c = NAMES
    expected = [(b, a), (b, c), (a, c)]
    output = tmp_path / "new/pairs.txt"
    assert pairs_from_exhaustive.main(output, NAMES) == output
    for images in (iter(NAMES), listed(tmp_path / "l.txt", NAMES), str(tmp_path / "l.txt")):
        assert pairs(output, image_list=images) == expected
    for references in (NAMES, NAMES[::-1], tmp_path / "l.txt"):
        assert pairs(output, image_list=NAMES, ref_list=references) == expected
    assert pairs(output, image_list=NAMES * 2) == expected
    features = described(tmp_path / "f.h5", NAMES)
    assert pairs(output, features=str(features)) == [(a, b), (a, c), (b, c)]
    assert pairs(output, features=features, ref_features=features) == [(a, b), (a, c), (b, c)]


def test_queries_are_paired_with_all_references(tmp_path):
    output = tmp_path / "pairs.txt"
    expected = [(query, name) for query in QUERIES for name in NAMES]
    assert pairs(output, image_list=QUERIES, ref_list=NAMES) == expected
    features = described(tmp_path / "f.h5", NAMES)
    expected = [(query, name) for query in QUERIES for name in sorted(NAMES)]
    assert pairs(output, image_list=QUERIES, ref_features=features) == expected
    # of both lists an image is not paired with itself
    found = pairs(output, image_list=NAMES[:2], ref_list=NAMES)
    assert found == [(a, b) for a in NAMES[:2] for b in NAMES if a != b]
    assert pairs(output, image_list=NAMES[:1], ref_list=QUERIES[:1]) == [(NAMES[0], QUERIES[0])]


def test_command_line(tmp_path, monkeypatch):
    output = tmp_path / "pairs.txt"
    features = described(tmp_path / "f.h5", NAMES)
    queries = listed(tmp_path / "queries.txt", QUERIES)
    given = ("--output", output, "--image_list", queries, "--ref_features", features)
    run(monkeypatch, pairs_from_exhaustive, *given)
    assert list(parse_pairs(output)) == [(q, name) for q in QUERIES for name in sorted(NAMES)]


def test_nothing_to_pair_is_refused(tmp_path, monkeypatch, caplog):
    output = tmp_path / "pairs.txt"
    with pytest.raises(InputError, match="give a list of images or a feature file"):
        pairs(output, ref_list=NAMES)
    with pytest.raises(InputError, match="no image in the list"):
        pairs(output, image_list=NAMES, ref_list=[])
    with pytest.raises(InputError, match="f.h5 has no image"):
        pairs(output, features=described(tmp_path / "f.h5", []))
    with pytest.raises(InputError, match="cannot be names of images"):
        pairs(output, image_list=["a\tb.jpg", "c.jpg"])
    for references in (None, NAMES[:1]):
        with pytest.raises(InputError, match="db/b.jpg is the only image"):
            pairs(output, image_list=NAMES[:1], ref_list=references)
    command = ("--output", output, "--features", tmp_path / "none.h5")
    assert "it does not exist" in refused(monkeypatch, caplog, pairs_from_exhaustive, *command)
    command = ("--output", output, "--image_list", tmp_path / "none.txt")
    assert "Cannot read" in refused(monkeypatch, caplog, pairs_from_exhaustive, *command)
    assert not output.exists()
