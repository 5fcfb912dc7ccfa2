"""The stages on a scene whose answers are known: pairs, matches, map, poses."""

import shutil
import sys

import h5py
import numpy as np
import pycolmap
import pytest
import torch
from command import refused

from hloc_reduce import (
    localize_sfm,
    match_features,
    pairs_from_covisibility,
    pairs_from_retrieval,
    triangulation,
)
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.localization import query, stage
from hloc_reduce.localization.confidence import AGREEMENT, AGREEMENT_RATIO
from hloc_reduce.localization.records import log_file, pose_of, read_records
from hloc_reduce.localization.references import SfmMap
from hloc_reduce.runtime import provenance
from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.feature_files import dimension
from hloc_reduce.utils.h5 import list_h5_names
from hloc_reduce.utils.match_files import get_matches
from hloc_reduce.utils.parsers import parse_pairs, parse_poses, parse_retrieval, write_pairs

MATCHER = match_features.confs["NN-ratio"]


def all_pairs(scene, path, queries=(), skip=()):
    names = [f"db/{i}.jpg" for i in range(6) if i not in skip]
    pairs = [(a, b) for a in queries or names for b in names if a != b]
    write_pairs(pairs, path)
    return path


@pytest.fixture
def built(scene):
    scene.pairs = all_pairs(scene, scene.root / "pairs-db.txt")
    scene.matches = scene.root / "matches-db.h5"
    match_features.main(MATCHER, scene.pairs, scene.features, matches=scene.matches)
    scene.sfm = scene.root / "sfm"
    scene.map = triangulation.main(
        scene.sfm, scene.model, scene.images, scene.pairs, scene.features, scene.matches
    )
    scene.loc_pairs = all_pairs(scene, scene.root / "pairs-loc.txt", ["query/6.jpg", "query/7.jpg"])
    scene.loc_matches = scene.root / "matches-loc.h5"
    match_features.main(MATCHER, scene.loc_pairs, scene.features, matches=scene.loc_matches)
    scene.localize = lambda **overrides: localize_sfm.main(
        **{
            "reference_sfm": scene.sfm,
            "queries": scene.queries,
            "retrieval": scene.loc_pairs,
            "features": scene.features,
            "matches": scene.loc_matches,
            "results": scene.root / "poses.txt",
            **overrides,
        }
    )
    return scene


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


def test_map_is_where_the_points_are(built):
    assert built.map.num_points3D() == 300
    for point in built.map.points3D.values():
        element = point.track.elements[0]
        name = built.map.images[element.image_id].name
        true = built.points[built.seen[name][element.point2D_idx]]
        np.testing.assert_allclose(point.xyz, true, atol=1e-4)


def test_half_a_pixel_would_be_seen(built):
    """The map's keypoints are COLMAP's: the projections themselves, not half a pixel off."""
    image = built.map.find_image_with_name("db/3.jpg")
    errors = [
        np.linalg.norm(p.xy - image.project_point(built.map.points3D[p.point3D_id].xyz))
        for p in image.points2D
        if p.has_point3D()
    ]
    assert len(errors) == 300 and max(errors) < 1e-2


def test_map_is_built_once_and_again_when_its_inputs_change(built, caplog, monkeypatch):
    monkeypatch.setattr(cli.logger, "propagate", True)
    written = (built.sfm / "points3D.bin").stat().st_mtime_ns
    arguments = (built.sfm, built.model, built.images, built.pairs, built.features, built.matches)
    assert triangulation.main(*arguments).num_points3D() == 300
    assert (built.sfm / "points3D.bin").stat().st_mtime_ns == written
    all_pairs(built, built.pairs, skip=[5])
    assert triangulation.main(*arguments).find_image_with_name("db/5.jpg").num_points3D == 0
    assert "1 of 6 photos have no point in the map" in caplog.text and "db/5.jpg." in caplog.text


