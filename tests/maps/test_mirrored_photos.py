"""Mirrored photos among those of a map."""

import cv2
import pytest
from command import state

from hloc_reduce import maps
from hloc_reduce.maps import mirrored_photos
from hloc_reduce.utils import colmap
from pipelines import localize

PIPELINE = localize


def mirror(path):
    cv2.imwrite(str(path), cv2.imread(str(path))[:, ::-1])


@pytest.mark.parametrize("symmetric", [0.0, 0.25])
def test_mirrored_photos_are_left_out(plane, symmetric, tmp_path, caplog, run):
    """Also one that the mapper places, because a part of the place is symmetric."""
    mirror(plane / "images/1.png")
    outputs = tmp_path / "outputs"
    build = "--map_images", plane / "images", "--outputs", outputs, "--camera_mode", "single"
    run(*build)
    built = maps.Map(outputs / "map")
    others = [f"{i}.png" for i in (0, 2, 3, 4)]
    assert built.mirrored == ["1.png"] and built.names() == others
    assert built.sfm.name == "sfm-others"
    assert [path.name for path in built.folder.glob("sfm*")] == ["sfm-others"]
    assert not (built.folder / "mirrored").exists()
    assert "Mirrored photos are not in the map: 1.png." in caplog.text
    written = state(built.folder)
    caplog.clear()
    run(*build)
    assert state(built.folder) == written
    assert "Mirrored photos are not in the map: 1.png." in caplog.text
    (built.folder / "map.json").unlink()  # as after an interruption
    run(*build)
    again = maps.Map(built.folder)
    assert again.mirrored == ["1.png"] and again.names() == others


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
