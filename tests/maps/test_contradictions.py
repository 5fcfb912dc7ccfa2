"""Photos of a map that the other photos place elsewhere."""

import copy
import itertools
import shutil

import h5py
import numpy as np
import pycolmap
import pytest

from hloc_reduce import maps
from hloc_reduce.mapping.checks import Inputs, contradictions
from hloc_reduce.mapping.findings import names_in
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError


def shifted(pose: pycolmap.Rigid3d, distance: float) -> pycolmap.Rigid3d:
    """Move a camera (from world) along the x axis of the world."""
    moved = pose.translation - pose.rotation.matrix() @ [distance, 0, 0]
    return pycolmap.Rigid3d(pose.rotation, moved)


def write_model(folder, photos, camera):
    """Write a COLMAP model of photos, from name to pose, without points."""
    model = pycolmap.Reconstruction()
    for i, (name, pose) in enumerate(photos.items(), 1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=i)
        colmap.add_image(model, copy.deepcopy(camera), image, pose)
    folder.mkdir()
    model.write(folder)
    return folder


@pytest.fixture
def photos(plane):
    """The poses of the photos by name, and their camera."""
    model = pycolmap.Reconstruction(plane / "model")
    poses = {image.name: image.cam_from_world() for image in model.images.values()}
    return dict(sorted(poses.items())), model.cameras[1]


@pytest.mark.parametrize("misplaced", [[], ["2.png"]])
def test_misplaced_photos_are_named(plane, photos, tmp_path, caplog, misplaced):
    poses, camera = photos
    poses |= {name: shifted(poses[name], 0.8) for name in misplaced}
    model = write_model(tmp_path / "moved", poses, camera)
    maps.main(tmp_path / "map", plane / "images", model)
    assert ("the other photos place 2.png elsewhere" in caplog.text) == bool(misplaced)
    assert ("The map may be wrong" in caplog.text) == bool(misplaced)


def test_the_warning_is_repeated(plane, photos, tmp_path, caplog):
    poses, camera = photos
    model = write_model(tmp_path / "moved", poses | {"2.png": shifted(poses["2.png"], 0.8)}, camera)
    for _ in range(2):
        caplog.clear()
        built = maps.main(tmp_path / "map", plane / "images", model)
        assert names_in(built.findings) == {"2.png"} and "place 2.png elsewhere" in caplog.text


def test_names_that_match_files_confuse_are_refused(plane, photos, tmp_path):
    poses, camera = photos
    (plane / "images/a").mkdir()
    for old, new in (("0.png", "a/0.png"), ("1.png", "a-0.png")):
        (plane / "images" / old).rename(plane / "images" / new)
        poses[new] = poses.pop(old)
    model = write_model(tmp_path / "renamed", poses, camera)
    with pytest.raises(InputError, match="a-0.png and a/0.png have the same name in match files"):
        maps.main(tmp_path / "map", plane / "images", model)


def test_copies_of_a_place_are_named(plane, photos, tmp_path, caplog):
    """The same wall twice, 60 units apart."""
    poses, camera = photos
    for name, pose in list(poses.items()):
        poses[f"copy_{name}"] = shifted(pose, 60)
        shutil.copy(plane / "images" / name, plane / "images" / f"copy_{name}")
    model = write_model(tmp_path / "both", poses, camera)
    maps.main(tmp_path / "map", plane / "images", model)
    assert "or the place looks the same at two positions" in caplog.text


def test_a_cropped_photo_that_the_mapper_misplaced_is_named(tmp_path):
    """Only with other intrinsics than those of the map do most of its matches agree with a pose."""
    generator = np.random.default_rng(0)
    points = generator.uniform(-1, 1, (300, 3))
    model, names = pycolmap.Reconstruction(), [f"{i}.jpg" for i in range(6)]
    shared = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=1000, height=800, params=[1100, 500, 400, 0], camera_id=1
    )
    enlarged = pycolmap.Camera(
        model="PINHOLE", width=1000, height=800, params=[1600, 1600, 800, 650]
    )
    for i, name in enumerate(names):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d([0, 0.1 * i - 0.3, 0]), [0, 0, 4])
        cropped = name == "3.jpg"
        pixels = (enlarged if cropped else shared).img_from_cam(pose * points)
        pixels += generator.normal(0, 0.5, pixels.shape)
        image = pycolmap.Image(name=name, keypoints=pixels, camera_id=1, image_id=i + 1)
        colmap.add_image(model, shared, image, shifted(pose, 1.5 * cropped))
    for row, point in enumerate(points):
        track = [
            pycolmap.TrackElement(i + 1, row) for i, name in enumerate(names) if name != "3.jpg"
        ]
        model.add_point3D(point, pycolmap.Track(track))
    matches = tmp_path / "matches.h5"
    with h5py.File(matches, "w") as file:
        for first, second in itertools.combinations(names, 2):
            file[f"{first}/{second}/matches0"] = np.arange(300, dtype=np.int32)
            file[f"{first}/{second}/matching_scores0"] = np.ones(300, np.float16)
    assert contradictions.judge(Inputs(model, matches=matches), names) == ["3.jpg"]
    pairs = itertools.combinations(names, 2)
    verified = dict.fromkeys(pairs, np.repeat(np.arange(300)[:, None], 2, axis=1))
    (found,) = contradictions.find(Inputs(model, verified))  # as of a database
    assert found.names == ("3.jpg",) and "place 3.jpg elsewhere" in found.message
    assert contradictions.find(Inputs(model)) == []
