"""An extractor, a matcher and a retrieval of one file each work wherever those that ship do."""

from pathlib import Path

import command
import cv2
import h5py
import numpy as np
import pytest
import torch
from command import outcome
from safetensors import safe_open

from hloc_reduce import (
    Localizer,
    aggregate_features,
    compact,
    extract_features,
    extractors,
    maps,
    match_features,
    matchers,
    retrieval,
)
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import listing
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.confs import retrieval as retrieval_confs
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.retrieval.ranking import read_global
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.match_files import get_matches
from hloc_reduce.utils.parsers import write_pairs
from pipelines import aachen, localize

TOYS = Path(__file__).parent / "toys"
PIPELINE = localize


IN_PLANE = {"output": "matches-in-plane", "model": {"name": "in_plane", "match_kind": "mutual"}}
THUMBNAIL = {
    "output": "global-feats-thumbnail",
    "model": {"name": "thumbnail"},
    "preprocessing": {"resize_max": 256},
}


@pytest.fixture(autouse=True)
def toys(monkeypatch):
    """As if their files were in the packages."""
    for package in (extractors, matchers, retrieval):
        folder = TOYS / package.__name__.rpartition(".")[2]
        monkeypatch.setattr(package, "__path__", [*package.__path__, str(folder)])
    monkeypatch.setitem(retrieval_confs.confs, "thumbnail", THUMBNAIL)
    monkeypatch.setitem(matchers_confs.confs, "in_plane", IN_PLANE)


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
    rows = [line.split(" | ") for line in listing.table().splitlines()]
    listed = {name.strip(): [cell.strip() for cell in cells] for name, *cells in rows}
    assert listed["corners"] == ["", "", "NN-ratio", "see extractors/corners.py"]
    assert listed["colmap_sift"][:2] == ["128", "256"]
    assert listed["sift_nested@24"][:2] == ["24", "48"] and listed["sift_nested"][0] == "64"


def test_a_toy_matcher_matches_some_rows():
    matcher = matchers.load({"name": "in_order", "number": 3})
    features = {"descriptors": torch.eye(5)}
    matches = matcher.match_rows(features, features, torch.tensor([0, 2, 4]))
    assert matches.tolist() == [[0, 0], [2, 2]]


@pytest.mark.parametrize("do_mutual_check", [True, False])
def test_nearest_neighbors_of_some_rows(do_mutual_check):
    torch.manual_seed(0)
    descriptors = torch.nn.functional.normalize(torch.randn(2, 60, 4), dim=2)
    conf = {"name": "nearest_neighbor", "do_mutual_check": do_mutual_check, "ratio_threshold": 0.95}
    matcher = matchers.load(conf)
    pair = [{"descriptors": one.T} for one in descriptors]
    matches0 = matcher.match([pair])[0][0]
    rows = torch.arange(0, 60, 2)
    expected = {(i, int(j)) for i, j in enumerate(matches0) if j >= 0 and j % 2 == 0}
    found = {tuple(pair) for pair in matcher.match_rows(*pair, rows).tolist()}
    assert found == expected and len(found) > 5


def test_a_conf_of_hlocs_is_taken_word_for_word(tmp_path):
    conf = {
        "output": "matches-NN-mutual-dist.7",
        "model": {"name": "nearest_neighbor", "do_mutual_check": True, "distance_threshold": 0.7},
    }
    assert matchers.load(conf["model"]).conf["distance_threshold"] == 0.7


