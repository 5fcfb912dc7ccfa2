"""Photos that are absent, broken, or of another size than their intrinsics: the others go on."""

import json
import shutil

import command
import pytest
from command import outcome
from PIL import Image

from hloc_reduce import maps
from hloc_reduce.localization.records import log_file, read_records
from hloc_reduce.utils import colmap, parsers
from pipelines import aachen, inloc, localize

PIPELINES = {"aachen": aachen, "inloc": inloc, "localize": localize}
BROKEN = {"empty": b"", "part": None, "text": b"no image", "absent": "absent"}


@pytest.fixture
def place(request, tmp_path):
    """Build the command of a pipeline, its outputs, a query by day of its layout and its name."""
    pipeline = request.param
    layout = request.getfixturevalue("inloc_layout" if pipeline == "inloc" else "aachen_layout")
    images = layout if pipeline == "inloc" else layout / "images_upright"
    name = "query/iphone7/a.JPG" if pipeline == "inloc" else "query/day/a.png"
    outputs = tmp_path / "outputs"
    if pipeline == "localize":
        model = layout / "3D-models/aachen_v_1_1"
        queries = layout / "queries/*_time_queries_with_intrinsics.txt"
        given = ("--map", model, "--map_images", images, "--outputs", outputs)
        given += ("--queries", queries, "--query_images", images)
        outputs = outputs / "queries-time_queries_with_intrinsics"
    else:
        given = ("--dataset", layout, "--outputs", outputs)
    return PIPELINES[pipeline], (*given, "--feature", "sift_sv16"), outputs, images / name, name


def harm(photo, content):
    if content == "absent":
        photo.unlink()
    else:
        photo.write_bytes(photo.read_bytes()[:1000] if content is None else content)


