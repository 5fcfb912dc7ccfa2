"""Databases for COLMAP: its own mapper reconstructs the place from them."""

import shutil
import sqlite3
import subprocess
from contextlib import closing

import h5py
import numpy as np
import pycolmap
import pytest

from hloc_reduce import extract_features, match_features, pairs_from_exhaustive, to_colmap
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.match_files import list_pairs

PIPELINE = to_colmap


@pytest.fixture
def matched(plane, tmp_path):
    """Features and matches of the map images, one of which has a space in its name."""
    images = plane / "images"
    (images / "0.png").rename(images / "a 0.png")
    features = extract_features.main(extract_features.confs["colmap_sift_sv32"], images, tmp_path)
    pairs = pairs_from_exhaustive.main(tmp_path / "pairs.txt", features=features)
    conf = match_features.confs["NN-ratio"]
    matches = match_features.main(conf, pairs, features, matches=tmp_path / "matches.h5")
    return images, features, matches


def test_colmap_reconstructs_the_place(matched, tmp_path, run, refused):
    images, features, matches = matched
    database = tmp_path / "folder/new.db"
    given = ("--features", features, "--matches", matches, "--image_dir", images)
    run(*given, "--database", database, "--camera_mode", "single")
    with pycolmap.Database.open(database) as opened, h5py.File(features) as file:
        listed = opened.read_all_images()
        assert {image.name for image in listed} == {path.name for path in images.iterdir()}
        assert opened.num_cameras() == 1
        for image in listed:
            expected = file[image.name]["keypoints"][()] + 0.5
            np.testing.assert_array_equal(opened.read_keypoints(image.image_id)[:, :2], expected)
        assert opened.num_matches() > opened.num_inlier_matches() > 100
    (tmp_path / "models").mkdir()
    found = pycolmap.incremental_mapping(database, images, tmp_path / "models")
    assert max(model.num_reg_images() for model in found.values()) == len(listed)
    content = database.read_bytes()
    assert "exists: choose another" in refused(*given, "--database", database)
    assert database.read_bytes() == content
    run(*given, "--database", database, "--overwrite")
    assert len(colmap.read_cameras(database)) == len(listed)
    assert [path.name for path in database.parent.iterdir()] == ["new.db"]


IMAGES = "image_id name camera_id prior_qw prior_qx prior_qy prior_qz prior_tx prior_ty prior_tz"
# columns of COLMAP 3.8, which reads them by their order
OF_COLMAP_3_8 = {
    "cameras": "camera_id model width height params prior_focal_length",
    "images": IMAGES,
    "keypoints": "image_id rows cols data",
    "descriptors": "image_id rows cols data",
    "matches": "pair_id rows cols data",
    "two_view_geometries": "pair_id rows cols data config F E H qvec tvec",
}


@pytest.mark.fault(9)
def test_the_database_is_one_of_colmap_3_8(matched, tmp_path):
    """Later versions upgrade it, but none reads that of a later one."""
    images, features, matches = matched
    database = to_colmap.main(features, matches, images, tmp_path / "new.db")
    with closing(sqlite3.connect(database)) as connection:

        def rows(asked):
            return connection.execute(asked).fetchall()

        names = "SELECT name FROM sqlite_master WHERE type = 'table'"
        tables = {name for (name,) in rows(names)} - {"sqlite_sequence"}
        columns = {name: [row[1] for row in rows(f"PRAGMA table_info({name})")] for name in tables}
        assert columns == {name: listed.split() for name, listed in OF_COLMAP_3_8.items()}
        assert rows("PRAGMA user_version") == [(3800,)]
        (number,) = rows("SELECT count(*) FROM two_view_geometries WHERE rows > 0 AND F NOTNULL")[0]
    with colmap.open_stored(database) as stored:
        for name, expected in stored.numbers("keypoints").items():
            assert stored.image_size(name) == (360, 270)
            assert len(stored.keypoints(name)) == expected > 100
    assert len(colmap.count_verified(database)) == number == 10  # pycolmap has upgraded it


@pytest.mark.fault(9)
def test_colmap_on_this_machine_maps_it(matched, tmp_path):
    program = shutil.which("colmap")
    if program is None:
        pytest.skip("there is no colmap on PATH")
    images, features, matches = matched
    mode = pycolmap.CameraMode.SINGLE
    database = to_colmap.main(features, matches, images, tmp_path / "new.db", mode)
    (tmp_path / "models").mkdir()
    given = ("--database_path", database, "--image_path", images)
    command = [program, "mapper", *given, "--output_path", tmp_path / "models"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert pycolmap.Reconstruction(tmp_path / "models/0").num_reg_images() == 5


@pytest.mark.fault(9)
def test_what_a_killed_colmap_left_beside_an_old_database_is_deleted(matched, tmp_path):
    """SQLite would write the log of the old database into the new one."""
    images, features, matches = matched
    database, other = tmp_path / "new.db", tmp_path / "other.db"
    with closing(sqlite3.connect(other)) as connection:
        connection.executescript("PRAGMA journal_mode=WAL; CREATE TABLE other(key)")
        for suffix in ("", "-wal", "-shm"):
            shutil.copy(f"{other}{suffix}", f"{database}{suffix}")
    to_colmap.main(features, matches, images, database, overwrite=True)
    assert [path.name for path in tmp_path.glob("new.db*")] == ["new.db"]
    assert len(colmap.count_verified(database)) == 10


@pytest.mark.parametrize(
    "options, message",
    [
        (("--features", "none.h5"), "none.h5"),
        (("--matches", "none.h5"), "none.h5"),
        (("--matches", "feats.h5"), "has no pair of images of"),
        (("--image_dir", "none"), "none"),
        (("--image_dir", "."), "a 0.png"),
        (("--camera_mode", "one"), "Unknown camera mode 'one'"),
        (("--database", "."), "is a folder"),
    ],
)
def test_wrong_input(options, message, matched, tmp_path, monkeypatch, refused):
    images, features, matches = matched
    monkeypatch.chdir(tmp_path)
    features.rename("feats.h5")
    given = ("--features", "feats.h5", "--matches", matches, "--image_dir", images)
    assert message in refused(*given, "--database", "new.db", *options)
    assert not list(tmp_path.glob("*.db*")) and not list(tmp_path.glob(".*"))


def test_pairs_of_match_files(tmp_path):
    """In both of hloc's formats, with slashes that became dashes."""
    path, names = tmp_path / "m.h5", ["db/a_1.jpg", "q/b.jpg", "c.jpg"]
    with h5py.File(path, "w") as file:
        file.create_group("db-a_1.jpg/q-b.jpg")["matches0"] = [0]
        file.create_group("c.jpg_db-a_1.jpg")["matches0"] = [0]
        file.create_group("c.jpg/other.jpg")["matches0"] = [0]
    expected = {("db/a_1.jpg", "q/b.jpg"), ("c.jpg", "db/a_1.jpg")}
    assert set(list_pairs(path, names)) == expected
    with pytest.raises(InputError, match=r"cannot tell a/b.jpg and a-b.jpg apart"):
        list_pairs(path, ["a/b.jpg", "a-b.jpg"])
