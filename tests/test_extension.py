"""An extractor and a matcher of one file each work in the stages."""

from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch

from hloc_reduce import extract_features, extractors, match_features, matchers
from hloc_reduce.confs import features as features_confs
from hloc_reduce.utils.match_files import get_matches
from hloc_reduce.utils.parsers import write_pairs

TOYS = Path(__file__).parent / "toys"


@pytest.fixture(autouse=True)
def toys(monkeypatch):
    """As if their files were in the packages."""
    for package, folder in ((extractors, "extractors"), (matchers, "matchers")):
        monkeypatch.setattr(package, "__path__", [*package.__path__, str(TOYS / folder)])


def test_a_toy_extractor_and_a_toy_matcher(tmp_path):
    for i in range(2):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.full((30, 40), 100 * i, np.uint8))
    (tmp_path / "corners.yaml").write_text("model: {name: corners, margin: 3}\n")
    name, conf = features_confs.get(str(tmp_path / "corners.yaml"))
    features = extract_features.main(conf, tmp_path, tmp_path / "outputs")
    with h5py.File(features) as file:
        found = file["0.png"]["keypoints"][()]
        assert found.tolist() == [[3, 3], [36, 3], [3, 26], [36, 26]]
        assert file["0.png"]["descriptors"].shape == (4, 4)
        assert file["0.png"]["keypoints"].attrs["uncertainty"] == 1
    pairs = tmp_path / "pairs.txt"
    write_pairs([("0.png", "1.png")], pairs)
    conf = {"output": "matches-in-order", "model": {"name": "in_order", "number": 2}}
    matches = match_features.main(conf, pairs, features, matches=tmp_path / "matches.h5")
    with h5py.File(matches) as file:
        indices, scores = get_matches(file, "0.png", "1.png")
    assert indices.tolist() == [[0, 0], [1, 1]] and scores.tolist() == [1, 1]


def test_a_toy_extractor_is_listed(monkeypatch):
    conf = features_confs.feature("corners", {"name": "corners"})
    monkeypatch.setitem(features_confs.confs, "corners", conf)
    rows = [line.split(" | ") for line in features_confs.table().splitlines()]
    listed = {name.strip(): [cell.strip() for cell in cells] for name, *cells in rows}
    assert listed["corners"] == ["", "", "NN-ratio", "see extractors/corners.py"]
    assert listed["colmap_sift"][:2] == ["128", "256"]
    assert listed["sift_nested@24"][:2] == ["24", "48"] and listed["sift_nested"][0] == "64"


def test_a_toy_matcher_matches_some_rows():
    matcher = matchers.load({"name": "in_order", "number": 3})
    descriptors = torch.eye(5)
    matches = matcher.match_rows(descriptors, descriptors, torch.tensor([0, 2, 4]))
    assert matches.tolist() == [[0, 0], [2, 2]]


@pytest.mark.parametrize("do_mutual_check", [True, False])
def test_nearest_neighbors_of_some_rows(do_mutual_check):
    torch.manual_seed(0)
    descriptors = torch.nn.functional.normalize(torch.randn(2, 60, 4), dim=2)
    conf = {"name": "nearest_neighbor", "do_mutual_check": do_mutual_check, "ratio_threshold": 0.95}
    matcher = matchers.load(conf)
    matches0 = matcher.match([tuple(descriptors)])[0][0]
    rows = torch.arange(0, 60, 2)
    expected = {(i, int(j)) for i, j in enumerate(matches0) if j >= 0 and j % 2 == 0}
    found = {tuple(pair) for pair in matcher.match_rows(*descriptors, rows).tolist()}
    assert found == expected and len(found) > 5


def test_a_conf_of_hlocs_is_taken_word_for_word(tmp_path):
    conf = {
        "output": "matches-NN-mutual-dist.7",
        "model": {"name": "nearest_neighbor", "do_mutual_check": True, "distance_threshold": 0.7},
    }
    assert matchers.load(conf["model"]).conf["distance_threshold"] == 0.7
