"""Queries of a scene whose poses are known."""

import json
import shutil
import sys

import h5py
import numpy as np
import pytest
import small_map
import torch
from small_map import MATCHER

from hloc_reduce import localize_sfm, match_features
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.localization import query, stage
from hloc_reduce.localization.gate import DEFAULT_GATE, Gate
from hloc_reduce.localization.records import log_file, pose_of, read_records
from hloc_reduce.localization.references import SfmMap
from hloc_reduce.runtime.group_writer import FAILURE
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.feature_files import dimension
from hloc_reduce.utils.h5 import list_h5_names
from hloc_reduce.utils.parsers import parse_poses, write_pairs


def test_queries_are_localized_exactly(built):
    records = built.localize()
    for name, record in records.items():
        assert record["localized"] and record["num_inliers"] == 300
        assert record["num_matches"] == 6 * 300 and record["db"] == "db/0.jpg"
        metres, degrees = pose_error(pose_of(record), built.poses[name])
        assert metres < 1e-4 and degrees < 1e-2
    lines = (built.root / "poses.txt").read_text().splitlines()
    assert [line.split()[0] for line in lines] == ["6.jpg", "7.jpg"]
    written = parse_poses(built.root / "poses.txt")["6.jpg"]
    assert max(pose_error(written, built.poses["query/6.jpg"])) < 1e-2


def test_photos_of_12_megapixels_are_localized_as_those_of_2(scene):
    """Their keypoints are found in photos of 1,600 pixels, too: all limits are in these pixels."""
    small_map.enlarge(scene, 2.5, 0.8)  # 1600 x 1200 pixels, a noise of 2
    points, records = small_map.build(scene).map.num_points3D(), scene.localize()
    small_map.enlarge(scene, 2.5, 0.0)  # the same noise is one of 5 pixels
    assert small_map.build(scene).map.num_points3D() == points
    for name, record in scene.localize().items():
        assert record["max_error"] == 2.5 * records[name]["max_error"] == 30
        assert record["num_inliers"] == records[name]["num_inliers"] > 250
        metres, degrees = pose_error(pose_of(record), pose_of(records[name]))
        # the refinement's robust loss is in pixels of the photo
        assert metres < 0.02 and degrees < 0.3


