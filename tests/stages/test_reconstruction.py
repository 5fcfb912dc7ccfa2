"""Poses and points from matches alone, and which of them are plausible."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from alignment import similarity
from command import state

from hloc_reduce import match_features, reconstruction
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


def test_further_attempts_where_images_are_missing(scene, matched, tmp_path, monkeypatch):
    """With one camera for all, which the scene has, and with lower thresholds."""
    names, pairs, matches = matched
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


@pytest.mark.parametrize("is_poor", [True, False])
def test_focal_lengths_that_differ_are_doubted(
    scene, matched, tmp_path, monkeypatch, caplog, is_poor
):
    """Of 12 frames of one camera; the map was bent, and 12 of 19 photos localized wrongly in it."""
    names, pairs, matches = matched
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
    model = reconstruction.main(*arguments, image_list=names, once=True)
    assert model.num_cameras() == (1 if is_poor else 6)
    assert ("may be wrong" in caplog.text) == (not is_poor)


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
