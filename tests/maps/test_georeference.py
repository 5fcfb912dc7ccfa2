"""Maps in metres: by GPS in EXIF data or a CSV file, or by a distance."""

import json
import shutil

import numpy as np
import pycolmap
import pytest
from command import outcome, state, write
from PIL import Image

from benchmarks.metres import geotag
from hloc_reduce import Localizer, compact, maps
from hloc_reduce.hlm.reader import CompactMap
from hloc_reduce.localization.frame import UNKNOWN, Frame
from hloc_reduce.serve import answer
from hloc_reduce.utils import colmap
from pipelines import localize

PIPELINE = localize
ORIGIN = np.array([47.375, 8.5, 408.5])
METRES = 30.0  # in a unit of the plane's model, in whose frame x is east, y north and z up
DEGREE = 111_200.0  # metres, of latitude
NAMES = [f"db/{i}.png" for i in range(4)]


def true_positions(model):
    """Return the GPS positions of the images of a model, by name."""
    images = pycolmap.Reconstruction(model).images.values()
    centres = METRES * np.array([image.projection_center() for image in images])
    found = colmap.ellipsoid_from_enu(centres, ORIGIN)
    return {image.name: place for image, place in zip(images, found, strict=True)}


def write_gps(path, positions):
    rows = [f"{name},{','.join(map(repr, map(float, place)))}" for name, place in positions.items()]
    return write(path, "\n".join(["name,latitude,longitude,altitude", *rows, ""]))


def metres_between(first, second):
    """Return the distance of two positions, of dicts as in `Frame.wgs84`."""
    rows = [
        [float(one[key]) for key in ("latitude", "longitude", "altitude")]
        for one in (first, second)
    ]
    return np.linalg.norm(colmap.enu_from_ellipsoid(np.array(rows), np.array(rows[0]))[1])


def named(position):
    return dict(zip(("latitude", "longitude", "altitude"), position, strict=True))


def distances(folder):
    """Return the distances of the cameras of a map from the first one, by name."""
    images = colmap.read_model(maps.Map(folder).sfm).images.values()
    centres = {image.name: image.projection_center() for image in images}
    first = centres[min(centres)]
    return {name: np.linalg.norm(centre - first) for name, centre in centres.items()}


@pytest.fixture
def tagged(plane, tmp_path):
    """The photos of the plane, the last one as a query, with GPS."""
    for name, position in true_positions(plane / "model").items():
        folder = tmp_path / ("query" if name == "4.png" else "photos")
        folder.mkdir(exist_ok=True)
        jpeg = (folder / name).with_suffix(".jpg")
        Image.open(plane / "images" / name).save(jpeg, quality=98)
        geotag(jpeg, jpeg, position)
    return tmp_path / "photos"


@pytest.fixture
def alone(tagged, tmp_path):
    """The options that build a map of photos with GPS."""
    return "--map_images", tagged, "--outputs", tmp_path / "outputs", "--camera_mode", "single"


@pytest.fixture
def posed(place, tmp_path, run, written_once):
    """The options that build a map of photos with poses, its folder, and their GPS positions."""
    (_, model, _, images, _, outputs), _, _ = place
    build = "--map", model, "--map_images", images, "--outputs", outputs
    written_once(outputs, lambda: run(*build), "posed")
    positions = true_positions(model)
    return build, outputs / "map", {name: positions[name] for name in NAMES}