def test_an_empty_map_is_loud_and_keeps_the_old_one(built):
    with h5py.File(built.matches, "a") as file:
        for pair in list_h5_names(built.matches):
            file[f"{pair}/matches0"][:] = -1
    before = (built.sfm / "points3D.bin").read_bytes()
    arguments = (built.sfm, built.model, built.images, built.pairs, built.features, built.matches)
    with pytest.raises(InputError, match="The map is empty"):
        triangulation.main(*arguments)
    assert (built.sfm / "points3D.bin").read_bytes() == before


def test_matches_off_their_epipolar_lines_are_left_out(built):
    """Matches shifted by one keypoint are wrong; with true poses hardly any passes."""
    with h5py.File(built.matches, "a") as file:
        for pair in list_h5_names(built.matches):
            matches = file[f"{pair}/matches0"]
            matches[:] = np.roll(matches[:], 1)
    try:
        wrong = triangulation.main(
            built.root / "wrong",
            built.model,
            built.images,
            built.pairs,
            built.features,
            built.matches,
        )
        assert wrong.num_points3D() < 10
    except InputError as error:
        assert "empty" in str(error)


def test_matches_of_low_score_are_left_out(built):
    """Those of the first point, which is then in no track."""
    with h5py.File(built.matches, "a") as file:
        for pair in list_h5_names(built.matches):
            seen = built.seen[f"db/{pair[3:4]}.jpg"]
            file[f"{pair}/matching_scores0"][seen == 0] = 0.5
    arguments = (built.model, built.images, built.pairs, built.features, built.matches)
    for score, points in ((0.6, 299), (0.4, 300), (None, 300)):
        sfm = built.root / f"sfm_{score}"
        assert triangulation.main(sfm, *arguments, min_match_score=score).num_points3D() == points


@pytest.mark.parametrize("how", ["skip_geometric_verification", "estimate_two_view_geometries"])
def test_matches_are_verified_otherwise(built, how):
    """A tenth of the matches is wrong: taken as they are, or found out without the known poses."""
    with h5py.File(built.matches, "a") as file:
        for pair in list_h5_names(built.matches):
            matches = file[f"{pair}/matches0"][:]
            matches[:30] = np.roll(matches[:30], 1)
            file[f"{pair}/matches0"][:] = matches
    arguments = (built.model, built.images, built.pairs, built.features, built.matches)
    triangulation.main(built.root / "other", *arguments, **{how: True})
    with pycolmap.Database.open(built.root / "other/database.db") as database:
        verified = database.num_inlier_matches() / database.num_matches()
    if how == "skip_geometric_verification":
        assert verified == 1
    else:
        assert 0.85 < verified < 0.95


def test_old_model_without_rigs(built):
    for name in ("rigs.bin", "frames.bin"):
        (built.model / name).unlink()
    again = triangulation.main(
        built.root / "sfm2", built.model, built.images, built.pairs, built.features, built.matches
    )
    assert again.num_points3D() == 300


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


def test_descriptors_in_memory_are_bounded(tmp_path):
    path = tmp_path / "f.h5"
    with GroupWriter(path, {}) as writer:
        for name in "abcd":
            writer.add(name, {"descriptors": np.full((4, 10), ord(name), np.float16)})
    with h5py.File(path) as file:
        read = match_features.DescriptorCache(max_bytes=2 * 4 * 10 * 4)
        first = read(file, "a")
        assert first.shape == (10, 4) and first.flags["C_CONTIGUOUS"]
        read(file, "b")
        assert read(file, "a") is first  # and is the last one used now
        read(file, "c")
        assert read(file, "a") is first
        assert {name for _, name in read.kept} == {"a", "c"} and read.bytes == 320
        assert read(file, "d")[0, 0] == ord("d")
        small = match_features.DescriptorCache(max_bytes=1)
        assert small(file, "a")[0, 0] == ord("a") and small(file, "b")[0, 0] == ord("b")
        assert len(small.kept) == 1


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
        triangulation.main(
            built.sfm, built.model, built.images, built.pairs, built.features, built.matches
        )
    with pytest.raises(InputError, match="db/99.jpg is not in the file"):
        match_features.main(MATCHER, built.pairs, built.features, matches=built.matches)
    shutil.rmtree(built.model)
    built.model.mkdir()
    (built.model / "cameras.bin").write_bytes(b"\x01")
    with pytest.raises(InputError, match="not a COLMAP model"):
        colmap.read_model(built.model)


