"""A map of one's own: built once, localized in by files and in memory; reconstruction."""

import json
import os
import shutil
import sys
from pathlib import Path

import command
import cv2
import numpy as np
import pycolmap
import pytest
from command import outcome

from hloc_reduce import (
    Localizer,
    maps,
    match_features,
    pairs_from_verification,
    projections,
    reconstruction,
)
from hloc_reduce.confs import features as features_confs
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.localization.records import pose_of
from hloc_reduce.runtime.outputs import LOCK
from hloc_reduce.training import tracks
from hloc_reduce.training.__main__ import parse_maps
from hloc_reduce.utils import cli, colmap, parsers
from hloc_reduce.utils.cli import InputError
from pipelines import aachen, localize

LISTS = "*_time_queries_with_intrinsics.txt"


def run(monkeypatch, *arguments):
    command.run(monkeypatch, localize, *arguments)


def refused(monkeypatch, caplog, *arguments):
    return command.refused(monkeypatch, caplog, localize, *arguments)


@pytest.fixture(autouse=True)
def propagated(monkeypatch):
    monkeypatch.setattr(cli.logger, "propagate", True)  # for caplog


def state(folder):
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != LOCK)
    return {path: path.stat().st_mtime_ns for path in files}


@pytest.fixture
def place(aachen_layout, tmp_path):
    """The options that build a map of the plane, and the folder of its outputs."""
    model, images = aachen_layout / "3D-models/aachen_v_1_1", aachen_layout / "images_upright"
    outputs = tmp_path / "outputs"
    build = ("--map", model, "--map_images", images, "--outputs", outputs)
    return build, images, outputs


def test_the_same_as_the_pipeline_of_aachen(place, aachen_layout, tmp_path, monkeypatch, capsys):
    """And the same one photo at a time."""
    build, images, outputs = place
    queries = aachen_layout / "queries" / LISTS
    truth = aachen_layout / "queries/ground_truth_poses.txt"
    new = ("--queries", queries, "--query_images", images, "--ground_truth", truth)
    run(monkeypatch, *build, *new, "--feature", "sift_sv24")
    summary, rows = outcome(outputs / "queries-time_queries_with_intrinsics")
    assert summary["intrinsics"] == {"list": 3} and summary["feature"] == "sift_sv24"
    assert "100.0 / 100.0 / 100.0" in capsys.readouterr().out

    place = ("--dataset", aachen_layout, "--outputs", tmp_path / "aachen")
    monkeypatch.setattr(sys, "argv", ["aachen", *map(str, place), "--feature", "sift_sv24"])
    cli.run(aachen._main)
    expected = outcome(tmp_path / "aachen")[1]
    assert rows == expected and rows["query/day/a.png"]["status"] == "localized"

    localizer = Localizer(outputs / "map")
    poses = parsers.parse_poses(outputs / "queries-time_queries_with_intrinsics" / summary["poses"])
    for name, camera in [q for part in parsers.parse_query_lists(queries).values() for q in part]:
        pose, info = localizer.localize(images / name, camera)
        row = rows[name]
        for key in ("num_matches", "num_correspondences", "num_inliers"):
            assert info[key] == int(row[key])
        assert info["confidence"] == float(row["confidence"])
        assert (info["reason"] or "") == row["reason"]
        assert info["retrieved"][0] == row["retrieved"] and info["intrinsics"] == "given"
        if row["status"] == "localized":
            assert max(pose_error(pose, poses[name])) < 1e-9
            assert len(info["points2D"]) == len(info["points3D"]) == info["num_correspondences"]
            assert info["inliers"].sum() == info["num_inliers"]
            projected = camera.img_from_cam(
                info["points3D"] @ pose.rotation.matrix().T + pose.translation
            )
            errors = np.linalg.norm(projected - info["points2D"], axis=1)
            assert errors[info["inliers"]].max() < 12
        else:
            assert pose is None and info["num_inliers"] == 0


def test_a_map_is_built_once(place, monkeypatch, caplog, capsys):
    build, images, outputs = place
    run(monkeypatch, *build)
    assert "Localize photos in it with --query_images" in capsys.readouterr().out
    before = state(outputs / "map")
    for folder in ("query/day", "query/night"):
        run(monkeypatch, *build, "--query_images", images / folder)
    assert state(outputs / "map") == before
    summary, rows = outcome(outputs / "queries-day")
    assert set(rows) == {"a.png", "grey.png"} and summary["intrinsics"] == {"guess": 2}
    # a second run computes nothing, and writes no file anew
    day = state(outputs / "queries-day")
    run(monkeypatch, *build, "--query_images", images / "query/day")
    assert state(outputs / "queries-day") == day

    # it may be moved, and used without what it was built from
    moved = outputs.parent / "moved"
    (outputs / "map").rename(moved)
    shutil.move(images / "db", outputs.parent / "db")
    run(
        monkeypatch,
        *("--map", moved, "--query_images", images / "query/day", "--outputs", outputs),
        *("--feature", "colmap_sift_sv64"),
    )
    assert outcome(outputs / "queries-day")[0]["map"] == str(moved)
    given = ("--map", moved, "--outputs", outputs)
    message = refused(monkeypatch, caplog, *given, "--feature", "sift_sv32")
    assert "is of --feature colmap_sift_sv64." in message
    message = refused(monkeypatch, caplog, *given, "--matcher", "NN-mutual")
    assert "was built with --matcher NN-ratio." in message
    message = refused(
        monkeypatch, caplog, "--map", moved, "--outputs", outputs, "--map_images", images
    )
    assert "leave out --map_images" in message