def test_photos_alone(plane, alone, tmp_path, caplog, run):
    """Are in metres if they have GPS; and queries are on Earth."""
    caplog.set_level("INFO")
    run(*alone, "--query_images", tmp_path / "query")
    assert "4 of 4 photos with GPS fit" in caplog.text
    built = maps.Map(tmp_path / "outputs/map")
    assert built.frame.units == "m" and built.frame.told_by == ("gps",)
    assert built.aligned_to == {"gps": "EXIF"} and built.sfm.name == "sfm-2"
    assert [path.name for path in built.folder.glob("sfm*")] == ["sfm-2"]
    true = {
        image.name: METRES * image.projection_center()
        for image in pycolmap.Reconstruction(plane / "model").images.values()
    }
    for name, distance in distances(built.folder).items():
        expected = np.linalg.norm(true[name.replace("jpg", "png")] - true["0.png"])
        assert distance == pytest.approx(expected, abs=0.02 * METRES)
    summary, rows = outcome(tmp_path / "outputs/queries-query")
    assert summary["map_frame"] == built.frame.to_json()
    expected = named(true_positions(plane / "model")["4.png"])
    assert rows["4.jpg"]["status"] == "localized"
    assert metres_between(rows["4.jpg"], expected) < 0.03 * METRES
    written = state(built.folder)
    run(*alone)
    assert state(built.folder) == written
    run("--map", built.folder, "--scale", "0.jpg", "3.jpg", "1.25")
    moved = maps.Map(built.folder)
    for one in (written, state(moved.folder)):  # lists the photos in the map and the missing ones
        assert [path.name for path in one if "registration" in path.name] == ["registration.json"]


def test_few_photos_alone_with_gps(alone, tagged, tmp_path, caplog, run):
    """The map keeps its frame, and says so in a line."""
    caplog.set_level("INFO")
    for name in ("2.jpg", "3.jpg"):
        Image.open(tagged / name).save(tagged / name)
    run(*alone)
    [line] = [one.getMessage() for one in caplog.records if "GPS" in one.getMessage()]
    assert "Photos of the map with a GPS position: 2 (0.jpg, 1.jpg). At least 3 are needed" in line
    assert maps.Map(tmp_path / "outputs/map").frame == UNKNOWN