def h5_files(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*.h5")}


@pytest.mark.parametrize(
    "place, kind",
    [("aachen", "part"), ("inloc", "text"), ("localize", "absent")],
    indirect=["place"],
)
def test_a_query_that_cannot_be_read_does_not_stop_the_others(
    place, kind, tmp_path, monkeypatch, caplog
):
    pipeline, arguments, outputs, photo, name = place
    command.run(monkeypatch, pipeline, *arguments)
    expected = outcome(outputs)[1]
    shutil.rmtree(outputs)
    content = photo.read_bytes()
    harm(photo, BROKEN[kind])

    message = command.refused(monkeypatch, caplog, pipeline, *arguments, "--strict")
    assert photo.name in message
    caplog.clear()
    command.run(monkeypatch, pipeline, *arguments)
    summary, rows = outcome(outputs)
    assert list(rows) == list(expected) and summary["queries_unreadable"] == 1
    row = rows.pop(name)
    assert row["status"] == ("failed" if pipeline is inloc else "fallback")
    why = {"absent": "No such file or directory"}.get(
        kind, "it is not an image, or it is truncated"
    )
    assert row["reason"] == f"Cannot read image {photo}: {why}."
    assert rows == {other: row for other, row in expected.items() if other != name}
    logs = log_file(outputs / summary["poses"])
    assert read_records(logs)[name]["reason"] == row["reason"]
    line = f"1 of {len(expected)} queries are unreadable and not localized: {name} ({why})."
    assert any(line in record.getMessage() for record in caplog.records)
    # nothing is done anew but that it is read again
    before = h5_files(outputs)
    command.run(monkeypatch, pipeline, *arguments)
    assert h5_files(outputs) == before and outcome(outputs)[1][name] == row

    photo.write_bytes(content)
    matches = next(path for path in before if "_matches-" in path.name and "query" in path.name)
    identity = command.h5py.File(matches).attrs["id"]
    command.run(monkeypatch, pipeline, *arguments)
    assert outcome(outputs)[1] == expected and outcome(outputs)[0]["queries_unreadable"] == 0
    assert command.h5py.File(matches).attrs["id"] == identity  # its pairs were added


@pytest.mark.parametrize("place", PIPELINES, indirect=True)
def test_no_query_can_be_read(place, monkeypatch, caplog):
    pipeline, arguments, outputs, photo, name = place
    images = photo.parents[1] if pipeline is inloc else photo.parents[2]
    photos = [path for path in images.rglob("*") if path.is_file() and "query" in path.parts]
    photos = [path for path in photos if path.suffix in (".png", ".JPG")]
    for path in photos:
        path.write_bytes(b"no image")
    command.run(monkeypatch, pipeline, *arguments)
    _, rows = outcome(outputs)
    assert len(rows) == len(photos) == 3
    assert all("Cannot read image" in row["reason"] for row in rows.values())
    for path in photos:
        path.unlink()
    shutil.rmtree(outputs)
    message = command.refused(monkeypatch, caplog, pipeline, *arguments)
    assert "3 of 3 images are not in" in message


@pytest.mark.parametrize("place", PIPELINES, indirect=True)
def test_intrinsics_of_another_size(place, monkeypatch, caplog):
    """The query is not localized, rather than wrongly."""
    pipeline, arguments, outputs, photo, name = place
    folder = next(path for path in photo.parents if list(path.rglob("*_with_intrinsics.txt")))
    (path,) = (p for p in folder.rglob("*_with_intrinsics.txt") if name in p.read_text())
    lines = path.read_text().splitlines()
    wrong = [line.replace(" 360 270 ", " 100 100 ") if name in line else line for line in lines]
    path.write_text("\n".join(wrong))
    command.run(monkeypatch, pipeline, *arguments)
    row = outcome(outputs)[1][name]
    assert row["status"] != "localized" and row["num_inliers"] == "0"
    assert row["reason"] == "the intrinsics are for 100x100 pixels, the photo has 360x270"
    reason = "the intrinsics are for 100x100 pixels, the photo has 360x270"
    assert "Not localized: " in caplog.text and f"{name} ({reason})" in caplog.text
    path.write_text("\n".join(lines))
    command.run(monkeypatch, pipeline, *arguments)
    assert outcome(outputs)[1][name]["status"] == "localized"


def test_queries_without_a_list(aachen_layout, tmp_path, monkeypatch, caplog):
    """Their intrinsics are not known either, if they cannot be read."""
    images, outputs = aachen_layout / "images_upright", tmp_path / "outputs"
    model = aachen_layout / "3D-models/aachen_v_1_1"
    arguments = ("--map", model, "--map_images", images, "--outputs", outputs)
    arguments += ("--query_images", images / "query/day", "--feature", "sift_sv16")
    broken = images / "query/day/new.png"
    broken.write_bytes(b"")
    assert "new.png" in command.refused(monkeypatch, caplog, localize, *arguments, "--strict")
    command.run(monkeypatch, localize, *arguments)
    summary, rows = outcome(outputs / "queries-day")
    assert [row["status"] for row in rows.values()] == ["localized", "fallback", "fallback"]
    assert rows["new.png"]["reason"] == f"Cannot read image {broken}: it is empty."
    assert summary["intrinsics"] == {"guess": 2}
    logs = log_file(outputs / "queries-day" / summary["poses"])
    assert read_records(logs)["new.png"]["camera"] is None
    shutil.copy(images / "query/day/a.png", broken)
    command.run(monkeypatch, localize, *arguments)
    summary, rows = outcome(outputs / "queries-day")
    assert rows["new.png"]["status"] == "localized" and rows["new.png"]["reason"] == ""
    assert summary["intrinsics"] == {"guess": 3}
    listed = outputs / "queries-day/queries_with_intrinsics.txt"
    assert [name for name, _ in parsers.parse_query_list(listed)] == list(rows)


@pytest.mark.parametrize("kind", ["absent", "part"])
def test_a_map_photo_that_cannot_be_read(kind, aachen_layout, tmp_path, monkeypatch, caplog):
    images, outputs = aachen_layout / "images_upright", tmp_path / "outputs"
    arguments = ("--dataset", aachen_layout, "--outputs", outputs, "--feature", "sift_sv16")
    command.run(monkeypatch, aachen, *arguments, "--outputs", tmp_path / "whole")
    photo = images / "db/1.png"
    content = photo.read_bytes()
    harm(photo, BROKEN[kind])
    message = command.refused(monkeypatch, caplog, aachen, *arguments)
    assert "1 of 4 images of the map" in message and "--accept_partial" in message
    assert "db/1.png" in message

    command.run(monkeypatch, aachen, *arguments, "--accept_partial")
    summary, rows = outcome(outputs)
    assert summary["map_images"] == 3 and summary["queries_localized"] == 2
    assert summary["queries_unreadable"] == 0
    (sfm,) = outputs.glob("sfm_sift*")
    assert {image.name for image in colmap.read_model(sfm).images.values()} == {
        "db/0.png",
        "db/2.png",
        "db/3.png",
    }
    assert "db/1.png" not in (outputs / "pairs-db-covis20.txt").read_text()
    before = h5_files(outputs) | {path: path.stat().st_mtime_ns for path in sfm.iterdir()}
    command.run(monkeypatch, aachen, *arguments, "--accept_partial")
    assert before == {path: path.stat().st_mtime_ns for path in before}

    photo.write_bytes(content)
    command.run(monkeypatch, aachen, *arguments)
    assert outcome(outputs)[1] == outcome(tmp_path / "whole")[1]


@pytest.mark.fault(10)
@pytest.mark.parametrize("place", ["aachen", "localize"], indirect=True)
def test_all_photos_of_the_map_that_cannot_be_read_are_named(place, monkeypatch, caplog):
    """One of them is a photo of another format, which OpenCV would read."""
    pipeline, arguments, _, query, _ = place
    images = query.parents[2]
    Image.open(images / "db/1.png").save(images / "db/1.png", "WEBP")
    harm(images / "db/2.png", b"")
    message = command.refused(monkeypatch, caplog, pipeline, *arguments)
    how = "`magick mogrify -format png` converts it"
    assert f"db/1.png (it is WebP, not JPEG or PNG; {how})" in message
    assert "db/2.png (it is empty)" in message


def test_a_cutout_that_cannot_be_read(inloc_layout, tmp_path, monkeypatch, caplog):
    arguments = ("--dataset", inloc_layout, "--outputs", tmp_path / "o", "--feature", "sift_sv16")
    name = "database/cutouts/PLA1/001/PLA_cutout_001_0_0.jpg"
    harm(inloc_layout / name, b"no image")
    message = command.refused(monkeypatch, caplog, inloc, *arguments)
    assert f"1 of 4 images of the map cannot be read: {name} (it is not an image" in message
    command.run(monkeypatch, inloc, *arguments, "--accept_partial")
    summary, rows = outcome(tmp_path / "o")
    assert summary["map_images"] == 3 and summary["queries_localized"] == 2
    assert name not in (tmp_path / "o/pairs-query-vlad40.txt").read_text()


@pytest.mark.parametrize("kind", ["absent", "part"])
def test_a_map_of_a_part_of_a_model(kind, aachen_layout, tmp_path, monkeypatch, caplog):
    images, model = aachen_layout / "images_upright", aachen_layout / "3D-models/aachen_v_1_1"
    arguments = ("--map", model, "--map_images", images, "--outputs", tmp_path / "o")
    harm(images / "db/1.png", BROKEN[kind])
    message = command.refused(monkeypatch, caplog, localize, *arguments)
    assert "db/1.png" in message
    if kind == "absent":
        assert "1 of 4 images of the map are not in" in message and "--accept_partial" in message
    command.run(monkeypatch, localize, *arguments, "--accept_partial")
    built = maps.Map(tmp_path / "o/map")
    assert built.names() == ["db/0.png", "db/2.png", "db/3.png"]
    assert json.loads((built.folder / "map.json").read_text())["model"] == str(model)
    assert not (built.folder / "sfm_reference").exists()
    for name in ("0", "2", "3"):
        (images / f"db/{name}.png").unlink()
    arguments = (*arguments[:4], "--outputs", tmp_path / "other", "--accept_partial")
    if kind == "absent":
        assert "4 of 4 images" in command.refused(monkeypatch, caplog, localize, *arguments)
