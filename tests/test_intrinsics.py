"""Intrinsics of photos that no list gives."""

import numpy as np
import pycolmap
import pytest
from PIL import Image

from hloc_reduce.localization import intrinsics
from hloc_reduce.localization.intrinsics import MapCameras
from hloc_reduce.utils import colmap

PARAMS = [500.0, 240.0, 180.0, -0.05]


def map_of(cameras: list[int]) -> pycolmap.Reconstruction:
    """Return a map whose photos 0.jpg, 1.jpg, ... were taken by cameras of some ids."""
    reconstruction = pycolmap.Reconstruction()
    for i, camera_id in enumerate(cameras):
        camera = pycolmap.Camera(
            camera_id=camera_id, model="SIMPLE_RADIAL", width=480, height=360, params=PARAMS
        )
        image = pycolmap.Image(name=f"{i}.jpg", image_id=i + 1, camera_id=camera_id)
        colmap.add_image(reconstruction, camera, image, pycolmap.Rigid3d())
    return reconstruction


def write_photo(path, make="Maker", focal_35mm=36, size=(480, 360)):
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = make, "Phone 1"
    exif.get_ifd(0x8769)[0xA405] = focal_35mm
    Image.new("RGB", size, (90, 120, 150)).save(path, exif=exif)


@pytest.mark.skipif(
    not hasattr(pycolmap.Bitmap, "exif_camera_model"), reason="this pycolmap reads no camera model"
)
def test_the_camera_of_a_map_is_known_again(tmp_path):
    for i in range(4):
        write_photo(tmp_path / f"{i}.jpg")
    known = intrinsics.of_map(map_of([1, 1, 1, 1]), tmp_path)
    assert known.sizes == {(480, 360)} and len(known.known) == 1
    write_photo(tmp_path / "new.jpg")
    camera, source = intrinsics.infer(tmp_path / "new.jpg", known)
    assert source == "map" and camera.params.tolist() == PARAMS
    assert intrinsics.REFINEMENTS["map"] == {}  # as exact as a list
    for changed in ({"make": "Other"}, {"focal_35mm": 50}, {"size": (360, 480)}):
        write_photo(tmp_path / "new.jpg", **changed)
        assert intrinsics.infer(tmp_path / "new.jpg", known)[1] == "EXIF"


def test_a_camera_of_few_photos_or_of_several_models_is_not_known(tmp_path, monkeypatch):
    monkeypatch.setattr(colmap, "exif_camera_model", lambda path: "Maker-Phone 1-36-480x360")
    assert intrinsics.of_map(map_of([1, 1]), tmp_path).known == {}
    assert intrinsics.of_map(map_of([1, 1, 1, 2]), tmp_path).known == {}
    assert len(intrinsics.of_map(map_of([1, 1, 1]), tmp_path).known) == 1


def test_a_photo_of_the_size_of_the_map_is_hardly_cropped():
    photo = np.zeros((360, 480), np.uint8)
    for sizes, source in (({(480, 360)}, "guess"), ({(360, 480)}, "guess"), (set(), "unknown")):
        camera, found = intrinsics.infer(photo, MapCameras({}, sizes))
        assert camera.params.tolist() == [576, 240, 180, 0] and found == source


def test_intrinsics_in_a_list_are_the_same():
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=480, height=360, params=PARAMS)
    again = intrinsics.from_list(intrinsics.to_list(camera))
    assert again.model == camera.model and (again.width, again.height) == (480, 360)
    assert again.params.tolist() == PARAMS
