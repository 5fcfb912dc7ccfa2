"""Poses and points from matches alone."""

import time

import cv2
import h5py
import numpy as np
import pycolmap
import pytest
from alignment import similarity
from command import state

from hloc_reduce import match_features, reconstruction
from hloc_reduce.mapping import mapper
from hloc_reduce.mapping.checks import CHECKS, Check
from hloc_reduce.mapping.findings import Finding
from hloc_reduce.mapping.registration import NoModelError
from hloc_reduce.runtime import parallel
from hloc_reduce.utils import colmap, parsers
from hloc_reduce.utils.cli import InputError


@pytest.fixture
def matched(scene, tmp_path):
    """The map images of the scene, all pairs of them, and the matches."""
    names = [f"db/{i}.jpg" for i in range(6)]
    pairs, matches = tmp_path / "pairs.txt", tmp_path / "matches.h5"
    parsers.write_pairs([(a, b) for a in names for b in names if a < b], pairs)
    match_features.main(match_features.confs["NN-ratio"], pairs, scene.features, matches=matches)
    return names, pairs, matches


def test_reconstruction_from_matches_alone(scene, matched, tmp_path):
    """Poses up to a similarity, though the focal length is guessed; an image apart is left out."""
    names, pairs, matches = matched
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


@pytest.mark.parametrize(
    ("very_few", "mode", "expected"),
    [
        (5, pycolmap.CameraMode.SINGLE, (1.2, 1.2, True)),
        (5, pycolmap.CameraMode.PER_IMAGE, (1.1, 1.1, False)),
        (6, pycolmap.CameraMode.SINGLE, (1.1, 1.1, False)),
    ],
)
def test_many_images_of_one_camera_are_adjusted_less_often(
    very_few, mode, expected, scene, matched, tmp_path, monkeypatch
):
    """And by fewer points; of others, COLMAP's options stay. The poses are right."""
    monkeypatch.setattr(mapper, "VERY_FEW", very_few)
    names, pairs, matches = matched
    mapping, tried = colmap.incremental_mapping, []

    def second(database, image_dir, output, options, verbose):
        rare = options.ba_global_frames_ratio, options.ba_global_points_ratio
        fewer = options.mapper.ba_global_ignore_redundant_points3D
        tried.append((*rare, fewer, options.mapper.abs_pose_min_num_inliers))
        is_second = len(tried) == 2
        return mapping(database, image_dir, output, options, verbose) if is_second else []

    adjusted, adjust = [], mapper.adjust
    monkeypatch.setattr(colmap, "incremental_mapping", second)
    monkeypatch.setattr(mapper, "adjust", lambda *given: adjusted.append(adjust(*given)))
    arguments = (scene.images, pairs, scene.features, matches, mode)
    model = reconstruction.main(tmp_path / "sfm", *arguments, image_list=names)
    assert tried == [(*expected, 30), (*expected, 15)]
    assert len(adjusted) == expected[2]  # in the end once by all points
    assert model.num_reg_images() == 6 and model.num_points3D() == 300
    centres = [image.projection_center() for image in model.images.values()]
    true = [scene.poses[image.name].inverse().translation for image in model.images.values()]
    errors = np.linalg.norm(similarity(np.array(centres), np.array(true)), axis=1)
    assert errors.max() < 0.01


def test_options_that_are_given_count():
    """Beside those of rare adjustments."""
    given = {"ba_global_frames_ratio": 1.3, "mapper": mapper.RELAXED}
    found = colmap.mapper_options(mapper.with_rare_adjustments(given))
    assert (found.ba_global_frames_ratio, found.ba_global_points_ratio) == (1.3, 1.2)
    assert found.mapper.ba_global_ignore_redundant_points3D
    assert found.mapper.abs_pose_min_num_inliers == 15