def test_what_is_no_map_is_not_replaced(built, tmp_path):
    folder = tmp_path / "precious"
    folder.mkdir()
    (folder / "thesis.txt").write_text("years of work")
    arguments = (built.model, built.images, built.pairs, built.features, built.matches)
    for target in (folder, built.model):
        with pytest.raises(InputError, match="not a map that this program"):
            triangulation.main(target, *arguments)
    assert (folder / "thesis.txt").exists()


def test_a_map_of_hlocs_is_replaced(built):
    """Such as its empty one with pycolmap 4.2.1, but not one of other files."""
    arguments = (built.model, built.images, built.pairs, built.features, built.matches)
    sfm = built.root / "hlocs"
    sfm.mkdir()
    for name in ("database.db", "cameras.bin", "images.bin", "points3D.bin"):
        (sfm / name).write_bytes(b"")
    (sfm / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="not replaced. Choose another folder"):
        triangulation.main(sfm, *arguments)
    (sfm / "notes.txt").unlink()
    assert triangulation.main(sfm, *arguments).num_points3D() == 300
    with pytest.raises(InputError, match="not replaced"):
        triangulation.main(built.model, *arguments, overwrite=True)


def test_wrong_mapper_options_are_refused_first(built):
    arguments = (built.model, built.images, built.pairs, built.features, built.matches)
    with pytest.raises(InputError, match="mapper options .*no_such"):
        triangulation.main(built.root / "new", *arguments, mapper_options={"no_such": 1})
    assert not (built.root / ".new.tmp").exists()


def test_overflowed_matches_are_refused(built):
    """hloc's int16, which wraps to negative numbers."""
    with h5py.File(built.matches, "a") as file:
        file["db-0.jpg/db-1.jpg/matches0"][:5] = -200
    arguments = (built.model, built.images, built.pairs, built.features, built.matches)
    with pytest.raises(InputError, match="negative, as happens to hloc"):
        triangulation.main(built.root / "new", *arguments)


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
        triangulation.main(
            built.sfm, built.model, built.images, built.pairs, built.features, built.matches
        )


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


@pytest.mark.parametrize("block", [1, 256])
def test_covisibility_by_hand(monkeypatch, block):
    monkeypatch.setattr(pairs_from_covisibility, "BLOCK", block)
    # image 0 sees point 9 twice, so that it shares 2 with 1, 3 with 2, which share 1; 4 is as 1
    ids = [[7, -1, 9, 9], [9, -1], [7, 9, 4], [-1], [9, -1]]
    ranking = pairs_from_covisibility.most_covisible(map(np.array, ids), 10)
    assert [row.tolist() for row in ranking] == [[2, 1, 4], [0, 2, 4], [0, 1, 4], [], [0, 1, 2]]
    ranking = pairs_from_covisibility.most_covisible(map(np.array, ids), 1)
    assert [row.tolist() for row in ranking] == [[2], [0], [0], [], [0]]


def test_covisible_pairs_of_the_map(built, tmp_path):
    with pytest.raises(InputError, match="no covisible images"):
        pairs_from_covisibility.main(built.model, tmp_path / "p.txt", 2)
    pairs = parse_retrieval(pairs_from_covisibility.main(built.sfm, tmp_path / "p.txt", 2))
    assert {name: len(others) for name, others in pairs.items()} == {
        f"db/{i}.jpg": 2 for i in range(6)
    }


