"""Intrinsics of photos that no list gives."""

import json
import re
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from hloc_reduce.localization import exif, intrinsics
from hloc_reduce.localization.intrinsics import MapCameras
from hloc_reduce.mapping.checks.another_size import of_photos
from hloc_reduce.mapping.findings import names_in
from hloc_reduce.utils import colmap

PARAMS = [500.0, 240.0, 180.0, -0.05]


def test_the_docs_name_every_source():
    text = (Path(__file__).parents[2] / "docs/localize.md").read_text()
    section = text.partition("\n## Intrinsics\n")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)
    assert set(rows) == {*intrinsics.REFINEMENTS, "given"}


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


def write_photo(
    path, make="Maker", focal_35mm=36, size=(480, 360), zoom=None, taken=None, pixels_per_inch=None
):
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = make, "Phone 1"
    if focal_35mm is not None:
        exif.get_ifd(0x8769)[0xA405] = focal_35mm
    if pixels_per_inch is not None:
        # fractions, as cameras write them
        exif.get_ifd(0x8769)[0x920A] = IFDRational(250, 10)  # mm
        exif.get_ifd(0x8769)[0xA20E] = IFDRational(1000 * pixels_per_inch, 1000)
        exif.get_ifd(0x8769)[0xA210] = 2  # inches
    if zoom is not None:
        exif.get_ifd(0x8769)[0xA404] = zoom
    if taken is not None:
        exif.get_ifd(0x8769)[0xA002], exif.get_ifd(0x8769)[0xA003] = taken
    Image.new("RGB", size, (90, 120, 150)).save(path, exif=exif)


def test_the_camera_of_a_map_is_known_again(tmp_path):
    for i in range(4):
        write_photo(tmp_path / f"{i}.jpg")
    known = intrinsics.of_map(map_of([1, 1, 1, 1]), tmp_path)
    assert known.sizes == {(480, 360)} and len(known.known) == 1
    write_photo(tmp_path / "new.jpg")
    camera, source = intrinsics.infer(tmp_path / "new.jpg", known)
    assert source == "map" and camera.params.tolist() == PARAMS
    assert not {"estimation", "refinement"} & {*intrinsics.REFINEMENTS["map"]}  # as exact as a list
    for changed in ({"make": "Other"}, {"focal_35mm": 50}, {"size": (360, 480)}):
        write_photo(tmp_path / "new.jpg", **changed)
        assert intrinsics.infer(tmp_path / "new.jpg", known)[1] == "EXIF"


@pytest.mark.fault(6)
@pytest.mark.parametrize(("focal_35mm", "source"), [(35, "EXIF"), (65535, "guess"), (1, "guess")])
def test_a_focal_length_that_no_lens_has_tells_nothing(focal_35mm, source, tmp_path):
    """Some programs write the largest number for one that they do not know."""
    write_photo(tmp_path / "0.jpg", focal_35mm=focal_35mm)
    camera, found = intrinsics.infer(tmp_path / "0.jpg", MapCameras({}, {(480, 360)}))
    assert found == source and 400 < camera.mean_focal_length() < 600
    assert camera.has_prior_focal_length == (source == "EXIF")


@pytest.mark.parametrize(
    ("size", "taken", "focal_length"),
    [
        ((480, 360), (480, 360), 500),
        ((240, 180), (480, 360), 250),  # made smaller
        ((180, 240), (480, 360), 250),  # and turned
    ],
)
def test_the_size_of_a_pixel_is_that_of_the_camera(size, taken, focal_length, tmp_path):
    write_photo(tmp_path / "0.jpg", focal_35mm=None, size=size, taken=taken, pixels_per_inch=508)
    camera, source = intrinsics.infer(tmp_path / "0.jpg", MapCameras({}, set()))
    assert source == "EXIF" and camera.mean_focal_length() == pytest.approx(focal_length, rel=0.01)
    write_photo(tmp_path / "0.jpg", size=size, taken=taken, pixels_per_inch=508)
    camera, _ = intrinsics.infer(tmp_path / "0.jpg", MapCameras({}, set()))
    assert camera.mean_focal_length() == pytest.approx(max(size) * 1.04, rel=0.01)  # by 36 mm