def test_what_has_changed_is_noticed(place, aachen_layout, monkeypatch, caplog):
    build, images, outputs = place
    new = ("--query_images", images / "query/day")
    run(monkeypatch, *build, *new)
    before, results = state(outputs / "map"), state(outputs / "queries-day")
    message = refused(monkeypatch, caplog, *build, "--feature", "sift_sv16")
    assert "differs: feature (model, projection_sha256)" in message and "--overwrite" in message
    photo = images / "db/2.png"
    os.utime(photo, ns=(0, 0))  # copied, say: its content is what counts
    run(monkeypatch, *build)
    content = photo.read_bytes()
    cv2.imwrite(str(photo), 255 - cv2.imread(str(photo)))
    assert "differs: images (db/2.png)" in refused(monkeypatch, caplog, *build)
    photo.unlink()
    assert "1 of 4 images of the map are not in" in refused(monkeypatch, caplog, *build)
    photo.write_bytes(content)
    model = aachen_layout / "3D-models/aachen_v_1_1"
    reference = pycolmap.Reconstruction(model)
    reference.deregister_frame(reference.find_image_with_name("db/3.png").frame_id)
    reference.write(model)
    message = refused(monkeypatch, caplog, *build)
    assert "images (db/3.png) and model (" in message and "images.bin" in message
    assert state(outputs / "map") == before

    # rebuilt on purpose: the results of the map before are not kept for it
    run(monkeypatch, *build, "--overwrite")
    assert maps.Map(outputs / "map").names() == ["db/0.png", "db/1.png", "db/2.png"]
    run(monkeypatch, *build, *new)
    after = state(outputs / "queries-day")
    assert all(after[path] > results[path] for path in results if path.suffix in (".h5", ".csv"))
    assert outcome(outputs / "queries-day")[0]["map_images"] == 3


def test_results_of_another_map_are_kept(place, tmp_path, monkeypatch, caplog):
    build, images, outputs = place
    new = ("--query_images", images / "query/day")
    run(monkeypatch, *build, *new)
    results = state(outputs / "queries-day")
    other = tmp_path / "other"
    run(monkeypatch, *build[:4], "--outputs", other)
    message = refused(monkeypatch, caplog, "--map", other / "map", *new, "--outputs", outputs)
    assert "differs: map. " in message
    assert state(outputs / "queries-day") == results


def test_queries_of_the_same_name_have_folders_of_their_own(place, tmp_path, monkeypatch):
    build, images, outputs = place
    run(monkeypatch, *build, "--query_images", images / "query/day")
    results = state(outputs / "queries-day")
    other = shutil.move(images / "query/night", tmp_path / "day")
    for _ in range(2):
        run(monkeypatch, *build, "--query_images", other)
        assert state(outputs / "queries-day") == results
        (found,) = outputs.glob("queries-day-*")
        assert list(outcome(found)[1]) == ["a.png"]
    # a list of that name is another one, too; the first keeps its folder
    listed = tmp_path / "day.txt"
    listed.write_text("a.png SIMPLE_PINHOLE 480 360 500 240 180\n")
    run(monkeypatch, *build, "--query_images", images / "query/day", "--queries", listed)
    assert len(list(outputs.glob("queries-day-*"))) == 2
    run(monkeypatch, *build, "--query_images", images / "query/day")
    assert state(outputs / "queries-day") == results


def test_queries_that_have_changed_are_localized_anew(place, monkeypatch):
    build, images, outputs = place
    run(monkeypatch, *build, "--query_images", images / "query/day")
    assert outcome(outputs / "queries-day")[1]["grey.png"]["status"] == "fallback"
    shutil.copy(images / "query/day/a.png", images / "query/day/grey.png")
    shutil.copy(images / "query/day/a.png", images / "query/day/new.png")
    run(monkeypatch, *build, "--query_images", images / "query/day")
    rows = outcome(outputs / "queries-day")[1]
    assert [row["status"] for row in rows.values()] == ["localized"] * 3
    assert len({row["num_inliers"] for row in rows.values()}) == 1


def test_queries_called_as_map_photos(place, tmp_path, monkeypatch):
    """They are other photos: every pair is matched, also one that looks like another's reverse."""
    build, images, outputs = place
    new = tmp_path / "new/db"
    new.mkdir(parents=True)
    for name in ("0.png", "1.png", "3.png"):
        shutil.copy(images / "query/day/a.png", new / name)
    run(monkeypatch, *build, "--query_images", new.parent)
    summary, rows = outcome(outputs / "queries-new")
    assert set(rows) == {"db/0.png", "db/1.png", "db/3.png"}
    assert len({tuple(row.values())[2:] for row in rows.values()}) == 1
    localizer = Localizer(outputs / "map")
    pose, info = localizer.localize(new / "1.png")
    assert (
        info["num_matches"] == int(rows["db/1.png"]["num_matches"]) and len(info["retrieved"]) == 4
    )
    poses = parsers.parse_poses(outputs / "queries-new" / summary["poses"])
    assert max(pose_error(pose, poses["db/1.png"])) < 1e-9


def test_inputs_are_not_deleted(place, tmp_path, monkeypatch, caplog):
    build, images, outputs = place
    run(monkeypatch, *build)
    before = state(outputs / "map")
    arguments = ("--map", outputs / "map/sfm", *build[2:], "--overwrite", "--feature", "sift")
    message = refused(monkeypatch, caplog, *arguments)
    assert "map/sfm is in" in message and "move it" in message
    assert state(outputs / "map") == before


def test_a_deletion_that_was_cut_short_goes_on(place, monkeypatch):
    """Nothing of the map before gets into the new one."""
    build, images, outputs = place
    run(monkeypatch, *build)
    old = (outputs / "map/feats-dog-colmap_sift_sv64.h5").read_bytes()
    unlink = type(outputs).unlink

    def killed(path, *arguments, **options):
        if path.name.startswith("feats-"):
            raise KeyboardInterrupt
        unlink(path, *arguments, **options)

    with monkeypatch.context() as context:
        context.setattr(type(outputs), "unlink", killed)
        with pytest.raises(SystemExit):
            run(monkeypatch, *build, "--overwrite")
    with pytest.raises(InputError, match="not a finished one"):
        maps.Map(outputs / "map")
    assert (outputs / "map/feats-dog-colmap_sift_sv64.h5").read_bytes() == old
    run(monkeypatch, *build)
    assert (outputs / "map/feats-dog-colmap_sift_sv64.h5").read_bytes() != old  # it has another id


