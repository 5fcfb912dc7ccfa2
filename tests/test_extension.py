"""An extractor and a matcher of one file each work in the stages."""

from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

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


def test_a_conf_of_hlocs_is_taken_word_for_word(tmp_path):
    conf = {
        "output": "matches-NN-mutual-dist.7",
        "model": {
            "name": "nearest_neighbor",
            "do_mutual_check": True,
            "distance_threshold": 0.7,
        },
    }
    assert matchers.load(conf["model"]).conf["distance_threshold"] == 0.7