@pytest.mark.parametrize(
    "changed",
    [
        {"size": (300, 360), "cropped": True},  # leaves the focal length as it is
        {"size": (480, 360), "zoomed": True},
        {"size": (960, 720)},  # the size in EXIF data is wrong
        {"full_size": (960.0, 800.0)},  # COLMAP's is by other data
        {"full_size": (0.0, 0.0)},
        {"full_size": (float("inf"), float("nan"))},
    ],
)
def test_focal_lengths_that_are_not_corrected(changed):
    told = {"size": (480, 360), "zoomed": False, "full_size": (960.0, 500.0)}
    given = exif.ExifCamera("Maker Phone 1", "Maker Phone 1 25 mm", **{**told, **changed})
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=480, height=360, params=[500, 9, 9, 0])
    right = exif.ExifCamera("Maker Phone 1", "Maker Phone 1 25 mm", **told)
    assert exif.correct(camera, right) is False  # it is guessed
    camera.has_prior_focal_length = True
    assert exif.correct(camera, given) is False and camera.params[0] == 500
    assert exif.correct(camera, right) is True and camera.params[0] == 250


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({}, 500),
        ({0xA210: 3}, 1270),  # centimetres
        ({0xA210: 1}, 0),
        ({0xA210: None}, 0),
        ({0xA20E: (1, 2)}, 0),
        ({0x920A: "wide"}, 0),
    ],
)
def test_the_focal_length_in_pixels_of_the_sensor(changed, expected):
    tags = {0x920A: 25, 0xA20E: 508.0, 0xA210: 2, **changed}
    assert exif._in_pixels(tags) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("changed", "source"),
    [
        ({"zoom": 1.0}, "map"),
        ({"zoom": 2.0}, "unknown"),  # phones write the same focal length
        ({"zoom": 2.0, "make": "Other"}, "unknown"),
        ({"size": (288, 216)}, "unknown"),  # cropped, or made smaller
        ({"size": (288, 216), "make": "Other"}, "EXIF"),
        ({"taken": (4000, 3000)}, "map"),  # made smaller
        ({"taken": (3000, 4000)}, "map"),  # and turned
        ({"taken": (4030, 3000)}, "map"),
        ({"taken": (0, 3000)}, "map"),  # as some programs write
        ({"taken": (1, 3000)}, "map"),
        ({"taken": (4000, 2250)}, "unknown"),  # cropped
        ({"taken": (4000, 2250), "make": "Other"}, "unknown"),
        ({"taken": (480, 480), "size": (360, 480)}, "unknown"),
        ({"taken": (4000, 4000), "size": (480, 480)}, "unknown"),  # by a program, anywhere
        ({"size": (480, 480)}, "unknown"),
    ],
)
def test_what_was_zoomed_or_cut_keeps_its_exif_data(changed, source, tmp_path):
    for i in range(3):
        write_photo(tmp_path / f"{i}.jpg")
    known = intrinsics.of_map(map_of([1, 1, 1]), tmp_path)
    write_photo(tmp_path / "new.jpg", **changed)
    camera, found = intrinsics.infer(tmp_path / "new.jpg", known)
    assert found == source and (source != "unknown" or not camera.has_prior_focal_length)


@pytest.mark.parametrize("content", [b"", b"no image", b"\xff\xd8\xff\xe1\x00\x10Exif\0\0MM"])
def test_broken_exif_data_tell_nothing(content, tmp_path):
    (tmp_path / "a.jpg").write_bytes(content)
    assert exif.exif_camera(tmp_path / "a.jpg") is None
    assert exif.exif_camera(tmp_path / "absent.jpg") is None