def test_localization_is_resumed_and_repeated_exactly(built):
    first = built.localize()
    poses = (built.root / "poses.txt").read_bytes()
    log = built.root / "poses.txt_logs.jsonl"
    lines = log.read_text().splitlines(keepends=True)
    log.write_text("".join(lines[:2]) + lines[2][: len(lines[2]) // 2])  # killed while writing
    assert built.localize() == first
    assert (built.root / "poses.txt").read_bytes() == poses
    assert log.read_text().splitlines(keepends=True) == lines
    assert built.localize(overwrite=True) == first
    assert built.localize(reference_sfm=built.map) == first


def test_poses_do_not_depend_on_the_number_of_cores(built):
    threads, records = torch.get_num_threads(), []
    for number in (1, 3):
        torch.set_num_threads(number)
        records.append(built.localize(overwrite=True))
    torch.set_num_threads(threads)
    assert records[0] == records[1]


def test_clusters_of_covisible_images_are_solved_by_themselves(built):
    """Half of the points are seen by one half of the map, the others by the other."""
    for image in built.map.images.values():
        late = int(image.name[3]) > 2
        for index, point in enumerate(built.seen[image.name]):
            if (point < 120) == late:
                built.map.delete_observation(image.image_id, index)
    names = [f"db/{i}.jpg" for i in (5, 1, 3, 0, 2)]
    clusters = [["db/1.jpg", "db/0.jpg", "db/2.jpg"], names[0:3:2]]
    assert SfmMap(built.map, True).clusters(names) == clusters
    assert SfmMap(built.map).clusters(names) == [names]
    whole = built.localize(reference_sfm=built.map)["query/6.jpg"]
    part = built.localize(reference_sfm=built.map, covisibility_clustering=True)["query/6.jpg"]
    assert (whole["num_inliers"], part["num_inliers"]) == (300, 180)
    assert (whole["num_matches"], part["num_matches"]) == (900, 540)
    assert part["db"] == "db/3.jpg" and part["localized"]  # of the cluster


def test_other_options_are_not_answered_from_the_log(built):
    exact = built.localize()
    strict = built.localize(ransac_thresh=1e-5)
    assert strict["query/6.jpg"]["num_inliers"] < exact["query/6.jpg"]["num_inliers"]


def test_hopeless_queries_fall_back_and_say_so(built):
    """No features, no retrieved image, wrong matches: each gets a line, none is localized."""
    with h5py.File(built.features, "a") as file:
        for i, number in ((8, 0), (9, 40), (10, 40)):
            group = file.create_group(f"query/{i}.jpg")
            generator = np.random.default_rng(i)
            group["keypoints"] = generator.uniform(0, 400, (number, 2)).astype(np.float32)
    generator = np.random.default_rng(0)
    with h5py.File(built.loc_matches, "a") as file:
        file["query-8.jpg/db-3.jpg/matches0"] = np.zeros(0, np.int32)
        file["query-8.jpg/db-3.jpg/matching_scores0"] = np.zeros(0, np.float16)
        file["query-10.jpg/db-3.jpg/matches0"] = generator.permutation(300)[:40].astype(np.int32)
        file["query-10.jpg/db-3.jpg/matching_scores0"] = np.ones(40, np.float16)
    with built.loc_pairs.open("a") as file:
        file.write("query/8.jpg db/3.jpg\nquery/10.jpg db/3.jpg\n")
    with built.queries.open("a") as file:
        for i in (8, 9, 10):
            file.write(f"query/{i}.jpg SIMPLE_RADIAL 640 480 500 320 240 0.02\n")
    records = built.localize(ransac_thresh=3)
    for i, db in ((8, "db/3.jpg"), (9, None), (10, "db/3.jpg")):
        record = records[f"query/{i}.jpg"]
        assert not record["localized"] and record["db"] == db, record
        pose = built.poses[db or "db/0.jpg"]
        assert max(pose_error(pose_of(record), pose)) < 1e-6
    assert records["query/8.jpg"]["num_inliers"] == 0
    assert records["query/10.jpg"]["num_matches"] == 40
    assert len((built.root / "poses.txt").read_text().splitlines()) == 5


def test_three_inliers_are_no_localization(built):
    with h5py.File(built.loc_matches, "a") as file:
        for i in range(6):
            matches = file[f"query-6.jpg/db-{i}.jpg/matches0"]
            values = matches[:]
            kept = np.isin(built.seen["query/6.jpg"], [0, 1, 2])
            matches[:] = np.where(kept, values, -1)
    record = built.localize()["query/6.jpg"]
    assert record["num_matches"] == 18 and not record["localized"]


def test_missing_inputs_are_named(built):
    with pytest.raises(InputError, match="not in the match file"):
        write_pairs([("query/6.jpg", "db/0.jpg")], built.root / "other.txt")
        built.localize(retrieval=built.root / "other.txt", matches=built.matches)
    with pytest.raises(InputError, match="above 0"):
        built.localize(ransac_thresh=-3)
    with pytest.raises(InputError, match="absent.h5"):
        built.localize(features=built.root / "absent.h5")
    with pytest.raises(InputError, match="no COLMAP model folder"):
        built.localize(reference_sfm=built.root / "absent")
    write_pairs([("db/0.jpg", "db/99.jpg")], built.pairs)
    with pytest.raises(InputError, match="db/99.jpg is not in the reference model"):
        built.triangulate()
    with pytest.raises(InputError, match="db/99.jpg is not in the file"):
        match_features.main(MATCHER, built.pairs, built.features, matches=built.matches)
    shutil.rmtree(built.model)
    built.model.mkdir()
    (built.model / "cameras.bin").write_bytes(b"\x01")
    with pytest.raises(InputError, match="not a COLMAP model"):
        colmap.read_model(built.model)


def test_matches_of_other_features_are_refused(built):
    with h5py.File(built.features, "a") as file:
        for name in ("query/6.jpg", "db/0.jpg"):
            kept = {"keypoints": file[name]["keypoints"][:200]}
            kept["descriptors"] = file[name]["descriptors"][:, :200]
            for key, array in kept.items():
                del file[name][key]
                file[name][key] = array
    with pytest.raises(InputError, match="belong to other features: query/6.jpg has only 200"):
        built.localize()
    with pytest.raises(InputError, match="belong to other features: db/0.jpg has only 200"):
        built.triangulate()


def test_a_query_that_cannot_be_localized_says_why(built):
    """Its photo could not be read, or is of another size; or nothing was retrieved for it."""
    with h5py.File(built.features, "r+") as file:
        file["query/6.jpg/image_size"] = np.array([480, 640])
    records = built.localize()
    wrong, right = records["query/6.jpg"], records["query/7.jpg"]
    assert right["localized"] and right["reason"] is None
    assert wrong["reason"] == "the intrinsics are for 640x480 pixels, the photo has 480x640"
    assert not wrong["localized"] and wrong["db"] == "db/0.jpg" and wrong["num_inliers"] == 0
    with h5py.File(built.features, "r+") as file:
        file["query/6.jpg"].attrs["failure"] = "Cannot read image query/6.jpg: it is empty."
    records = built.localize()
    assert records["query/6.jpg"]["reason"] == "Cannot read image query/6.jpg: it is empty."
    assert records["query/7.jpg"] == right
    cameras = [("query/6.jpg", None), ("query/7.jpg", None)]
    records = built.localize(queries=cameras)
    assert records["query/7.jpg"]["reason"] == "its intrinsics are not known"
    assert records["query/7.jpg"]["camera"] is None
    pairs = [("query/6.jpg", "db/0.jpg")]
    write_pairs(pairs, built.loc_pairs)
    assert built.localize()["query/7.jpg"]["reason"] == "no map image was retrieved"


def test_the_command_line_of_localization(built, monkeypatch):
    """Its options reach the stage."""
    options = {
        "reference_sfm": built.sfm,
        "queries": built.queries,
        "retrieval": built.loc_pairs,
        "features": built.features,
        "matches": built.loc_matches,
        "results": built.root / "by_command.txt",
        "min_inliers": 301,
    }
    words = [word for key, value in options.items() for word in (f"--{key}", str(value))]
    monkeypatch.setattr(sys, "argv", ["localize_sfm", *words])
    cli.run(localize_sfm._main)
    records = read_records(log_file(options["results"]))
    assert {record["reason"] for record in records.values()} == {
        "too few inliers: 300, at least 301 are needed"
    }


@pytest.mark.parametrize(
    ("conf", "name", "kind"),
    [
        ("NN-ratio", None, "ratio"),
        ("NN-mutual", None, "mutual"),
        (None, "feats-sift_matches-NN-mutual-ratio.8_pairs-query-netvlad20.h5", "ratio"),
        (None, "feats-sift_matches-NN-mutual_pairs-query-netvlad20.h5", "mutual"),
        (None, "feats-sift_matches-superglue_pairs-query-netvlad20.h5", "lightglue"),
    ],
)
def test_the_gate_knows_the_matcher_by_its_file(built, conf, name, kind, monkeypatch):
    """Match files of hloc say only by their names which matcher made them."""
    if conf is None:
        with h5py.File(built.loc_matches, "r+") as file:
            del file.attrs["conf"]
        built.loc_matches = built.loc_matches.rename(built.loc_matches.with_name(name))
    else:
        conf = match_features.confs[conf]
        match_features.main(
            conf, built.loc_pairs, built.features, matches=built.loc_matches, overwrite=True
        )
    gates, localize = [], query.localize
    monkeypatch.setattr(stage, "localize", lambda *a: gates.append(a[5]) or localize(*a))
    assert built.localize()["query/6.jpg"]["localized"]
    assert {gate.match_kind for gate in gates} == {kind}


def test_matches_of_unknown_origin_need_a_kind(built):
    """Instead of the limits of another matcher."""
    with h5py.File(built.loc_matches, "r+") as file:
        del file.attrs["conf"]
    message = "does not say which matcher made it, nor does its name: give --match_kind, ratio or "
    with pytest.raises(InputError, match=message):
        built.localize()
    assert built.localize(gate=Gate(match_kind="ratio"))["query/6.jpg"]["localized"]
    with pytest.raises(InputError, match="The matcher new has no limits .* add `match_kind` to"):
        DEFAULT_GATE.of_matches({"name": "new"}, 64)


def test_images_without_descriptors_are_skipped(built):
    """As those that could not be read, or those of features that are matched otherwise."""
    with h5py.File(built.features, "r+") as file:
        del file["db/0.jpg/descriptors"]
        file["db/1.jpg"].attrs["failure"] = "Cannot read it."
    assert dimension(built.features) == 64
    assert built.localize()["query/6.jpg"]["localized"]
    with h5py.File(built.features, "r+") as file:
        for name in list_h5_names(built.features):
            file[name].pop("descriptors", None)
    assert dimension(built.features) == 0


def test_queries_that_are_not_localized_are_matched_once_more(built):
    """The first matches of one query are lost, and others cannot be matched."""
    expected = built.localize()
    with h5py.File(built.loc_matches, "a") as file:
        for i in range(6):
            file[f"query-6.jpg/db-{i}.jpg/matches0"][:] = -1
    with built.loc_pairs.open("a") as file:
        file.write("query/8.jpg db/3.jpg\n")
    with h5py.File(built.features, "a") as file:
        file.create_group("query/8.jpg").attrs[FAILURE] = "cannot be read"
        file.copy("query/7.jpg", "query/9.jpg")  # nothing is retrieved for it
    with built.queries.open("a") as file:
        for i in (8, 9):
            file.write(f"query/{i}.jpg SIMPLE_RADIAL 640 480 500 320 240 0.02\n")
    asked = []

    def match(names):
        asked.append(names)
        pairs = small_map.all_pairs(built.root / "pairs-again.txt", names)
        matches = built.root / "matches-again.h5"
        match_features.main(MATCHER, pairs, built.features, matches=matches)
        return stage.Matched(built.features, matches)

    again = [stage.Try(match, {})]
    alone = built.localize()
    assert not alone["query/6.jpg"]["localized"]
    records = built.localize(again=again)
    assert asked == [["query/6.jpg"]]
    told = {"again": True, "try": 1, "tried": 1}
    assert records["query/6.jpg"] == expected["query/6.jpg"] | told
    assert records["query/7.jpg"] == expected["query/7.jpg"]
    assert records["query/8.jpg"]["reason"] == "cannot be read"
    assert records["query/9.jpg"]["reason"] == "no map image was retrieved"
    log = log_file(built.root / "poses.txt")
    lines = log.read_text().splitlines(keepends=True)
    assert built.localize(again=again) == records
    assert log.read_text().splitlines(keepends=True) == lines
    before = log_file(built.root / "poses.txt").read_text()
    first_try = json.dumps(["query/6.jpg", alone["query/6.jpg"]]) + "\n"
    # killed in the second try, between the tries, and in the first one
    for kept in (lines, [first_try if "query/6" in line else line for line in lines], lines[:1]):
        log.write_text("".join(kept))
        assert built.localize(again=again) == records
        assert {*log.read_text().splitlines()} == {*before.splitlines()}
    # another second matcher
    first = stage.Matched(built.features, built.loc_matches)
    other = [stage.Try(lambda names: first, {"model": "other"})]
    assert not built.localize(again=other)["query/6.jpg"]["localized"]


def test_each_further_try_has_the_queries_that_are_left(built):
    """Of two that are lost, one may not be tried by the second try, the other is by the third."""
    expected, asked = built.localize(), []
    with h5py.File(built.loc_matches, "a") as file:
        for name in ("query-6.jpg", "query-7.jpg"):
            for i in range(6):
                file[f"{name}/db-{i}.jpg/matches0"][:] = -1

    def matching(number, pairs_of):
        def match(names):
            asked.append((number, names))
            pairs = small_map.all_pairs(built.root / f"pairs-{number}.txt", pairs_of)
            matches = built.root / f"matches-{number}.h5"
            match_features.main(MATCHER, pairs, built.features, matches=matches)
            return stage.Matched(built.features, matches, pairs)

        return match

    names = ["query/6.jpg", "query/7.jpg"]
    again = [
        stage.Try(matching(1, names), {}, names=frozenset(["query/7.jpg"]), told={"turned": 90}),
        stage.Try(matching(2, names), {}, told={"turned": 180}),
    ]
    records = built.localize(again=again)
    assert asked == [(1, ["query/7.jpg"]), (2, ["query/6.jpg"])]
    for name, turned in (("query/7.jpg", 90), ("query/6.jpg", 180)):
        assert records[name]["localized"] and records[name]["turned"] == turned
        assert records[name]["tvec"] == expected[name]["tvec"]
    assert built.localize(again=again) == records