@pytest.mark.fault(6)
@pytest.mark.parametrize(("narrow", "number"), [(True, 6), (False, 0)])
def test_photos_of_a_narrow_view_are_tried_without_distortion(
    narrow, number, scene, matched, tmp_path, monkeypatch
):
    """Their views do not tell it: COLMAP's coefficient may be absurd, as on a turntable."""
    names, pairs, matches = matched
    mapping, tried = colmap.incremental_mapping, []

    def absurd(database, image_dir, output, options, verbose):
        models = mapping(database, image_dir, output, options, verbose)
        tried.append(options.ba_refine_extra_params)
        for camera in models[0].cameras.values() if tried[-1] else ():
            focal_length = 3 * 640 if narrow else 500
            camera.params = [focal_length, *camera.params[1:3], -7.4]
        return models

    monkeypatch.setattr(colmap, "incremental_mapping", absurd)
    arguments = (scene.images, pairs, scene.features, matches)
    options = {"image_list": names, "camera_mode": pycolmap.CameraMode.SINGLE, "once": True}
    if not number:
        with pytest.raises(NoModelError, match="distortion -7.4"):
            reconstruction.main(tmp_path / "sfm", *arguments, **options)
        assert tried == [True]
        return
    model = reconstruction.main(tmp_path / "sfm", *arguments, **options)
    assert model.num_reg_images() == number and tried == [True, False]
    assert all(camera.params[3] == 0 for camera in model.cameras.values())


def test_further_attempts_where_images_are_missing(scene, matched, tmp_path, monkeypatch, caplog):
    """With one camera for all, which the scene has, and with lower thresholds."""
    monkeypatch.setattr(parallel, "cores", lambda: 1)
    names, pairs, matches = matched
    attempts, mapping = [], colmap.incremental_mapping
    caplog.set_level("INFO")

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
        assert ("so each has its own" in caplog.text) == (succeeds < 9)
        caplog.clear()
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


@pytest.mark.fault(12)
def test_further_attempts_begin_while_there_is_time(scene, matched, tmp_path, monkeypatch, caplog):
    """The first one with each choice of cameras is always made."""
    monkeypatch.setattr(parallel, "cores", lambda: 1)
    monkeypatch.setattr(mapper, "MAPPER_PATIENCE", 0.0)
    names, pairs, matches = matched
    attempts, mapping = [], colmap.incremental_mapping

    def three_at_most(database, image_dir, output, options, verbose):
        cameras = len(colmap.read_cameras(database))
        attempts.append((cameras, options.mapper.abs_pose_min_num_inliers))
        if len(attempts) == fails:
            return []
        models = mapping(database, image_dir, output, options, verbose)
        for name in names[3:]:
            models[0].deregister_frame(models[0].find_image_with_name(name).frame_id)
        return models

    monkeypatch.setattr(colmap, "incremental_mapping", three_at_most)
    arguments = (scene.images, pairs, scene.features, matches)
    for fails in (0, 1):
        model = reconstruction.main(tmp_path / f"{fails}", *arguments, image_list=names)
        assert model.num_reg_images() == 3
        assert attempts == [(6, 30), (6, 15), (1, 30)]
        running = [text for text in caplog.messages if text.startswith("COLMAP's mapper makes")]
        assert [text.partition("makes ")[2] for text in running] == [
            "attempt 1 of up to 8...",
            "attempt 2 of up to 8...",
            "attempt 1 of up to 8...",
        ]
        assert "run again with --overwrite" in caplog.text
        assert "attempts were left out for lack of time: 13" in caplog.text
        attempts.clear()
        caplog.clear()


@pytest.mark.fault(12)
@pytest.mark.parametrize(
    "kept",  # pairs of images
    [[], [(0, 1)], [(0, 1), (2, 3), (4, 5)]],
)
def test_without_three_connected_images_nothing_is_tried(
    kept, scene, matched, tmp_path, monkeypatch
):
    names, pairs, matches = matched
    parsers.write_pairs([(names[i], names[j]) for i, j in kept], pairs)
    monkeypatch.setattr(colmap, "incremental_mapping", None)
    with pytest.raises(InputError, match="could not reconstruct"):
        reconstruction.main(
            tmp_path / "sfm", scene.images, pairs, scene.features, matches, image_list=names
        )