@pytest.mark.parametrize(
    "taken", [(None, 3), ((4, 4), 3), (b"\0\1", 3), ("wide", 3), (float("nan"), 3), (-4, 3)]
)
def test_odd_sizes_in_exif_data_tell_nothing(taken):
    assert not exif._is_cropped((480, 360), exif._sides(taken))


def test_a_camera_of_few_photos_or_of_several_models_is_not_known(tmp_path):
    for i in range(4):
        write_photo(tmp_path / f"{i}.jpg")
    assert intrinsics.of_map(map_of([1, 1]), tmp_path).known == {}
    assert intrinsics.of_map(map_of([1, 1, 1, 2]), tmp_path).known == {}
    assert len(intrinsics.of_map(map_of([1, 1, 1]), tmp_path).known) == 1


def test_a_photo_of_the_size_of_the_map_is_hardly_cropped():
    photo = np.zeros((360, 480), np.uint8)
    for sizes, source in (({(480, 360)}, "guess"), ({(360, 480)}, "guess"), (set(), "unknown")):
        camera, found = intrinsics.infer(photo, MapCameras({}, sizes))
        assert camera.params.tolist() == [576, 240, 180, 0] and found == source


def another_size(image_dir, names):
    """Return the photos of another size than most by their lens, sorted."""
    return sorted(names_in(of_photos(image_dir, names)))


def test_photos_of_another_size_by_the_same_lens(tmp_path):
    """As crops whose EXIF data stay; three of a size are a setting, and a turn is none."""
    for i in range(4):
        write_photo(tmp_path / f"{i}.jpg", size=(360, 480) if i == 3 else (480, 360))
    write_photo(tmp_path / "crop.jpg", size=(336, 252))
    write_photo(tmp_path / "wide.jpg", size=(480, 270))
    write_photo(tmp_path / "tele.jpg", focal_35mm=90, size=(240, 180))
    names = [path.name for path in tmp_path.iterdir()]
    assert another_size(tmp_path, names) == ["crop.jpg"]
    assert another_size(tmp_path, ["0.jpg", "1.jpg", "crop.jpg"]) == []
    for i in range(3):
        write_photo(tmp_path / f"half{i}.jpg", size=(240, 180))
    write_photo(tmp_path / "zoomed.jpg", size=(200, 150), zoom=2)  # has a camera of its own
    names = [path.name for path in tmp_path.iterdir()]
    assert another_size(tmp_path, names) == ["crop.jpg"]
    for i in range(3, 5):  # no size is that of most
        write_photo(tmp_path / f"half{i}.jpg", size=(240, 180))
    names = [path.name for path in tmp_path.iterdir()]
    assert another_size(tmp_path, names) == []


def test_photos_of_another_shape_than_exif_data_say(tmp_path):
    """They are left out, however many of a size there are, if more were not cropped."""
    for i in range(4):
        write_photo(tmp_path / f"{i}.jpg", taken=(4000, 3000))
    names = [f"{i}.jpg" for i in range(7)]
    for i in range(4, 7):
        write_photo(tmp_path / names[i], taken=(4000, 2250))
    assert another_size(tmp_path, names) == names[4:]
    assert another_size(tmp_path, names[1:]) == []
    assert another_size(tmp_path, names[4:]) == []


def test_a_guess_knows_the_focal_lengths_of_the_map(tmp_path):
    """A crop that was enlarged has the size of the map's photos, but a longer focal length."""
    known = intrinsics.of_map(map_of([1, 2, 2]), tmp_path)
    assert known.focal_lengths == (PARAMS[0] / 480, PARAMS[0] / 480)
    for size in ((360, 480), (480, 360)):
        camera, source = intrinsics.infer(np.zeros(size, np.uint8), known)
        found = dict(intrinsics.refinement(camera, source, known))
        photo = found.pop("photo")
        assert photo["focal_lengths"] == pytest.approx([500, 500])
        assert photo["typical"] == [500 / 480, -0.05, 0.5, 0.5]
        assert found == intrinsics.REFINEMENTS["guess"]
    assert intrinsics.refinement(camera, "unknown", known) == intrinsics.REFINEMENTS["unknown"]
    before = known._replace(focal_lengths=None)  # a map of an earlier version
    assert intrinsics.refinement(camera, "guess", before) == intrinsics.REFINEMENTS["guess"]
    for wrong in ([1], [2, 1], [0, 1], [1, float("nan")], ["a", "b"]):
        with pytest.raises(ValueError):
            intrinsics.to_range(wrong)