def test_a_toy_retrieval_in_a_map(place, tmp_path, run, refused):
    """It sees images only: it needs no vocabulary, and no local descriptors."""
    build, images, outputs = place
    photos = images / "query/day"
    given = (*build, "--feature", "colmap_sift_sv32", "--retrieval", "thumbnail")
    run(*given, "--query_images", photos)
    built = maps.Map(outputs / "map")
    assert built.retrieval == "thumbnail" and built.vocabulary is None
    assert built.descriptors.name == "global-feats-thumbnail_feats-dog-colmap_sift_sv32.h5"
    assert not list(built.folder.glob("*vocabulary*"))
    summary, rows = outcome(outputs / "queries-day")
    assert summary["retrieval"] == "thumbnail" and summary["poses"].endswith("_thumbnail50.txt")
    assert rows["a.png"]["status"] == "localized"
    file = tmp_path / "place.hlm"
    compact.main(file, outputs / "map")
    with safe_open(file, "np") as opened:
        assert '"retrieval":"thumbnail"' in opened.metadata()["map"]
        assert "vocabulary" not in {*opened.keys()}
    for path in (outputs / "map", file):
        pose, info = Localizer(path).localize(photos / "a.png")
        assert pose is not None and info["retrieved"][0] == rows["a.png"]["retrieved"]
    run("--map", file, "--query_images", photos, "--outputs", tmp_path / "unpacked")
    assert maps.Map(tmp_path / "unpacked/map").retrieval == "thumbnail"
    _, of_file = outcome(tmp_path / "unpacked/queries-day")
    assert of_file["a.png"]["status"] == "localized"
    assert of_file["a.png"]["retrieved"] == rows["a.png"]["retrieved"]
    other = ("--map", outputs / "map", "--outputs", tmp_path, "--retrieval", "vlad")
    assert "was built with --retrieval thumbnail" in refused(*other)
    assert "differs: retrieval" in refused(*build, "--feature", "colmap_sift_sv32")


def test_a_map_with_a_toy_retrieval_grows(place, tmp_path, run):
    (_, model, *_), images, outputs = place
    names = [f"db/{i}.png" for i in range(4)]
    part = colmap.write_part(model, set(names[:3]), tmp_path / "part")
    run("--map", part, "--map_images", images, "--outputs", outputs, "--retrieval", "thumbnail")
    (tmp_path / "new/db").mkdir(parents=True)
    (tmp_path / "new" / names[3]).write_bytes((images / names[3]).read_bytes())
    built = maps.add(maps.Map(outputs / "map"), tmp_path / "new", model)
    assert built.names() == names and built.retrieval == "thumbnail"
    rows = read_global(built.descriptors, names)
    assert rows.shape == (4, 8 * 8 * 3)
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, atol=1e-3)


@pytest.mark.parametrize("is_compact", [False, True])
def test_a_toy_retrieval_in_the_pipeline_of_aachen(aachen_layout, tmp_path, is_compact):
    found = aachen.main(
        aachen_layout,
        tmp_path / "outputs",
        "colmap_sift_sv32",
        retrieval="thumbnail",
        compact=is_compact,
    )
    assert found["queries_localized"] == 2
    results = tmp_path / "outputs/compact" if is_compact else tmp_path / "outputs"
    lines = (results / "pairs-query-thumbnail50.txt").read_text().splitlines()
    assert len(lines) == 3 * 4


