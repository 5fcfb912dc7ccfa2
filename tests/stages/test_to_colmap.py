"""Databases for COLMAP: its own mapper reconstructs the place from them."""

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