@pytest.mark.fault(12)
def test_two_images_are_too_few(scene, matched, tmp_path, monkeypatch):
    """Two viewpoints do not determine focal lengths."""
    names, pairs, matches = matched
    monkeypatch.setattr(colmap, "incremental_mapping", None)
    with pytest.raises(InputError, match="needs 3 or more, .*: 2 images are given of "):
        reconstruction.main(
            tmp_path / "sfm", scene.images, pairs, scene.features, matches, image_list=names[:2]
        )


def test_attempts_at_once_find_the_same(scene, matched, tmp_path, monkeypatch, caplog):
    """Whichever ends first, the first attempt that registers all images counts."""
    names, pairs, matches = matched
    mapping, level = colmap.incremental_mapping, pycolmap.logging.minloglevel
    attempts = []

    def one_is_missing(database, image_dir, output, options, verbose):
        attempt = options.random_seed, options.mapper.abs_pose_min_num_inliers
        attempts.append(attempt)
        time.sleep(0.2 / len(attempts))  # later ones tend to end earlier
        models = mapping(database, image_dir, output, options, verbose)
        if attempt != (2, 30):
            models[0].deregister_frame(models[0].find_image_with_name(names[0]).frame_id)
        return models

    monkeypatch.setattr(colmap, "incremental_mapping", one_is_missing)
    arguments = (scene.images, pairs, scene.features, matches, pycolmap.CameraMode.PER_IMAGE)
    found, logs = [], []
    for cores, number in ((1, 5), (3, 7)):
        monkeypatch.setattr(parallel, "cores", lambda cores=cores: cores)
        attempts.clear()
        caplog.clear()
        found.append(reconstruction.main(tmp_path / f"{cores}", *arguments, image_list=names))
        logs.append([text for text in caplog.messages if text.startswith("Attempt")])
        assert len(attempts) == number and attempts[0] == (0, 30)
    assert logs[0] == logs[1] and logs[0][-1].endswith("6 of 6 images reconstructed.")
    assert pycolmap.logging.minloglevel == level
    one, other = found
    assert one.num_reg_images() == other.num_reg_images() == 6
    for image_id in one.reg_image_ids():
        poses = [model.images[image_id].cam_from_world().matrix() for model in found]
        np.testing.assert_array_equal(*poses)
    assert sorted(path.name for path in (tmp_path / "1").iterdir()) == sorted(
        path.name for path in (tmp_path / "3").iterdir()
    )


@pytest.mark.parametrize("kept", [5, 4])
def test_a_photo_with_an_implausible_lens_does_not_bend_the_others(
    scene, matched, tmp_path, monkeypatch, caplog, kept
):
    """The others are reconstructed without it, if that loses none of them."""
    names, pairs, matches = matched
    mapping, tried, settings = colmap.incremental_mapping, [], []

    def bent(database, image_dir, output, options, verbose):
        tried.append(list(options.image_names))
        settings.append((options.random_seed, options.num_threads, options.min_model_size))
        models = mapping(database, image_dir, output, options, verbose)
        bad = models[0].find_image_with_name(names[2])
        if not tried[-1]:
            models[0].cameras[bad.camera_id].focal_length *= 50
        elif kept == 4:
            models[0].deregister_frame(models[0].find_image_with_name(names[0]).frame_id)
        return models

    monkeypatch.setattr(colmap, "incremental_mapping", bent)
    model = reconstruction.main(
        tmp_path / "sfm",
        scene.images,
        pairs,
        scene.features,
        matches,
        image_list=names,
        once=True,
    )
    assert not tried[0] and {*tried[1]} == {*names} - {names[2]}
    assert {*settings} == {(0, 1, 3)}  # those of the attempt that it replaces
    assert model.num_reg_images() == 5
    assert f"{names[2]} (focal length" in caplog.text
    assert "focal lengths differ" not in caplog.text  # those of the others do not