def test_a_retrieval_by_images_reads_no_local_descriptors(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
    with h5py.File(tmp_path / "features.h5", "w") as file:
        file["a.png/keypoints"] = np.zeros((0, 2), np.float32)
    features = tmp_path / "features.h5"
    found = aggregate_features.main(THUMBNAIL, features, image_dir=tmp_path)
    assert read_global(found, ["a.png"]).shape == (1, 192)
    with pytest.raises(InputError, match="needs the images"):
        aggregate_features.main(THUMBNAIL, features)


@pytest.mark.parametrize("storage", ["float16", "uint4"])
def test_a_toy_matcher_of_keypoints_in_a_map(storage, place, tmp_path, run):
    """In files, in memory, and with the keypoints of a compact map: projections of its points."""
    build, images, outputs = place
    photos = images / "query/day"
    given = ("--feature", "colmap_sift_sv32", "--matcher", "in_plane", "--storage", storage)
    run(*build, *given, "--query_images", photos)
    _, rows = outcome(outputs / "queries-day")
    row = rows["a.png"]
    assert row["status"] == "localized" and int(row["num_inliers"]) > 100
    file = tmp_path / "place.hlm"
    compact.main(file, outputs / "map", storage=storage)
    pose, info = Localizer(outputs / "map").localize(photos / "a.png")
    assert info["num_matches"] == int(row["num_matches"])
    pose_in_file, info = Localizer(file).localize(photos / "a.png")
    assert max(pose_error(pose, pose_in_file)) < 0.1 and info["num_inliers"] > 100
    run("--map", file, "--query_images", photos, "--outputs", tmp_path / "unpacked")
    _, of_file = outcome(tmp_path / "unpacked/queries-day")
    assert of_file["a.png"]["status"] == "localized"
    assert int(of_file["a.png"]["num_matches"]) == info["num_matches"]


def test_only_what_a_matcher_needs_is_read(tmp_path):
    with h5py.File(tmp_path / "features.h5", "w") as file:
        for name in "ab":
            file[f"{name}/descriptors"] = np.eye(4, dtype=np.float16)
            file[f"{name}/keypoints"] = np.eye(4, 2, dtype=np.float32)
    write_pairs([("a", "b")], tmp_path / "pairs.txt")
    given = tmp_path / "pairs.txt", tmp_path / "features.h5"
    conf = matchers_confs.confs["NN-mutual"]
    match_features.main(conf, *given, matches=tmp_path / "m.h5")
    message = "in_plane needs image_size, which the features in .*features.h5 do not have"
    with pytest.raises(InputError, match=message):
        match_features.main(IN_PLANE, *given, matches=tmp_path / "n.h5")


def test_compact_maps_have_no_scores(place, tmp_path, run, refused, monkeypatch):
    """A matcher that needs them is refused before any work."""
    build, *_, outputs = place
    given = (*build, "--feature", "colmap_sift_sv32", "--matcher", "in_plane")
    run(*given)
    compact.main(tmp_path / "place.hlm", outputs / "map")
    needed = ("scores0", "scores1")
    monkeypatch.setattr(matchers.find(IN_PLANE["model"]), "required_inputs", needed)
    message = "in_plane, which needs scores of keypoints"
    for use in (
        lambda: Localizer(tmp_path / "place.hlm"),
        lambda: compact.main(tmp_path / "other.hlm", outputs / "map"),
        lambda: aachen.Options(matcher="in_plane", compact=True),
    ):
        with pytest.raises(InputError, match=message):
            use()
    assert message in refused(*given, "--compact", tmp_path / "other.hlm")
    assert not (tmp_path / "other.hlm").exists()


def test_a_toy_retrieval_in_a_batch(aachen_layout, run_batch):
    """Jobs share what each retrieval finds."""
    features = ["colmap_sift_sv32", "colmap_sift_sv16"]
    grid = {"dataset": str(aachen_layout), "feature": features, "retrieval": ["vlad", "thumbnail"]}
    outputs = run_batch(grid)
    rows = command.table(outputs / "jobs.csv")
    assert not any(row["error"] for row in rows)
    assert {row["job"] for row in rows} == {*features, *(f"{name}+thumbnail" for name in features)}
    shared = outputs / aachen_layout.name / "shared"
    pairs = {str(path.relative_to(shared)) for path in shared.rglob("pairs-query-*.txt")}
    stem = "feats-dog-colmap_sift_sv32"
    assert pairs == {f"{name}_{stem}/pairs-query-{name}50.txt" for name in ("vlad", "thumbnail")}


def test_a_map_of_a_database_without_photos_needs_local_descriptors(tmp_path, refused):
    given = ("--map", tmp_path, "--database", tmp_path / "database.db", "--outputs", tmp_path / "o")
    message = refused(*given, "--retrieval", "thumbnail")
    assert "--retrieval thumbnail needs the photos of the map: --map_images" in message


def test_a_file_of_pairs_for_queries_in_a_map(place, tmp_path, run, refused):
    """As hloc's lists of the data sets; the map keeps its own retrieval."""
    build, images, outputs = place
    photos = images / "query/day"
    pairs = command.write(tmp_path / "pairs-query-mine50.txt", "a.png db/2.png\na.png db/1.png\n")
    given = (*build, "--feature", "colmap_sift_sv32", "--query_images", photos)
    run(*given, "--retrieval", pairs)
    summary, rows = outcome(outputs / "queries-day")
    assert rows["a.png"]["status"] == "localized" and rows["a.png"]["retrieved"] == "db/2.png"
    assert summary["retrieval"] == str(pairs) and summary["poses"].endswith("_mine50.txt")
    assert maps.Map(outputs / "map").retrieval == "vlad"
    assert "differs: retrieval" in refused(*given)
    assert "neither vlad nor an existing file" in refused(*given, "--retrieval", "vald")
