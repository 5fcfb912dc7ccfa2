"""Which settings of DoG a feature and a map are made with."""

import json

from hloc_reduce import extract_features
from hloc_reduce.confs import features as features_confs


def test_a_yaml_file_says_its_settings(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("model: {name: dog, descriptor: sift}")
    adaptive = features_confs.get(str(path))[1]
    assert adaptive["model"]["keypoints"] == "adaptive"
    hloc = features_confs.get(str(path), keypoints="hloc")[1]
    assert hloc["model"]["keypoints"] == "hloc"
    made_by = [json.dumps(extract_features.provenance(conf)) for conf in (adaptive, hloc)]
    assert made_by[0] != made_by[1]
    path.write_text("model: {name: dog, descriptor: sift, keypoints: hloc}")
    assert features_confs.get(str(path))[1]["model"]["keypoints"] == "hloc"


def test_a_projected_feature_has_them_too():
    model = features_confs.get("sift_sv64", keypoints="hloc")[1]["model"]
    assert model["base"]["keypoints"] == "hloc"
    assert features_confs.confs["sift_sv64"]["model"]["base"]["keypoints"] == "adaptive"
