"""Maps of a COLMAP model and its database, without the photos."""

import json
import shutil
import sqlite3

import h5py
import numpy as np
import pycolmap
import pytest
from colmap_database import write_old
from command import outcome, state

from hloc_reduce import maps
from hloc_reduce.utils.feature_files import get_descriptors
from pipelines import localize

PIPELINE = localize


@pytest.fixture
def colmap_files(place, tmp_path, run):
    """A database, the model that was made from it, the map of the photos, and their folder."""
    build, images, outputs = place
    run(*build, "--feature", "colmap_sift")
    built = maps.Map(outputs / "map")
    features = {}
    with h5py.File(built.features) as file:
        for name in built.names():
            keypoints = [file[name]["keypoints"][()] + 0.5]
            keypoints += [file[name]["scales"][()][:, None]]
            keypoints += [np.deg2rad(file[name]["oris"][()].astype(float))[:, None]]
            described = np.rint(512 * get_descriptors(file, name)).clip(0, 255)
            features[name] = np.concatenate(keypoints, axis=1), described
    database = write_old(tmp_path / "database.db", features, (360, 270))
    model = shutil.copytree(built.sfm, tmp_path / "sparse")
    (model / "made_from.json").unlink()
    return database, model, built, images


def test_the_map_localizes_as_that_of_the_photos(colmap_files, tmp_path, run, refused):
    database, model, of_photos, images = colmap_files
    before = state(database.parent), database.read_bytes()
    given = ("--map", model, "--database", database, "--outputs", tmp_path / "place")
    new, small = ("--query_images", images / "query/day"), tmp_path / "place.hlm"
    shutil.move(images / "db", tmp_path / "db")  # no photo is needed
    run(*given, *new, "--compact", small)
    built = maps.Map(tmp_path / "place/map")
    assert built.num_points3D == of_photos.num_points3D and built.names() == of_photos.names()
    one, other = (json.loads((m.folder / "map.json").read_text()) for m in (built, of_photos))
    assert one.keys() - {"database"} == other.keys()
    assert outcome(tmp_path / "place/queries-day")[1]["a.png"]["status"] == "localized"
    run("--map", small, *new, "--outputs", tmp_path / "small")
    assert outcome(tmp_path / "small/queries-day")[1]["a.png"]["status"] == "localized"
    assert all(
        state(database.parent)[path] == time
        for path, time in before[0].items()
        if path.parent in (tmp_path, model)
    )
    assert database.read_bytes() == before[1]
    # a second run does nothing, and another configuration is refused
    done = state(tmp_path / "place/map")
    run(*given)
    assert state(tmp_path / "place/map") == done
    assert "differs: feature" in refused(*given, "--feature", "colmap_sift_sv32")
    with sqlite3.connect(database) as connection:
        connection.execute("UPDATE keypoints SET rows = rows WHERE image_id = 1")
        connection.execute("CREATE TABLE more (id INTEGER)")
    connection.close()
    assert "differs: database (database.db)" in refused(*given)
    assert state(tmp_path / "place/map") == done
    run(*given, "--overwrite", "--map_images", tmp_path)
    assert maps.Map(tmp_path / "place/map").images == tmp_path


def test_a_stopped_build_goes_on(colmap_files, tmp_path, run, monkeypatch):
    database, model, _, _ = colmap_files
    given = ("--map", model, "--database", database, "--outputs", tmp_path / "place")
    with monkeypatch.context() as context:

        def killed(*_):
            raise KeyboardInterrupt

        context.setattr(maps.from_database, "run", killed)
        with pytest.raises(SystemExit):
            run(*given)
    before = state(tmp_path / "place/map")
    run(*given)
    after = state(tmp_path / "place/map")
    assert all(after[path] == time for path, time in before.items() if path.suffix == ".h5")


def test_wrong_input(colmap_files, tmp_path, refused):
    database, model, built, images = colmap_files
    outputs = tmp_path / "place"
    given = ("--database", database, "--outputs", outputs)
    assert "Give --map, the COLMAP model" in refused(*given)
    assert "is a map that was built" in refused(*given, "--map", built.folder)
    given = ("--map", model, *given)
    assert "must end in .hlm" in refused(*given, "--compact", tmp_path / "place.bin")
    assert "has none of the 4 images" in refused(*given, "--map_images", images / "query")
    assert "choose a feature of colmap_sift" in refused(*given, "--feature", "sift_sv32")
    content = database.read_bytes()
    for change, message in (
        ("UPDATE images SET name = 'x.png' WHERE image_id = 2", "it lacks 1 of 4 images"),
        ("UPDATE keypoints SET rows = rows - 1", "the numbers of keypoints of 4 of 4 images"),
        ("UPDATE keypoints SET data = zeroblob(16 * rows)", "the positions of keypoints of 4"),
    ):
        with sqlite3.connect(database) as connection:
            connection.execute(change)
        connection.close()
        said = refused(*given)
        assert "is of another model" in said and message in said
        database.write_bytes(content)
    reference = pycolmap.Reconstruction(model)
    for point in list(reference.point3D_ids()):
        reference.delete_point3D(point)
    reference.write(model)
    assert "has no points" in refused(*given)
    assert not outputs.exists()


def test_the_map_is_put_into_metres(colmap_files, tmp_path, run):
    database, model, _, _ = colmap_files
    given = ("--map", model, "--database", database, "--outputs", tmp_path / "place")
    run(*given, "--scale", "db/0.png", "db/3.png", "2.5")
    built = maps.Map(tmp_path / "place/map")
    images = {image.name: image for image in pycolmap.Reconstruction(built.sfm).images.values()}
    ends = [images[f"db/{i}.png"].projection_center() for i in (0, 3)]
    assert built.frame.units == "m" and np.linalg.norm(ends[1] - ends[0]) == pytest.approx(2.5)
    written = state(built.folder)
    run(*given)
    assert state(built.folder) == written