def test_a_broken_map_is_refused(place, tmp_path, monkeypatch, caplog):
    build, images, outputs = place
    run(monkeypatch, *build)
    file = outputs / "map/map.json"
    sound = json.loads(file.read_text())
    for key, value in (
        ("feature", "/../../x"),
        ("matcher", "no_such"),
        ("conf", {**sound["conf"], "output": "../x"}),
        ("conf", {"output": "x"}),
        ("conf", {**sound["conf"], "model": {"projection": "../x.safetensors"}}),
        ("points3D", None),
    ):
        file.write_text(json.dumps({**sound, key: value}))
        with pytest.raises(InputError, match=r"no sound map.json|Unknown matcher"):
            maps.Map(outputs / "map")
    file.write_text("[]")
    arguments = ("--map", outputs / "map", "--outputs", tmp_path / "x", "--query_images", images)
    assert "no sound map.json" in refused(monkeypatch, caplog, *arguments)


def test_a_map_with_a_broken_file_is_refused_before_any_work(place, tmp_path, monkeypatch, caplog):
    build, images, outputs = place
    run(monkeypatch, *build, "--feature", "sift_sv16")
    folder = outputs / "map"
    given = ("--map", folder, "--outputs", tmp_path / "x", "--query_images", images / "query/day")
    stem = "global-feats-vlad_feats-dog-sift_sv16"
    for name in (
        *("sfm/cameras.bin", "sfm/images.bin", "sfm/points3D.bin", "feats-dog-sift_sv16.h5"),
        *(f"{stem}.h5", f"{stem}.vocabulary.safetensors", "sift_sv16.safetensors"),
    ):
        file = folder / name
        content = file.read_bytes()
        file.unlink()
        message = refused(monkeypatch, caplog, *given)
        assert f"The map {folder} is broken: it has no {name}." in message
        assert "--overwrite" in message
        for damaged in (content[: len(content) // 2], b""):
            file.write_bytes(damaged)
            message = refused(monkeypatch, caplog, *given)
            assert str(file) in message or str(file.parent) in message, name
        assert not (tmp_path / "x").exists()
        file.write_bytes(content)
    run(monkeypatch, *given)


def test_a_build_that_was_stopped_goes_on(place, monkeypatch, caplog):
    build, images, outputs = place
    photo = images / "db/3.png"
    content = photo.read_bytes()
    photo.write_bytes(b"no image")
    assert "Cannot read image" in refused(monkeypatch, caplog, *build)
    with pytest.raises(InputError, match="not a finished one"):
        maps.Map(outputs / "map")
    message = refused(
        monkeypatch,
        caplog,
        "--map",
        outputs / "map",
        "--outputs",
        outputs,
        "--query_images",
        images,
    )
    assert "not a finished one" in message
    photo.write_bytes(content)
    run(monkeypatch, *build)  # nothing was finished: the photo that changed is no matter
    (outputs / "map/map.json").unlink()
    before = state(outputs / "map")
    run(monkeypatch, *build)
    again = state(outputs / "map")
    kept = [path for path in before if path.suffix in (".h5", ".bin", ".txt")]
    assert len(kept) > 6 and all(again[path] == before[path] for path in kept)


def test_a_projection_is_kept_with_the_map(place, tmp_path, monkeypatch):
    """The map works when the file it was made with is gone."""
    build, images, outputs = place
    mine = tmp_path / "mine.safetensors"
    shutil.copy(projections.find("sift_nested"), mine)
    run(monkeypatch, *build, "--feature", "sift", "--projection", f"{mine}@24")
    built = maps.Map(outputs / "map")
    assert built.feature == "mine@24"
    built.check_feature("sift", f"{mine}@24")
    shutil.copy(projections.find("mkd_nested"), mine)  # trained again, say
    with pytest.raises(InputError, match="but not of the mine@24 that it is now"):
        built.check_feature("sift", f"{mine}@24")
    mine.unlink()
    pose, info = Localizer(outputs / "map").localize(images / "query/day/a.png")
    assert pose is not None and info["intrinsics"] == "guess"
    run(
        monkeypatch,
        *("--map", outputs / "map", "--query_images", images / "query/day"),
        *("--outputs", tmp_path / "other"),
    )
    assert outcome(tmp_path / "other/queries-day")[0]["bytes_per_keypoint"]["descriptor"] == 48


@pytest.mark.parametrize("exhaustive", [4, 3])
def test_a_model_of_poses_only(place, aachen_layout, monkeypatch, exhaustive):
    """Without points nothing is covisible: all images are matched, or if many similar ones."""
    monkeypatch.setattr(maps.build, "MAX_EXHAUSTIVE", exhaustive)
    build, images, outputs = place
    model = aachen_layout / "3D-models/aachen_v_1_1"
    reference = pycolmap.Reconstruction(model)
    for point in list(reference.point3D_ids()):
        reference.delete_point3D(point)
    reference.write(model)
    run(monkeypatch, *build, "--num_covis", 2)
    name = "exhaustive" if exhaustive == 4 else "2"
    pairs = list(parsers.parse_pairs(outputs / f"map/pairs-db-{name}.txt"))
    assert len(pairs) == (6 if exhaustive == 4 else 8)
    pose, _ = Localizer(outputs / "map").localize(images / "query/day/a.png")
    assert pose is not None


def with_exif(photo, path, focal_35mm):
    """Write a JPEG whose EXIF data give the focal length in 35 mm film."""
    ifd = b"\x01\x00" + b"\x05\xa4\x03\x00\x01\x00\x00\x00" + focal_35mm.to_bytes(4, "little")
    root = b"\x01\x00" + b"\x69\x87\x04\x00\x01\x00\x00\x00" + (26).to_bytes(4, "little")
    tiff = b"II*\x00\x08\x00\x00\x00" + root + b"\x00" * 4 + ifd + b"\x00" * 4
    segment = b"Exif\x00\x00" + tiff
    _, jpeg = cv2.imencode(".jpg", photo, [cv2.IMWRITE_JPEG_QUALITY, 100])
    length = (len(segment) + 2).to_bytes(2, "big")
    path.write_bytes(b"\xff\xd8\xff\xe1" + length + segment + jpeg.tobytes()[2:])


def test_intrinsics_of_exif_or_guessed(place, aachen_layout, tmp_path, monkeypatch, caplog):
    """The camera has 500 pixels; 36 mm say 499 (of the diagonal), a guess is 576."""
    build, images, outputs = place
    photos = tmp_path / "photos"
    photos.mkdir()
    photo = cv2.imread(str(images / "query/day/a.png"))
    with_exif(photo, photos / "exif.jpg", 36)
    cv2.imwrite(str(photos / "guess.png"), photo)
    truth = parsers.parse_poses(aachen_layout / "queries/ground_truth_poses.txt")["query/day/a.png"]
    caplog.set_level("INFO")
    run(monkeypatch, *build, "--query_images", photos)
    assert "1 queries are from EXIF data" in caplog.text and "1 queries are guessed" in caplog.text
    summary, rows = outcome(outputs / "queries-photos")
    assert summary["intrinsics"] == {"EXIF": 1, "guess": 1}
    listed = outputs / "queries-photos/queries_with_intrinsics.txt"
    cameras = dict(parsers.parse_query_list(listed))
    assert abs(cameras["exif.jpg"].params[0] - 499) < 1 and cameras["guess.png"].params[0] == 576
    poses = parsers.parse_poses(outputs / "queries-photos" / summary["poses"])
    localizer = Localizer(outputs / "map")
    for name in ("exif.jpg", "guess.png"):
        assert rows[name]["status"] == "localized"
        metres, degrees = pose_error(poses[name], truth)
        assert metres < 0.1 and degrees < 1, name  # 2.2 m away
        pose, info = localizer.localize(photos / name)
        assert max(pose_error(pose, poses[name])) < 1e-9
        assert abs(info["camera"].params[0] - 500) < 25
    # pixels are localized as files are, but have no EXIF data
    pixels = cv2.imread(str(photos / "guess.png"))[:, :, ::-1]
    pose, info = localizer.localize(np.ascontiguousarray(pixels))
    assert info["intrinsics"] == "guess" and max(pose_error(pose, poses["guess.png"])) < 0.1
    with pytest.raises(InputError, match="has 240x180 pixels, the photo has 480x360"):
        localizer.localize(
            photos / "guess.png",
            pycolmap.Camera(model="SIMPLE_PINHOLE", width=240, height=180, params=[250, 120, 90]),
        )
    small = tmp_path / "small.txt"
    small.write_text("guess.png SIMPLE_PINHOLE 240 180 250 120 90\n")
    run(monkeypatch, *build, "--query_images", photos, "--queries", small)
    reason = "the intrinsics are for 240x180 pixels, the photo has 480x360"
    assert f"Not localized: guess.png ({reason})." in caplog.text
    for wrong in (pixels.astype(float), pixels[None], np.zeros((0, 3), np.uint8)):
        with pytest.raises(InputError, match="uint8"):
            localizer.localize(wrong)


def test_wrong_input(place, tmp_path, monkeypatch, caplog):
    build, images, outputs = place
    assert "Give --map_images" in refused(monkeypatch, caplog, "--outputs", outputs)
    assert "--query_images, too" in refused(monkeypatch, caplog, *build, "--queries", "list.txt")
    assert "is not a COLMAP model" in refused(monkeypatch, caplog, "--map", images, *build[2:])
    assert "is not a map" in refused(monkeypatch, caplog, "--map", images, "--outputs", outputs)
    message = refused(monkeypatch, caplog, *build[:2], "--outputs", outputs)
    assert "is a COLMAP model: give its photos" in message
    message = refused(monkeypatch, caplog, "--map_images", tmp_path / "nowhere", *build[4:])
    assert "no folder" in message and "nowhere" in message
    message = refused(monkeypatch, caplog, "--map_images", images / "db/1.png", *build[4:])
    assert message.endswith("1.png is a file, not a folder.")
    one = tmp_path / "one"
    one.mkdir()
    shutil.copy(images / "db/1.png", one)
    message = refused(monkeypatch, caplog, "--map_images", one, *build[4:])
    assert "needs two or more" in message and not (outputs / "map").exists()
    assert "Unknown matcher" in refused(monkeypatch, caplog, *build, "--matcher", "NN")
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("IMG\t1.png", "#2.png"):
        shutil.copy(images / "db/1.png", photos / name)
        message = refused(monkeypatch, caplog, "--map_images", photos, *build[4:])
        assert repr(name) in message and "Rename" in message
        (photos / name).unlink()
    assert "Give --outputs" in refused(monkeypatch, caplog, *build[:4])
    assert "--num_covis 0" in refused(monkeypatch, caplog, *build, "--num_covis", 0)
    assert not (outputs / "map").exists()
    run(monkeypatch, *build)
    queries = tmp_path / "list.txt"
    queries.write_text("query/day/gone.png PINHOLE 480 360 500 500 240 180\n")
    new = ("--queries", queries, "--query_images", images)
    assert "query/day/gone.png" in refused(monkeypatch, caplog, *build, *new)
    assert not (outputs / "queries-list").exists()


def test_a_map_to_train_on(place, monkeypatch):
    build, images, outputs = place
    run(monkeypatch, *build)
    folders = images, outputs / "map/sfm"
    assert parse_maps([str(outputs / "map")]) == {"outputs": folders}
    assert parse_maps([f"{images}:{outputs / 'map/sfm'}"]) == {"dataset": folders}
    with pytest.raises(InputError, match="another map is called outputs"):
        parse_maps([str(outputs / "map")] * 2)
    cache = outputs / "cache"
    tracks.main(*folders, cache)
    run(monkeypatch, *build, "--overwrite")
    with pytest.raises(InputError, match="tracks of another map"):
        tracks.main(*folders, cache)
    with pytest.raises(InputError, match="neither a map nor"):
        parse_maps([str(outputs)])


def similarity(points, truth):
    """Fit truth = scale * rotation @ point + translation; return the residuals."""
    centre, true_centre = points.mean(0), truth.mean(0)
    u, s, vt = np.linalg.svd((truth - true_centre).T @ (points - centre))
    flip = np.diag([1, 1, np.linalg.det(u @ vt)])
    scale = (s * np.diag(flip)).sum() / ((points - centre) ** 2).sum()
    return truth - true_centre - scale * (points - centre) @ (u @ flip @ vt).T


def test_reconstruction_from_matches_alone(scene, tmp_path):
    """Poses up to a similarity, though the focal length is guessed; an image apart is left out."""
    names = [f"db/{i}.jpg" for i in range(6)]
    pairs, matches = tmp_path / "pairs.txt", tmp_path / "matches.h5"
    parsers.write_pairs([(a, b) for a in names for b in names if a < b], pairs)
    match_features.main(match_features.confs["NN-ratio"], pairs, scene.features, matches=matches)
    arguments = (scene.images, pairs, scene.features, matches)
    shared = {"camera_mode": pycolmap.CameraMode.SINGLE, "image_list": names}
    model = reconstruction.main(tmp_path / "sfm", *arguments, **shared)
    assert model.num_reg_images() == 6 and model.num_points3D() == 300
    (camera,) = model.cameras.values()
    assert abs(camera.params[0] - 500) < 5
    centres = [image.projection_center() for image in model.images.values()]
    true = [scene.poses[i.name].inverse().translation for i in model.images.values()]
    assert np.linalg.norm(similarity(np.array(centres), np.array(true)), axis=1).max() < 0.01
    image = model.find_image_with_name("db/2.jpg")
    points = np.array([model.points3D[p.point3D_id].xyz for p in image.points2D])
    residuals = similarity(points, scene.points[scene.seen["db/2.jpg"]])
    assert np.linalg.norm(residuals, axis=1).max() < 0.01

    written = state(tmp_path / "sfm")
    reconstruction.main(tmp_path / "sfm", *arguments, **shared)
    assert state(tmp_path / "sfm") == written
    again = reconstruction.main(tmp_path / "again", *arguments, **shared)
    for point in model.point3D_ids():
        assert (model.points3D[point].xyz == again.points3D[point].xyz).all()

    with pytest.raises(InputError, match="mapper options"):
        reconstruction.main(tmp_path / "no", *arguments, mapper_options={"no_such": 1})
    with pytest.raises(InputError, match="image options"):
        reconstruction.main(tmp_path / "no", *arguments, **shared, image_options={"no_such": 1})
    parsers.write_pairs([("db/0.jpg", "db/1.jpg")], pairs)
    with pytest.raises(InputError, match="could not reconstruct"):
        reconstruction.main(tmp_path / "no", *arguments, **shared, min_match_score=1.5)
    assert not (tmp_path / "no").exists()
    cv2.imwrite(str(scene.images / "db/3.jpg"), np.zeros((100, 100), np.uint8))
    parsers.write_pairs([(a, b) for a in names for b in names if a < b], pairs)
    with pytest.raises(InputError, match="share their camera: db/3.jpg"):
        reconstruction.main(tmp_path / "no", *arguments, **shared)


def test_photos_alone(plane, tmp_path, monkeypatch):
    """A map without any model: what is localized in it has its frame and scale."""
    images = plane / "images"
    new = tmp_path / "new"
    new.mkdir()
    shutil.move(images / "4.png", new / "4.png")
    outputs = tmp_path / "outputs"
    run(monkeypatch, "--map_images", images, "--query_images", new, "--outputs", outputs)
    built = maps.Map(outputs / "map")
    summary, rows = outcome(outputs / "queries-new")
    assert summary["map_images"] == len(built.names()) == 4
    assert rows["4.png"]["status"] == "localized"
    poses = parsers.parse_poses(outputs / "queries-new" / summary["poses"])
    model = colmap.read_model(built.sfm)
    poses |= {image.name: image.cam_from_world() for image in model.images.values()}
    true = pycolmap.Reconstruction(plane / "model").images.values()
    centres = np.array([poses[image.name].inverse().translation for image in true])
    known = np.array([image.projection_center() for image in true])
    # of 2.2: a plane says little about the focal length
    assert np.linalg.norm(similarity(centres, known), axis=1).max() < 0.2


def test_further_attempts_where_images_are_missing(scene, tmp_path, monkeypatch):
    """With one camera for all, which the scene has, and with lower thresholds."""
    names = [f"db/{i}.jpg" for i in range(6)]
    pairs, matches = tmp_path / "pairs.txt", tmp_path / "matches.h5"
    parsers.write_pairs([(a, b) for a in names for b in names if a < b], pairs)
    match_features.main(match_features.confs["NN-ratio"], pairs, scene.features, matches=matches)
    attempts, mapping = [], colmap.incremental_mapping

    def fails_first(database, image_dir, output, options, verbose):
        cameras = len(colmap.read_cameras(database))
        attempts.append((cameras, options.mapper.abs_pose_min_num_inliers))
        if len(attempts) < succeeds:
            return []
        return mapping(database, image_dir, output, options, verbose)

    monkeypatch.setattr(colmap, "incremental_mapping", fails_first)
    arguments = (scene.images, pairs, scene.features, matches)
    seeds = 3 * [(6, 30), (6, 15)]
    tried = [(6, 30), (6, 15), *seeds, (1, 30), (1, 15)]
    for succeeds in (1, 2, 9, 10):
        model = reconstruction.main(tmp_path / f"{succeeds}", *arguments, image_list=names)
        assert model.num_reg_images() == 6
        assert model.num_cameras() == (6 if succeeds < 9 else 1)
        assert attempts == tried[:succeeds]
        assert len(list((tmp_path / f"{succeeds}").glob("*.db"))) == 1
        attempts.clear()
    per_image = pycolmap.CameraMode.PER_IMAGE
    with pytest.raises(InputError, match="could not reconstruct"):
        reconstruction.main(tmp_path / "each", *arguments, per_image, image_list=names)
    assert attempts == tried[:8]
    attempts.clear()
    with pytest.raises(InputError, match="could not reconstruct"):
        own = {"min_model_size": 5}
        reconstruction.main(tmp_path / "no", *arguments, image_list=names, mapper_options=own)
    assert attempts == [(6, 30)]


def chain(cameras, places=None):
    """Return a model of images that see points with the next one only, of cameras by number.

    The points are 5 units in front of the images, which are at other places along a line.
    """
    model = pycolmap.Reconstruction()
    for i, number in enumerate(cameras):
        camera = pycolmap.Camera(
            model="SIMPLE_PINHOLE", width=640, height=480, params=[500, 320, 240], camera_id=number
        )
        pixels = np.random.default_rng(i).uniform(0, 400, (20, 2))
        image = pycolmap.Image(name=f"{i}.jpg", keypoints=pixels, camera_id=number, image_id=i + 1)
        place = np.array([i if places is None else places[i], 0, 0])
        colmap.add_image(model, camera, image, pycolmap.Rigid3d(pycolmap.Rotation3d(), -place))
    for i in range(1, len(cameras)):
        for j in range(10):
            elements = [pycolmap.TrackElement(i, 10 + j), pycolmap.TrackElement(i + 1, j)]
            model.add_point3D(np.array([0, 0, 5]), pycolmap.Track(elements))
    given = {key: pycolmap.Camera(camera.todict()) for key, camera in model.cameras.items()}
    return model, given


def names_of(models):
    return [{model.images[i].name for i in model.reg_image_ids()} for model in models]


@pytest.mark.parametrize(
    ("focal_length", "is_prior", "is_kept"),
    [
        (50.0, False, False),
        (-500.0, False, False),
        (1e6, False, False),
        (1500.0, False, True),
        (1500.0, True, False),
        (700.0, True, True),
    ],
)
def test_focal_lengths_that_no_lens_has(focal_length, is_prior, is_kept):
    """Of 500 pixels at first, by EXIF data or guessed."""
    model, given = chain([1, 2, 3, 4])
    for camera in given.values():
        camera.has_prior_focal_length = is_prior
    model.cameras[4].focal_length = focal_length
    found, dropped = reconstruction._plausible([model], given)
    everything = {f"{i}.jpg" for i in range(4)}
    assert names_of(found) == [everything if is_kept else everything - {"3.jpg"}]
    assert dropped == ({} if is_kept else {"3.jpg": f"focal length {focal_length:.0f}"})


@pytest.mark.parametrize(("distortion", "is_kept"), [(-0.6, True), (4.56, False), (-5.9, False)])
def test_distortions_that_no_lens_has(distortion, is_kept):
    """Of photos of a flat wall, each with a camera of its own."""
    model, given = chain([1, 2, 3, 4])
    params = [500, 320, 240, distortion]
    model.cameras[4].model, model.cameras[4].params = "SIMPLE_RADIAL", params
    _, dropped = reconstruction._plausible([model], given)
    assert dropped == ({} if is_kept else {"3.jpg": f"distortion {distortion:.1f}"})


def test_what_only_an_implausible_image_connects_is_dropped():
    model, given = chain([1, 2, 3, 4, 5, 6])
    model.cameras[3].focal_length = 1e6
    found, dropped = reconstruction._plausible([model], given)
    assert names_of(found) == [{"3.jpg", "4.jpg", "5.jpg"}] and set(dropped) == {"2.jpg"}
    model, given = chain([1, 2, 3])
    model.cameras[2].focal_length = 1e6
    assert reconstruction._plausible([model], given)[0] == []


@pytest.mark.parametrize(
    ("places", "viewpoints"),
    [((0, 0.1, 2, 2.05, 2.1), 2), ((0, 0, 0, 0, 0), 1), ((0, 0.1, 2, 2.05, 4), 3)],
)
def test_bursts_from_two_viewpoints_are_no_map(places, viewpoints):
    """Nothing fixes their focal lengths, so that their poses may be wrong by 30 degrees."""
    model, given = chain([1, 2, 3, 4, 5], places)
    assert reconstruction.count_viewpoints(model) == viewpoints
    found, dropped = reconstruction._plausible([model], given)
    assert bool(found) == (viewpoints >= 3) and not dropped


def test_a_camera_of_many_photos_is_known_better_than_by_exif():
    """As of photos that were cropped and kept their EXIF data."""
    for cameras, is_kept in (([1, 1, 1, 1], True), ([1, 1, 2, 2], False)):
        model, given = chain(cameras)
        for camera in given.values():
            camera.focal_length, camera.has_prior_focal_length = 200, True
        found, dropped = reconstruction._plausible([model], given)
        assert bool(found) == is_kept and bool(dropped) != is_kept


def test_no_plausible_image_at_all_is_said():
    message = reconstruction.nothing(Path("photos"), {"a.jpg": "focal length 12345"})
    assert (
        "no lens has" in message
        and "a.jpg (focal length 12345)" in message
        and "overlap" not in message
    )


def draw_noise(folder, numbers):
    """Write photos that match no other."""
    generator = np.random.default_rng(1)
    for number in numbers:
        noise = cv2.GaussianBlur(generator.standard_normal((360, 480)), (0, 0), 3)
        cv2.imwrite(str(folder / f"{number}.png"), 128 + 30 * noise / noise.std())


def test_fewer_than_half_of_the_photos(plane, tmp_path, monkeypatch, caplog):
    """Are refused with their names, and accepted on demand without any work."""
    images, outputs = plane / "images", tmp_path / "outputs"
    draw_noise(images, range(5, 11))
    build = ("--map_images", images, "--outputs", outputs)
    message = refused(monkeypatch, caplog, *build)
    assert "Only 5 of 11 photos are in the map. Missing: 10.png, 5.png, 6.png" in message
    assert "No other photo matches 10.png" in message and "retake blurred or dark ones" in message
    assert "--accept_partial" in message
    assert not (outputs / "map/map.json").exists()
    caplog.clear()
    monkeypatch.setattr(colmap, "incremental_mapping", None)
    run(monkeypatch, *build, "--accept_partial")
    assert "Only 5 of 11 photos" in caplog.text
    assert len(maps.Map(outputs / "map").names()) == 5
    run(monkeypatch, *build)  # is accepted for good


def test_most_of_the_photos(plane, tmp_path, monkeypatch, caplog):
    images, outputs = plane / "images", tmp_path / "outputs"
    draw_noise(images, [5])
    caplog.set_level("INFO")
    run(monkeypatch, "--map_images", images, "--outputs", outputs)
    assert "1 of 6 images are not in the map: 5.png." in caplog.text
    assert "What to try" not in caplog.text
    assert "so each has its own" in caplog.text  # PNG files have no EXIF data


def test_parts_that_do_not_connect():
    state = {
        "images": 10,
        "parts": [["a", "b", "c", "d", "e"], ["f", "g", "h"]],
        "missing": ["f", "g", "h", "i", "j"],
        "unmatched": ["j"],
        "implausible": {},
        "alike": False,
    }
    message = reconstruction.shortfall(Path("x"), **state)
    assert "Only 5 of 10 photos" in message and "f, g, h, i, j." in message
    assert "2 parts that do not connect, of 5 and 3 photos" in message
    assert "the second has f, g, h." in message and "between the parts" in message
    assert "matches j." in message and "--camera_mode" not in message
    state |= {"implausible": {"i": "distortion 4.6"}, "alike": True}
    message = reconstruction.shortfall(Path("x"), **state)
    assert "no lens has" in message and "i (distortion 4.6)." in message
    assert "--camera_mode single, if one camera" in message


def test_camera_modes(plane, tmp_path, monkeypatch, caplog):
    images, outputs = plane / "images", tmp_path / "outputs"
    build = ("--map_images", images, "--outputs", outputs)
    assert "Unknown camera mode 'one'" in refused(
        monkeypatch, caplog, *build, "--camera_mode", "one"
    )
    model = ("--map", plane / "model", "--camera_mode", "single")
    assert "photos alone" in refused(monkeypatch, caplog, *build, *model)
    caplog.set_level("INFO")
    run(monkeypatch, *build, "--camera_mode", "single")
    assert "so each has its own" not in caplog.text
    assert colmap.read_model(outputs / "map/sfm").num_cameras() == 1
    assert "--camera_mode single" in refused(monkeypatch, caplog, *build)
    features = outputs / "map/feats-dog-colmap_sift_sv64.h5"
    before = features.stat().st_mtime_ns
    (outputs / "map/map.json").unlink()  # not finished: the features are kept
    run(monkeypatch, *build, "--camera_mode", "PER_IMAGE")
    assert colmap.read_model(outputs / "map/sfm").num_cameras() == 5
    assert features.stat().st_mtime_ns == before


def files_of(folder, keypoints):
    """Return the files of a map that are of features with other keypoints than hloc's."""
    return sorted(folder.glob(f"*feats-dog-colmap_sift_sv64{keypoints}[._]*"))


def test_photos_are_missing_so_there_are_more_keypoints(plane, tmp_path, monkeypatch, caplog):
    """And queries get them, too; the map is the same command's."""
    caplog.set_level("INFO")
    reconstruct = maps.build.reconstruction.main

    def fails_once(*args, once, **options):
        if once:
            raise maps.build.reconstruction.NoModelError("COLMAP could not reconstruct the images.")
        return reconstruct(*args, once=once, **options)

    monkeypatch.setattr(maps.build.reconstruction, "main", fails_once)
    outputs = tmp_path / "outputs"
    build = ("--map_images", plane / "images", "--outputs", outputs)
    run(monkeypatch, *build)
    assert "0 of 5 photos are in the map." in caplog.text
    assert "Trying again with more keypoints." in caplog.text
    built = maps.Map(outputs / "map")
    assert len(built.names()) == 5 and built.keypoints == "adaptive"
    assert features_confs.keypoints_of(built.conf["model"]) == "colmap"
    assert len(files_of(built.folder, "-keypoints_colmap")) == 4
    assert not files_of(built.folder, "")
    assert [path.name for path in built.folder.glob("sfm*")] == ["sfm-keypoints_colmap"]
    # the next run deletes what a killed run left, but not the user's own files
    name = "feats-dog-colmap_sift_sv64"
    (built.folder / f"{name}.h5.pieces").mkdir()
    (built.folder / f"{name}_matches-NN-mutual-ratio.8_pairs-db-exhaustive.h5").touch()
    (built.folder / f"{name}.safetensors").touch()
    (built.folder / "sfm_notes.txt").touch()
    run(monkeypatch, *build)
    assert [path.name for path in files_of(built.folder, "")] == [f"{name}.safetensors"]
    assert (built.folder / "sfm_notes.txt").exists()
    (built.folder / f"{name}.safetensors").unlink()
    written = state(built.folder)
    run(monkeypatch, *build, "--query_images", plane / "images", "--feature", "colmap_sift_sv64")
    assert state(built.folder) == written
    rows = outcome(outputs / "queries-images")[1]
    _, info = Localizer(built.folder).localize(plane / "images/0.png")
    assert rows["0.png"]["status"] == "localized" and info["reason"] is None
    assert float(rows["0.png"]["confidence"]) == info["confidence"]


def test_more_keypoints_that_do_not_help_are_dropped(plane, tmp_path, monkeypatch, caplog):
    caplog.set_level("INFO")
    draw_noise(plane / "images", ["other"])
    reconstruct = maps.build.reconstruction.main

    def fails_again(*args, once, **options):
        if once:
            return reconstruct(*args, once=once, **options)
        raise maps.build.reconstruction.NoModelError("COLMAP could not reconstruct the images.")

    monkeypatch.setattr(maps.build.reconstruction, "main", fails_again)
    outputs = tmp_path / "outputs"
    run(monkeypatch, "--map_images", plane / "images", "--outputs", outputs)
    assert caplog.text.count("5 of 6 photos are in the map.") == 3
    assert "1 of 6 images are not in the map: other.png." in caplog.text
    built = maps.Map(outputs / "map")
    assert features_confs.keypoints_of(built.conf["model"]) == "adaptive"
    assert len(files_of(built.folder, "")) == 4
    assert not files_of(built.folder, "-keypoints_colmap")
    assert [path.name for path in built.folder.glob("sfm*")] == ["sfm"]


def test_more_pairs_where_the_graph_falls_apart(plane, tmp_path, monkeypatch):
    """One retrieved photo each leaves two parts; all are in the map in the end."""
    monkeypatch.setattr(maps.build, "MAX_EXHAUSTIVE", 4)
    outputs = tmp_path / "outputs"
    build = ("--map_images", plane / "images", "--outputs", outputs, "--num_covis", 1)

    def apart(descriptors, output, num_matched):
        parsers.write_pairs([("0.png", "1.png"), ("1.png", "2.png"), ("3.png", "4.png")], output)

    monkeypatch.setattr(maps.build.pairs_from_retrieval, "main", apart)
    run(monkeypatch, *build)
    built = maps.Map(outputs / "map")
    assert len(built.names()) == 5
    lists = [outputs / f"map/pairs-db-1{end}.txt" for end in ("", "-1", "-2", "-3")]
    sizes = [len(set(parsers.parse_pairs(path))) for path in lists]
    assert sizes[0] == 3 < sizes[1] and sizes == sorted(sizes)
    written = state(outputs / "map")
    (outputs / "map/map.json").unlink()
    run(monkeypatch, *build)
    again = state(outputs / "map")
    assert all(again[path] == written[path] for path in written if path.suffix in (".h5", ".bin"))


def test_which_pairs_are_added():
    names = [str(i) for i in range(6)]
    descriptors = np.eye(6, dtype=np.float32)
    descriptors[4] = descriptors[5] = [0.9, 0.1, 0.2, 0, 0, 0]
    chain = {("0", "1"): 90, ("1", "2"): 50, ("2", "3"): 40, ("4", "5"): 20}
    more = pairs_from_verification.more_pairs
    added = more(names, set(chain), chain, descriptors, 1, 1)
    # neighbours of neighbours, the most similar of the other component, any of those with few
    assert {("0", "2"), ("1", "3"), ("0", "4"), ("0", "5")} <= set(added)
    assert not set(added) & set(chain)
    assert added == more(names, set(chain), chain, descriptors, 1, 1)
    everything = {(a, b): 99 for a in names for b in names if a < b}
    assert more(names, set(everything), everything, descriptors, 1, 1) == []
    assert more(names, set(), {}, descriptors, 9)  # nothing is verified


def test_a_map_of_other_pairs_is_refused(plane, tmp_path, monkeypatch, caplog):
    outputs = tmp_path / "outputs"
    build = ("--map_images", plane / "images", "--outputs", outputs)
    run(monkeypatch, *build)
    run(monkeypatch, *build, "--num_covis", 3)  # of which all pairs know nothing
    assert len(list(parsers.parse_pairs(outputs / "map/pairs-db-exhaustive.txt"))) == 10
    monkeypatch.setattr(maps.build, "MAX_EXHAUSTIVE", 4)
    message = refused(monkeypatch, caplog, *build)
    assert "differs: num_covis and pairs" in message and "--overwrite" in message


@pytest.mark.parametrize("by_model", [True, False])
def test_names_with_spaces(by_model, plane, tmp_path, monkeypatch):
    """Of photos and of folders; hloc's lists cannot hold them, ours have tabs."""
    images, new, outputs = tmp_path / "my photos", tmp_path / "new ones", tmp_path / "my outputs"
    for folder in (images / "a b", new):
        folder.mkdir(parents=True)
    model = pycolmap.Reconstruction(plane / "model")
    for image in model.images.values():
        image.name = f"a b/my {image.name}"
        shutil.copy(plane / "images" / image.name[-5:], images / image.name)
    shutil.move(images / "a b/my 4.png", new / "I am 4.png")
    query = model.find_image_with_name("a b/my 4.png")
    true = query.cam_from_world()
    model.deregister_frame(query.frame_id)
    (tmp_path / "my model").mkdir()
    model.write(tmp_path / "my model")
    given = ("--map_images", images, "--query_images", new, "--outputs", outputs)
    given += ("--feature", "sift_sv16")
    run(monkeypatch, *given, *(("--map", tmp_path / "my model") if by_model else ()))
    summary, rows = outcome(outputs / "queries-new_ones")
    row = rows["I am 4.png"]
    assert row["status"] == "localized" and row["retrieved"].startswith("a b/my ")
    assert maps.Map(outputs / "map").names() == [f"a b/my {i}.png" for i in range(4)]
    poses = parsers.parse_poses(outputs / "queries-new_ones" / summary["poses"])
    assert list(poses) == ["I am 4.png"]
    pose, info = Localizer(outputs / "map").localize(new / "I am 4.png")
    assert max(pose_error(pose, poses["I am 4.png"])) < 1e-9
    assert info["retrieved"][0] == row["retrieved"]
    if by_model:  # and with a list, of the right intrinsics
        assert pose_error(pose, true)[0] < 0.2
        camera = "SIMPLE_PINHOLE 480 360 500 240 180"
        (tmp_path / "my list.txt").write_text(f"I am 4.png\t{camera}\n")
        run(
            monkeypatch, *given[2:], "--map", outputs / "map", "--queries", tmp_path / "my list.txt"
        )
        summary, rows = outcome(outputs / "queries-my_list")
        poses = parsers.parse_poses(outputs / "queries-my_list" / summary["poses"])
        assert pose_error(poses["I am 4.png"], true)[0] < 0.02


def test_records_of_failed_queries_have_no_pose():
    assert pose_of({"qvec": None, "tvec": None}) is None