@pytest.mark.parametrize("block", [1, 2, 2**26])
def test_retrieval_ranks_by_similarity(tmp_path, monkeypatch, block):
    monkeypatch.setattr(pairs_from_retrieval, "BLOCK_BYTES", block * 3 * 4)
    monkeypatch.setattr(pairs_from_retrieval, "QUERIES", 1)
    path = tmp_path / "global.h5"
    vectors = {
        "q/0": [1, 0, 0],
        "q/blank": [0, 0, 0],
        "db/same": [1, 0, 0],
        "db/near": [0.8, 0.6, 0],
        "db/opposite": [-1, 0, 0],
        "db/blank": [0, 0, 0],
    }
    with h5py.File(path, "w") as file:
        for name, vector in vectors.items():
            file[f"{name}/global_descriptor"] = np.array(vector, np.float16)
    output = tmp_path / "pairs.txt"
    arguments = {"query_prefix": "q/", "db_prefix": "db/"}
    pairs_from_retrieval.main(path, output, 10, **arguments)
    retrieval = parse_retrieval(output)
    assert retrieval["q/0"] == ["db/same", "db/near", "db/opposite", "db/blank"]
    # as similar as others, in the order of the names
    assert retrieval["q/blank"] == ["db/near", "db/opposite", "db/same", "db/blank"]
    pairs_from_retrieval.main(path, output, 2)
    retrieval = parse_retrieval(output)
    assert all(name not in others and len(others) == 2 for name, others in retrieval.items())
    with pytest.raises(InputError, match="db/none is not in"):
        pairs_from_retrieval.main(path, output, 2, query_prefix="q/", db_list=["db/none"])
    with pytest.raises(InputError, match="No image is selected"):
        pairs_from_retrieval.main(path, output, 2, query_prefix="x/")


def test_stamps_notice_changes(tmp_path):
    source, file = tmp_path / "source", tmp_path / "stamp.json"
    source.write_text("a")
    made_from = provenance.of_inputs({"x": (1, 2)}, [source])
    assert not provenance.is_current(file, made_from)
    provenance.write(file, made_from)
    assert provenance.is_current(file, made_from)
    assert not provenance.is_current(file, provenance.of_inputs({"x": (1, 3)}, [source]))
    source.write_text("ab")
    assert not provenance.is_current(file, provenance.of_inputs({"x": (1, 2)}, [source]))


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
    ("conf", "agreement"),
    [("NN-ratio", AGREEMENT_RATIO), ("NN-mutual", AGREEMENT), (None, AGREEMENT)],
)
def test_the_gate_knows_the_matcher_by_its_file(built, conf, agreement, monkeypatch):
    """Match files of hloc do not say which matcher made them."""
    if conf is None:
        with h5py.File(built.loc_matches, "r+") as file:
            del file.attrs["conf"]
    else:
        conf = match_features.confs[conf]
        match_features.main(
            conf, built.loc_pairs, built.features, matches=built.loc_matches, overwrite=True
        )
    gates, localize = [], query.localize
    monkeypatch.setattr(stage, "localize", lambda *a: gates.append(a[-1]) or localize(*a))
    assert built.localize()["query/6.jpg"]["localized"]
    assert {gate.min_agreement for gate in gates} == {agreement}


def test_the_gate_skips_images_without_descriptors(built, monkeypatch):
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


def test_photos_of_another_size_than_the_model_are_named(built, caplog, monkeypatch):
    monkeypatch.setattr(cli.logger, "propagate", True)
    with h5py.File(built.features, "r+") as file:
        file["db/0.jpg/image_size"] = np.array([320, 240])
    arguments = (built.sfm, built.model, built.images, built.pairs, built.features, built.matches)
    triangulation.main(*arguments)
    assert "1 of" in caplog.text and "db/0.jpg (320x240, its camera 640x480)" in caplog.text