def test_photos_alone_whose_gps_says_nothing(alone, tagged, tmp_path, caplog, run):
    """As all were taken within the noise; a file that does not either is no error."""
    caplog.set_level("INFO")
    for i, path in enumerate(sorted(tagged.iterdir())):
        geotag(path, path, ORIGIN + [1e-5 * (i % 2), 1e-5 * (i // 2), 0])
    run(*alone)
    assert "The map is not aligned with the GPS of its photos." in caplog.text
    folder = tmp_path / "outputs/map"
    assert maps.Map(folder).frame == UNKNOWN and maps.Map(folder).sfm.name == "sfm"
    caplog.clear()
    path = write_gps(tmp_path / "gps.csv", {"0.jpg": ORIGIN})
    run(*alone, "--gps", path)
    assert (
        f"{folder} is not aligned with {path}. Photos of the map with a GPS position: 1 (0.jpg)."
        in caplog.text
    )
    assert maps.Map(folder).frame == UNKNOWN


def test_a_given_model(posed, place, tmp_path, caplog, run):
    """Is aligned on demand; compact files and grown maps keep the frame."""
    build, folder, positions = posed
    _, images, _ = place
    caplog.set_level("INFO")
    assert maps.Map(folder).frame == UNKNOWN
    before = distances(folder)
    others = positions | {"db/0.png": positions["db/0.png"] + [0.01, 0, 0], "db/x.png": ORIGIN}
    path = write_gps(tmp_path / "gps.csv", others)
    day = "--query_images", images / "query/day"
    run(*build, *day)
    assert "wgs84" not in outcome(folder.parent / "queries-day")[1]["a.png"]
    run(*build, "--gps", path, *day)
    assert f"These names in {path} are of no map photo: db/x.png." in caplog.text
    assert "GPS that contradicts the other photos is ignored: db/0.png (111" in caplog.text
    built = maps.Map(folder)
    assert built.frame.told_by == ("gps",)
    for name, distance in distances(folder).items():
        assert distance == pytest.approx(METRES * before[name], abs=1e-3)
    _, rows = outcome(folder.parent / "queries-day")  # were stale
    assert rows["grey.png"]["latitude"] == "" and rows["grey.png"]["heading"] == ""
    compact.main(tmp_path / "map.hlm", folder)
    assert CompactMap(tmp_path / "map.hlm").frame == built.frame
    run("--map", tmp_path / "map.hlm", "--outputs", tmp_path / "unpacked")
    assert maps.Map(tmp_path / "unpacked/map").frame == built.frame
    for where in (folder, tmp_path / "map.hlm"):
        _, info = Localizer(where).localize(images / "query/day/a.png")
        assert metres_between(info["wgs84"], rows["a.png"]) < 0.5
        assert info["wgs84"]["heading"] == pytest.approx(float(rows["a.png"]["heading"]), abs=1)
    localizer, photo = Localizer(folder), (images / "query/day/a.png").read_bytes()
    told = answer(localizer, photo, None, False)["wgs84"]
    assert told["heading"] == pytest.approx(info["wgs84"]["heading"], abs=0.1)
    assert localizer.localize(images / "query/day/grey.png")[1]["wgs84"] is None
    run("--map", folder, "--add_images", images / "query/day")
    assert maps.Map(folder).num_images == 5 and maps.Map(folder).frame == built.frame


def test_the_same_positions_again(posed, tmp_path, run):
    """Change nothing; others do, and so does the file of a map that was built."""
    build, folder, positions = posed
    path = write_gps(tmp_path / "gps.csv", positions)
    run(*build, "--gps", path)
    written = state(folder)
    run(*build, "--gps", path)
    run(*build)
    assert state(folder) == written
    first = maps.Map(folder)
    north = {name: place + [0.01, 0, 0] for name, place in positions.items()}
    run("--map", folder, "--gps", write_gps(path, north))
    moved = maps.Map(folder)
    assert moved.frame.origin[0] == pytest.approx(first.frame.origin[0] + 0.01)
    assert moved.id != first.id and moved.sfm.name != first.sfm.name
    assert not first.sfm.exists()


def test_positions_that_do_not_tell_the_frame_of_a_given_model(posed, tmp_path, refused):
    build, folder, positions = posed
    few = {name: positions[name] for name in NAMES[:2]}
    path = write_gps(tmp_path / "gps.csv", few)
    message = refused(*build, "--gps", path)
    assert "Photos of the map with a GPS position: 2 (db/0.png, db/1.png)" in message
    assert str(path) in message and maps.Map(folder).frame == UNKNOWN
    write_gps(path, {f"photos/{name}": place for name, place in positions.items()})
    message = refused(*build, "--gps", path)
    assert f"{path} has no photo of the map, such as db/0.png, but photos/db/0.png" in message
    write(path, "name,latitude,longitude,altitude\ndb/0.png,north,8,3\n")
    assert "gps.csv:2: the latitude 'north' is not a number" in refused(*build, "--gps", path)


def test_scale(posed, caplog, run):
    """Two cameras are as far apart as is said, and z is up as the cameras were held."""
    build, folder, _ = posed
    caplog.set_level("INFO")
    before = distances(folder)
    run(*build, "--scale", "db/0.png", "db/3.png", "1.25")
    built = maps.Map(folder)
    assert built.frame.units == "m" and built.frame.origin is None
    assert built.aligned_to == {"scale": ["db/0.png", "db/3.png", 1.25]}
    factor = 1.25 / before["db/3.png"]
    for name, distance in distances(folder).items():
        assert distance == pytest.approx(factor * before[name], rel=1e-6)
    assert built.frame.told_by == ("scale", "gravity") and "z is up as 4 of 4" in caplog.text
    images = colmap.read_model(built.sfm).images.values()
    downs = np.array([image.cam_from_world().rotation.matrix()[1] for image in images])
    assert downs.mean(axis=0)[2] < -0.9  # although they were tilted by up to 34 degrees


def test_scale_without_the_photos(posed, tmp_path, caplog, run):
    """They may be stored turned, and no EXIF data tell: nothing says which way is up."""
    _, folder, _ = posed
    caplog.set_level("INFO")
    content = json.loads((folder / "map.json").read_text())
    images = tmp_path / "moved"
    write(folder / "map.json", json.dumps(content | {"image_dir": str(images)}))
    run("--map", folder, "--scale", "db/0.png", "db/3.png", "1.25")
    assert maps.Map(folder).frame == Frame("m", ("scale",))
    assert f"or their photos are no longer in {images}" in caplog.text


@pytest.mark.parametrize(
    ("scale", "said"),
    [
        (("db/0.png", "db/9.png", "1"), "there is no photo db/9.png in"),
        (
            ("db/0.png", "query/day/a.png", "1"),
            "the map has no photo query/day/a.png, but db/0.png",
        ),
        (("db/0.png", "db/3.png", "0"), "the distance, 0, must be a number of metres above 0"),
        (("db/0.png", "db/3.png", "-1"), "the distance, -1, must be"),
        (("db/0.png", "db/3.png", "inf"), "the distance, inf, must be"),
        (("db/0.png", "db/3.png", "nan"), "the distance, nan, must be"),
        (("db/0.png", "db/3.png", "far"), "the distance, far, must be"),
        (("db/0.png", "db/0.png", "1"), "the two photos must be different"),
    ],
)
def test_wrong_scales(posed, refused, scale, said):
    build, folder, _ = posed
    before = maps.Map(folder).id
    assert said in refused(*build, "--scale", *scale)
    assert maps.Map(folder).frame == UNKNOWN and maps.Map(folder).id == before


def test_scales_in_python(posed):
    folder = posed[1]
    maps.align(maps.Map(folder), scale=("db/0.png", "db/3.png", 2))
    assert distances(folder)["db/3.png"] == pytest.approx(2)
    with pytest.raises(ValueError, match="give two photos and the distance"):
        maps.align(maps.Map(folder), scale=("db/0.png", "db/3.png"))
    with pytest.raises(ValueError, match="not both"):
        maps.align(maps.Map(folder))


def test_options_that_contradict_each_other(posed, tmp_path, refused):
    build, folder, positions = posed
    given = "--gps", write_gps(tmp_path / "gps.csv", positions)
    scale = "--scale", "db/0.png", "db/3.png", "1"
    assert "Give --gps or --scale, not both." in refused(*build, *given, *scale)
    compact.main(tmp_path / "map.hlm", folder)
    message = refused("--map", tmp_path / "map.hlm", *given, "--outputs", tmp_path / "unpacked")
    assert "is a compact map, whose frame cannot be changed" in message
    maps.unpack(tmp_path / "map.hlm", tmp_path / "unpacked/map")
    rigs = "--rigs", tmp_path / "rigs.json"
    assert "leave out --rigs" in refused("--map", folder, *scale, *rigs)
    message = refused("--map", folder, *scale, "--pairs", "sequential")
    assert "--pairs is for maps of photos alone" in message
    message = refused("--map", tmp_path / "unpacked/map", *scale)
    assert "is an unpacked compact one" in message


def test_broken_frames(posed, tmp_path, refused):
    """In map.json and in a file, whose reader trusts nothing."""
    _, folder, _ = posed
    content = json.loads((folder / "map.json").read_text())
    wrong = Frame("m", ("gps",), (95.0, 0.0, 0.0)).to_json()
    shutil.copytree(folder, tmp_path / "broken")
    write(tmp_path / "broken/map.json", json.dumps(content | {"frame": wrong}))
    assert "has no sound map.json" in refused("--map", tmp_path / "broken", "--outputs", tmp_path)
    write(folder / "map.json", json.dumps(content | {"frame": Frame("m").to_json()}))
    compact.main(tmp_path / "map.hlm", folder)
    data = (tmp_path / "map.hlm").read_bytes()
    units = b'\\"units\\":\\"%s\\"'
    (tmp_path / "map.hlm").write_bytes(data.replace(units % b"m", units % b"X"))
    assert "a frame in 'X'" in refused("--map", tmp_path / "map.hlm", "--outputs", tmp_path / "u")
