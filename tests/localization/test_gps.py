"""GPS positions in EXIF data and CSV files, and wrong ones."""

import numpy as np
import pytest
from command import write
from PIL import Image, TiffImagePlugin

from hloc_reduce.localization import gps
from hloc_reduce.utils.cli import InputError

HEADER = "name,latitude,longitude,altitude\n"
RATIONAL = TiffImagePlugin.IFDRational
ZURICH = {1: "N", 2: (47.0, 22.0, 30.0), 3: "E", 4: (8.0, 30.0, 0.0), 5: b"\0", 6: 408.5}


def photo(path, tags):
    exif = Image.Exif()
    exif.get_ifd(0x8825).update(tags)
    Image.new("L", (8, 8)).save(path, exif=exif)
    return path


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({}, (47.375, 8.5, 408.5)),
        ({1: "S", 3: "W"}, (-47.375, -8.5, 408.5)),
        ({5: b"\1", 6: 12.25}, (47.375, 8.5, -12.25)),
        ({2: (47, 22.5, 0)}, (47.375, 8.5, 408.5)),
    ],
)
def test_exif(tmp_path, changed, expected):
    found = gps.of_photo(photo(tmp_path / "a.jpg", ZURICH | changed))
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_an_altitude_may_be_missing(tmp_path):
    tags = {tag: value for tag, value in ZURICH.items() if tag < 5}
    latitude, longitude, altitude = gps.of_photo(photo(tmp_path / "a.jpg", tags))
    assert (latitude, longitude) == (47.375, 8.5) and np.isnan(altitude)
    assert np.isnan(gps.of_photo(photo(tmp_path / "b.jpg", tags | {6: RATIONAL(1, 0)}))[2])


@pytest.mark.parametrize(
    "tags",
    [
        {},
        {2: (0, 0, 0), 4: (0, 0, 0)},
        {2: (91, 0, 0)},
        {4: (200, 0, 0)},
        {2: (RATIONAL(0, 0), 0, 0)},
        {2: (47, 22)},
        {2: 47.0},
    ],
)
def test_exif_without_a_sound_position(tmp_path, tags):
    found = gps.of_photos(tmp_path, [photo(tmp_path / "a.jpg", tags and ZURICH | tags).name])
    assert found == {}


def test_files_that_are_no_photos(tmp_path):
    write(tmp_path / "a.jpg", "text")
    assert gps.of_photos(tmp_path, ["a.jpg", "missing.jpg"]) == {}


def test_csv(tmp_path):
    """With a byte order mark, other columns, spaces, and missing altitudes and positions."""
    rows = "1,db/a.jpg, 47.375,8.5,408.5\n2,b.jpg,-47,8.5,\n3,c.jpg,0,0,0\n"
    path = write(tmp_path / "gps.csv", f"\ufeffid, {HEADER}{rows}")
    found = gps.read_csv(path)
    assert list(found) == ["db/a.jpg", "b.jpg"]
    np.testing.assert_array_equal(found["db/a.jpg"], (47.375, 8.5, 408.5))
    np.testing.assert_array_equal(found["b.jpg"], (-47, 8.5, np.nan))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no column name and no column latitude"),
        ("name,latitude,longitude\na.jpg,1,2\n", "no column altitude"),
        (f"{HEADER}a.jpg,1,2,3\nb.jpg,1,east,3\n", "gps.csv:3: the longitude 'east'"),
        (f"{HEADER}a.jpg,nan,2,3\n", "gps.csv:2: the latitude 'nan' is not a number"),
        (f"{HEADER}a.jpg,1,2,inf\n", "gps.csv:2: the altitude 'inf' is not a number"),
        (f"{HEADER}a.jpg,1\n", "gps.csv:2: the longitude '' is not a number"),
        (f"{HEADER}a.jpg,98.5,2,3\n", "gps.csv:2: latitude 98.5 and longitude 2"),
        (f"{HEADER}a.jpg,1,181,3\n", "Are they swapped?"),
        (f"{HEADER}a.jpg,1,2,3\na.jpg,1,2,3\n", "gps.csv:3: a.jpg is listed twice"),
        (f"{HEADER}a.jpg,47,3,8,5\n", "gps.csv:2 has more values than columns"),
        (f"{HEADER}/a.jpg,1,2,3\n", "gps.csv:2: '/a.jpg' cannot be names"),
        (f"{HEADER},1,2,3\n", "gps.csv:2: '' cannot be names"),
    ],
)
def test_wrong_csv(tmp_path, text, said):
    with pytest.raises(InputError) as error:
        gps.read_csv(write(tmp_path / "gps.csv", text))
    assert said in str(error.value) and "gps.csv" in str(error.value)


def test_csv_that_is_no_text(tmp_path):
    path = tmp_path / "gps.csv"
    path.write_bytes(HEADER.encode() + b"\xff\xfe,1,2,3\n")
    with pytest.raises(InputError, match=r"gps.csv:2: not text in UTF-8"):
        gps.read_csv(path)
    with pytest.raises(InputError, match="Cannot read"):
        gps.read_csv(tmp_path / "missing.csv")
