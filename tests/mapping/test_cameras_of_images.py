"""Cameras of a new COLMAP database."""

import numpy as np
import pycolmap
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from hloc_reduce.mapping import database
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError

ZOOMS = {"a.jpg": None, "b.jpg": 1.0, "c.jpg": 2.0, "d.jpg": 2.0}


@pytest.fixture
def photos(tmp_path):
    """Photos by one camera, two of them with a digital zoom."""
    for name, zoom in ZOOMS.items():
        exif = Image.Exif()
        exif[0x010F], exif[0x0110] = "Maker", "Model"
        exif.get_ifd(0x8769)[0xA405] = 36
        if zoom is not None:
            exif.get_ifd(0x8769)[0xA404] = zoom
        pixels = np.full((30, 40, 3), 128, np.uint8)
        Image.fromarray(pixels).save(tmp_path / name, exif=exif)
    return tmp_path


def cameras(path):
    with colmap.open_database(path) as opened:
        images = opened.read_all_images()
        return {image.name: opened.read_camera(image.camera_id) for image in images}


def test_digital_zooms_have_cameras_of_their_own(photos):
    path = photos / "database.db"
    database.import_images(path, photos, [*ZOOMS], pycolmap.CameraMode.AUTO)
    found = cameras(path)
    ids = [found[name].camera_id for name in ZOOMS]
    assert ids[0] == ids[1] and len({*ids}) == 3
    assert [found[name].has_prior_focal_length for name in ZOOMS] == [True, True, False, False]
    assert found["c.jpg"].mean_focal_length() == 48 != found["a.jpg"].mean_focal_length()


def test_cropped_photos_have_cameras_of_their_own(photos):
    """Their shape is not that which EXIF data tell."""
    exif = Image.open(photos / "a.jpg").getexif()
    exif.get_ifd(0x8769)[0xA002], exif.get_ifd(0x8769)[0xA003] = 60, 30
    Image.new("RGB", (40, 30)).save(photos / "b.jpg", exif=exif)
    database.import_images(photos / "1.db", photos, ["a.jpg", "b.jpg"], pycolmap.CameraMode.AUTO)
    found = cameras(photos / "1.db")
    assert found["a.jpg"].camera_id != found["b.jpg"].camera_id
    assert not found["b.jpg"].has_prior_focal_length


@pytest.mark.parametrize("mode", ["AUTO", "SINGLE", "PER_IMAGE"])
def test_focal_lengths_of_smaller_copies(photos, mode):
    """The size of a pixel in EXIF data is that of the camera: 25 mm are 100 of its pixels."""
    for name, longer in {"a.jpg": 160, "b.jpg": 80}.items():
        exif = Image.open(photos / name).getexif()
        of_photo = exif.get_ifd(0x8769)
        del of_photo[0xA405]
        of_photo[0x920A], of_photo[0xA210] = IFDRational(250, 10), 2
        of_photo[0xA20E] = IFDRational(101600, 1000)
        of_photo[0xA002], of_photo[0xA003] = longer, longer * 3 // 4
        Image.new("RGB", (40, 30)).save(photos / name, exif=exif)
    path, mode = photos / "1.db", pycolmap.CameraMode.__members__[mode]
    database.import_images(path, photos, ["a.jpg", "b.jpg"], mode)
    found = cameras(path)
    assert all(camera.has_prior_focal_length for camera in found.values())
    # 100 of 160 and of 80 pixels; those that share a camera have the first one's
    own = mode == pycolmap.CameraMode.PER_IMAGE
    expected = {"a.jpg": 25, "b.jpg": 50 if own else 25}
    assert {name: round(one.mean_focal_length()) for name, one in found.items()} == expected


def test_all_are_zoomed(photos):
    path, options = photos / "database.db", {"default_focal_length_factor": 2.0}
    names = ["c.jpg", "d.jpg"]
    database.import_images(path, photos, names, pycolmap.CameraMode.AUTO, options)
    assert [camera.mean_focal_length() for camera in cameras(path).values()] == [80, 80]


@pytest.mark.parametrize(
    ("mode", "options", "number"),
    [("SINGLE", {}, 1), ("PER_IMAGE", {}, 4), ("AUTO", {"camera_params": "50,20,15,0"}, 1)],
)
def test_what_is_asked_for_comes_first(photos, mode, options, number):
    path = photos / "database.db"
    database.import_images(path, photos, [*ZOOMS], pycolmap.CameraMode.__members__[mode], options)
    assert len({camera.camera_id for camera in cameras(path).values()}) == number


FISHEYE = {"camera_model": "OPENCV_FISHEYE"}


def test_a_fisheye_is_guessed_unless_somebody_knows_it(photos):
    """Its guess counts as known: no fundamental matrix explains its image."""
    for name in ZOOMS:
        Image.new("RGB", (40, 30)).save(photos / name)
    single = pycolmap.CameraMode.SINGLE
    database.import_images(photos / "1.db", photos, [*ZOOMS], single, FISHEYE)
    [camera] = colmap.read_cameras(photos / "1.db").values()
    assert camera.model.name == "OPENCV_FISHEYE" and camera.has_prior_focal_length
    assert camera.mean_focal_length() == database.GUESSED_FISHEYE * 40
    given = colmap.lens_options("OPENCV_FISHEYE", "17,18,20,15,0.1,0,0,0")
    database.import_images(photos / "2.db", photos, [*ZOOMS], single, given)
    [camera] = colmap.read_cameras(photos / "2.db").values()
    assert list(camera.params) == [17, 18, 20, 15, 0.1, 0, 0, 0] and camera.has_prior_focal_length


def test_the_focal_length_of_a_fisheye_by_exif_data(photos):
    database.import_images(photos / "1.db", photos, ["a.jpg"], pycolmap.CameraMode.AUTO, FISHEYE)
    [camera] = colmap.read_cameras(photos / "1.db").values()
    assert round(camera.mean_focal_length(), 1) == 41.6 and camera.has_prior_focal_length


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("FISH", None), "Unknown camera model 'FISH'. There are: .*OPENCV_FISHEYE"),
        (("EQUIRECTANGULAR", None), "Unknown camera model"),
        (("OPENCV_FISHEYE", "1,2"), "OPENCV_FISHEYE has 8, fx, fy, cx, cy, k1, k2, k3, k4"),
        (("PINHOLE", "a,b,c,d"), "PINHOLE has 4, fx, fy, cx, cy"),
        (("PINHOLE", "9,9,nan,4"), "PINHOLE has 4"),
        (("SIMPLE_RADIAL", "-9,9,4,0"), "focal lengths above 0"),
    ],
)
def test_what_is_no_lens(given, message):
    with pytest.raises(InputError, match=message):
        colmap.lens_options(*given)
    assert colmap.lens_options("SIMPLE_RADIAL") == {}  # as without it
