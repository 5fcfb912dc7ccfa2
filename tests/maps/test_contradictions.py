"""Photos of a map that the other photos place elsewhere."""

import copy
import shutil

import pycolmap
import pytest

from hloc_reduce import maps
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
        assert built.contradicting == ["2.png"] and "place 2.png elsewhere" in caplog.text


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
