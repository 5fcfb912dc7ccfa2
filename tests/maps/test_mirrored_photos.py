"""Mirrored photos among those of a map."""

import cv2
import pytest
from command import state

from hloc_reduce import maps
from hloc_reduce.maps import mirrored_photos
from hloc_reduce.utils import colmap
from pipelines import localize

PIPELINE = localize
OTHERS = [f"{i}.png" for i in (0, 2, 3, 4)]


def mirror(path):
    cv2.imwrite(str(path), cv2.imread(str(path))[:, ::-1])


def build_with_one_mirrored(plane, outputs, run):
    """Build a map with a mirrored photo, which it must leave out; return the arguments."""
    mirror(plane / "images/1.png")
    arguments = "--map_images", plane / "images", "--outputs", outputs, "--camera_mode", "single"
    run(*arguments)
    built = maps.Map(outputs / "map")
    assert built.mirrored == ["1.png"] and built.names() == OTHERS
    assert [path.name for path in built.folder.glob("sfm*")] == ["sfm-others"]
    assert not (built.folder / "mirrored").exists()
    return arguments


def test_a_mirrored_photo_is_named(plane, tmp_path, caplog, run):
    build_with_one_mirrored(plane, tmp_path / "outputs", run)
    assert "Mirrored photos are not in the map: 1.png." in caplog.text
    assert "images are not in the map" not in caplog.text


@pytest.mark.parametrize("symmetric", [0.25])
def test_one_that_the_mapper_places_is_left_out(plane, symmetric, tmp_path, caplog, run):
    """As it may where a part of the place is symmetric; also after an interruption."""
    folder = tmp_path / "outputs/map"
    arguments = build_with_one_mirrored(plane, tmp_path / "outputs", run)
    written = state(folder)
    caplog.clear()
    run(*arguments)
    assert state(folder) == written
    assert "Mirrored photos are not in the map: 1.png." in caplog.text
    (folder / "map.json").unlink()
    run(*arguments)
    again = maps.Map(folder)
    assert again.mirrored == ["1.png"] and again.names() == OTHERS


@pytest.mark.parametrize("symmetric", [0.0, 1.0])
def test_no_photo_is_mirrored(plane, symmetric, tmp_path, caplog, run):
    """Not even one of a symmetric place that seems to be apart from the others."""
    outputs = tmp_path / "outputs"
    run("--map_images", plane / "images", "--outputs", outputs, "--camera_mode", "single")
    built = maps.Map(outputs / "map")
    assert not built.mirrored and len(built.names()) == 5
    assert "Mirrored" not in caplog.text
    sfm = colmap.read_model(built.sfm)
    names = built.names()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mirrored_photos, "_largest_group", lambda _: {*names[1:]})
        found = mirrored_photos.find(
            *(sfm, names, built.conf, built.matcher, built.images),
            *(built.features, built.descriptors, tmp_path / "mirrored"),
        )
    assert not found