def test_why_no_model_is_plausible_is_said(scene, matched, tmp_path, monkeypatch):
    names, pairs, matches = matched
    dropped = Finding("lenses", "No lens has these: {names}.", tuple(names), verdict="drop")
    monkeypatch.setitem(CHECKS, "lenses", Check(lambda inputs: [dropped] if inputs.names else []))
    with pytest.raises(NoModelError, match=f"No lens has these: {names[0]}"):
        reconstruction.main(
            tmp_path / "sfm",
            scene.images,
            pairs,
            scene.features,
            matches,
            image_list=names,
            once=True,
        )


@pytest.mark.parametrize("is_poor", [True, False])
def test_focal_lengths_that_differ_are_doubted(
    scene, matched, tmp_path, monkeypatch, caplog, is_poor
):
    """Of 12 frames of one camera; the map was bent, and 12 of 19 photos localized wrongly in it."""
    names, pairs, matches = matched
    monkeypatch.setitem(CHECKS, "misplaced", Check(lambda _: []))
    mapping = colmap.incremental_mapping

    def bent(database, *arguments):
        models = mapping(database, *arguments)
        several = len(colmap.read_cameras(database)) > 1
        if several:
            models[0].cameras[1].focal_length *= 1.3
        if several == is_poor:  # then the model of the other kind has twice as many points
            for point in sorted(models[0].point3D_ids())[::2]:
                models[0].delete_point3D(point)
        return models

    monkeypatch.setattr(colmap, "incremental_mapping", bent)
    arguments = (tmp_path / "sfm", scene.images, pairs, scene.features, matches)
    if not is_poor:
        with pytest.raises(InputError, match=r"differ by a factor of 1\.30.*--accept_partial"):
            reconstruction.main(*arguments, image_list=names, once=True)
    model = reconstruction.main(*arguments, image_list=names, once=True, accept_partial=not is_poor)
    assert model.num_cameras() == (1 if is_poor else 6)
    assert ("may be wrong" in caplog.text) == (not is_poor)


@pytest.mark.parametrize("enlarged", [1.0, 1.08])
def test_one_camera_for_focal_lengths_that_differ_little(
    scene, matched, tmp_path, monkeypatch, caplog, enlarged
):
    """If all images fit with it; two of 11 frames of one camera were 9 to 12 % off without it."""
    monkeypatch.setattr(parallel, "cores", lambda: 1)
    names, pairs, matches = matched
    generator, mapping = np.random.default_rng(0), colmap.incremental_mapping
    with h5py.File(scene.features, "r+") as file:
        for name in names:
            keypoints = file[name]["keypoints"][()] + 0.3 * generator.standard_normal((300, 2))
            if name == names[2]:
                keypoints = enlarged * (keypoints - [320, 240]) + [320, 240]
            file[name]["keypoints"][...] = keypoints

    attempts = []

    def bent(database, *arguments):
        attempts.append(len(colmap.read_cameras(database)))
        if attempts.count(1) == 1 == attempts[-1]:
            return []  # then the next attempt counts
        models = mapping(database, *arguments)
        if enlarged == 1 and attempts[-1] > 1:
            models[0].cameras[1].focal_length *= 1.08
        return models

    monkeypatch.setattr(colmap, "incremental_mapping", bent)
    arguments = (tmp_path / "sfm", scene.images, pairs, scene.features, matches)
    model = reconstruction.main(*arguments, image_list=names, once=True)
    assert model.num_cameras() == (1 if enlarged == 1 else 6)
    assert attempts == ([6, 1, 1] if enlarged == 1 else [6])
    assert ("may be wrong" in caplog.text) == (enlarged != 1)