def photos_of(*cameras: tuple) -> MapCameras:
    """Return what photos tell, from the model, size and parameters of the camera of each."""
    made = (
        pycolmap.Camera(model=model, width=width, height=height, params=params)
        for model, width, height, params in cameras
    )
    return intrinsics.of_cameras(made)


def test_the_typical_lens_is_the_median_of_photos_of_a_size():
    alike = [
        ("SIMPLE_RADIAL", 480, 360, [490, 240, 180, -0.02]),
        ("SIMPLE_RADIAL", 480, 360, [500, 246, 180, 0.02]),
        ("PINHOLE", 480, 360, [508, 512, 249, 183]),
    ]
    few = ("SIMPLE_PINHOLE", 640, 480, [600, 320, 240])
    found = photos_of(*alike, few, few)
    assert found.sizes == {(480, 360), (640, 480)} and {*found.typical} == {(480, 360)}
    assert [*found.typical[480, 360]] == pytest.approx([500 / 480, 0, 246 / 480, 0.5])
    for other in (
        ("SIMPLE_PINHOLE", 480, 360, [540, 240, 180]),  # another zoom
        ("SIMPLE_RADIAL", 480, 360, [500, 240, 180, 0.1]),
        ("PINHOLE", 480, 360, [490, 520, 240, 180]),
        ("PINHOLE", 480, 360, [500, 500, 240, 190]),
        ("RADIAL", 480, 360, [500, 240, 180, 0, 0]),
        ("OPENCV_FISHEYE", 480, 360, [500, 500, 240, 180, 0, 0, 0, 0]),
    ):
        assert photos_of(*alike, other).typical == {}
    assert photos_of(*3 * [("SIMPLE_PINHOLE", 480, 360, [5000, 240, 180])]).typical == {}
    rows = intrinsics.to_dict(found)["typical"]
    assert intrinsics.from_rows(json.loads(json.dumps(rows))) == found.typical
    assert intrinsics.merged(found, found).typical == {}  # together they might differ
    for size, expected in ((480, 360), (246 / 480, 0.5)), ((360, 480), (0.5, 0.5)):
        camera, source = intrinsics.infer(np.zeros(size[::-1], np.uint8), found)
        lens = intrinsics.refinement(camera, source, found)["photo"]["typical"]
        assert lens[2:] == pytest.approx(expected)


@pytest.mark.parametrize(
    "row",
    [
        [480, 360, 1],
        [480, 360, 0, 0],
        [480, 360, "x", 0],
        [480, 360, 1, float("nan")],
        [[], 1, 1, 1],
        [480, 360, 1, 0, 0, 0, 0],
        [480, -1, 1, 0],
        [float("inf"), 1, 1, 0],
        [1],
        [480, 360, 1e9, 0],
        [480, 360, 1, 0, float("inf"), 0],
    ],
)
def test_wrong_rows_of_typical_lenses(row):
    with pytest.raises((ValueError, TypeError)):
        intrinsics.from_rows([row])


def test_intrinsics_in_a_list_are_the_same():
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=480, height=360, params=PARAMS)
    again = intrinsics.from_list(json.loads(json.dumps(intrinsics.to_list(camera))))
    assert again.model == camera.model and (again.width, again.height) == (480, 360)
    assert again.params.tolist() == PARAMS
    for wrong in ([], ["PINHOLE", 480, 360], ["NO", 480, 360, 1], [*intrinsics.to_list(camera), 1]):
        with pytest.raises(ValueError):
            intrinsics.from_list(wrong)
