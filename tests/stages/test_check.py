"""What is doubtful in a COLMAP model of a user."""

import json
import sys

import command
import cv2
import numpy as np
import pycolmap
import pytest
from colmap_database import write_old
from command import state
from row_of_photos import row

from hloc_reduce import check, maps
from hloc_reduce.mapping.checks import CHECKS
from hloc_reduce.utils import colmap


@pytest.fixture
def given(tmp_path):
    """Writes the model of a row of photos, some of them turned, and its database; and an image."""

    def write(turned):
        model, verified = row(turned)
        generator = np.random.default_rng(0)
        keypoints = {}
        for image in model.images.values():
            for point in image.points2D:
                point.xy += generator.normal(0, 0.3, 2)
            keypoints[image.name] = np.array([point.xy for point in image.points2D])
            grey = np.full((480, 640), 40 * int(image.name[0]), np.uint8)
            cv2.imwrite(str(tmp_path / image.name), grey)
        model.update_point_3d_errors()
        (tmp_path / "sparse").mkdir()
        model.write(tmp_path / "sparse")
        database = tmp_path / "database.db"
        colmap.write_reference(database, model)
        matches = {pair: (rows, rows) for pair, rows in verified.items()}
        colmap.write_matches(database, keypoints, matches)
        return tmp_path / "sparse", database

    return write


@pytest.fixture
def run(monkeypatch, capsys):
    """Runs the command and returns what it prints."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["check", *map(str, arguments)])
        check._main()
        return capsys.readouterr().out

    return run


def test_a_sound_model(given, tmp_path, run):
    model, database = given({})
    before = state(tmp_path)
    said = run(model)
    assert said.startswith("Nothing doubtful was found by ")
    assert said.strip().endswith("were not possible without --database / --images.")
    said = run(model, "--database", database, "--images", tmp_path, "--json", tmp_path / "a.json")
    assert said.startswith(f"Nothing doubtful was found by {len(CHECKS) - 1} checks; 1 was not ")
    assert said.strip().endswith("possible without SIFT descriptors in the database.")
    assert json.loads((tmp_path / "a.json").read_text()) == []
    after = state(tmp_path)
    assert {path: after[path] for path in before} == before  # the database, too


@pytest.mark.parametrize(("degrees", "kind"), [(5.0, "misplaced"), (0.4, "misfits")])
def test_a_photo_that_was_turned_is_named(degrees, kind, given, tmp_path, run):
    model, database = given({2: degrees})
    said = run(model, "--database", database, "--json", tmp_path / "a.json")
    (paragraph,) = [part for part in said.split("\n\n") if part.startswith(f"{kind}: ")]
    assert "2.jpg" in paragraph and "3.jpg" not in paragraph
    assert "Nothing else doubtful was found" in said
    content = {one["kind"]: one for one in json.loads((tmp_path / "a.json").read_text())}
    assert content[kind]["names"] == ["2.jpg"] and "{names}" not in content[kind]["text"]


def test_photos_that_are_missing_are_named(given, tmp_path, run):
    model, database = given({})
    part = colmap.write_part(model, [f"{i}.jpg" for i in range(5)], tmp_path / "part")
    assert "1 of 6 images are not in the map: 5.jpg." in run(part, "--database", database)
    part = colmap.write_part(model, ["0.jpg", "1.jpg"], tmp_path / "smaller")
    assert "Only 2 of 6 photos are in the map." in run(part, "--database", database)


def test_photos_of_another_size_are_named(given, tmp_path, run):
    model, _ = given({})
    cv2.imwrite(str(tmp_path / "3.jpg"), np.zeros((640, 480), np.uint8))
    said = run(model, "--images", tmp_path)
    assert "sizes: These photos do not have the size of their cameras in the model: 3.jpg" in said


def test_copies_of_photos_are_named(given, tmp_path, run):
    """Those of a photo that comes before; not photos of which only the sizes are equal."""
    model, _ = given({})
    contents = {i: (tmp_path / f"{i}.jpg").read_bytes() for i in range(6)}
    for i, content in ((1, contents[4]), (3, contents[4]), (5, contents[2]), (0, b"a"), (4, b"b")):
        (tmp_path / f"{i}.jpg").write_bytes(content)
    said = run(model, "--images", tmp_path)
    assert "duplicates: These photos are copies of others: 3.jpg, 5.jpg. Points" in said
    (tmp_path / "3.jpg").unlink()
    (tmp_path / "5.jpg").unlink()
    assert "duplicates" not in run(model, "--images", tmp_path)


def test_a_map_warns_of_copies_of_photos(plane, tmp_path, caplog):
    """Their poses are not doubted."""
    images = plane / "images"
    (images / "copy of 2.png").write_bytes((images / "2.png").read_bytes())
    one_camera = pycolmap.CameraMode.SINGLE
    built = maps.main(tmp_path / "map", images, feature="colmap_sift_sv32", camera_mode=one_camera)
    (found,) = [one for one in built.findings if one.kind == "duplicates"]
    assert found.names == ("copy of 2.png",) and found.verdict == "warn"
    assert "photos are copies of others: copy of 2.png." in caplog.text and not built.doubts


def test_a_database_of_an_old_version(given, tmp_path, run):
    """It is not upgraded; without verified matches it still tells which photos are missing."""
    model, _ = given({})
    reference = colmap.read_model(model)
    features = {
        image.name: (np.array([point.xy for point in image.points2D]), np.zeros((60, 128)))
        for image in reference.images.values()
    }
    old = write_old(tmp_path / "old.db", features | {"7.jpg": features["0.jpg"]}, (640, 480))
    before = old.read_bytes()
    said = run(model, "--database", old)
    assert "partial: 1 of 7 images are not in the map: 7.jpg." in said
    assert old.read_bytes() == before


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (["absent"], "There is no COLMAP model folder"),
        (["sparse", "--database", "absent.db"], "There is no COLMAP database"),
        (["sparse", "--database", "other.db"], "is of another model"),
        (["sparse", "--images", "absent"], "There is no folder"),
        (["sparse", "--images", "sparse"], "has none of the 6 images"),
        (["empty"], "has no points"),
        (["sparse", "--json", "sparse"], "is a folder"),
    ],
)
def test_wrong_input(changed, message, given, tmp_path, monkeypatch, caplog):
    model, _ = given({})
    reference = colmap.read_model(model)
    features = {f"{i}.jpg": (np.zeros((9, 4)), np.zeros((9, 128))) for i in range(6)}
    write_old(tmp_path / "other.db", features)
    for point in list(reference.point3D_ids()):
        reference.delete_point3D(point)
    (tmp_path / "empty").mkdir()
    reference.write(tmp_path / "empty")
    arguments = [part if part.startswith("--") else tmp_path / part for part in changed]
    assert message in command.refused(monkeypatch, caplog, check, *arguments)
