"""Features of COLMAP databases of several versions, which are only read."""

import sqlite3

import h5py
import numpy as np
import pycolmap
import pytest
import torch
from colmap_database import write_old, write_with_pycolmap

from hloc_reduce import from_colmap, projections
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.feature_files import get_descriptors

PIPELINE = from_colmap
NUMBER = 300


@pytest.fixture
def found(textured):
    """Keypoints (N, 4) in COLMAP's pixels and radians, and bytes of L1_ROOT descriptors."""
    keypoints, descriptors = colmap.detect_dog(textured.astype(np.float32) / 255, {})
    keypoints = keypoints[:NUMBER] + [0.5, 0.5, 0, 0]
    keypoints[:, 3] = np.deg2rad(keypoints[:, 3])
    return keypoints.astype(np.float32), np.rint(512 * descriptors[:NUMBER]).clip(0, 255)


@pytest.mark.parametrize("write", [write_old, write_with_pycolmap])
def test_a_database_becomes_features(write, found, tmp_path, run):
    keypoints, descriptors = found
    database, output = tmp_path / "database.db", tmp_path / "feats.h5"
    write(database, {"b.jpg": (keypoints, descriptors), "a/c d.jpg": (keypoints, descriptors)})
    before = database.read_bytes(), sorted(tmp_path.iterdir())
    run("--database", database, "--output", output, "--feature", "colmap_sift_sv32")
    unit = descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)
    projection = projections.load("colmap_sift_sv32")
    expected = projection(torch.from_numpy(unit.astype(np.float32))).numpy()
    with h5py.File(output) as file:
        for name in ("a/c d.jpg", "b.jpg"):
            np.testing.assert_array_equal(file[name]["keypoints"], keypoints[:, :2] - 0.5)
            np.testing.assert_allclose(file[name]["scales"], keypoints[:, 2], rtol=2e-3)
            degrees = np.rad2deg(keypoints[:, 3])
            np.testing.assert_allclose(file[name]["oris"], degrees, atol=0.1)
            assert file[name]["image_size"][()].tolist() == [320, 240]
            np.testing.assert_allclose(get_descriptors(file, name), expected, atol=2e-3)
    output_before = output.stat().st_mtime_ns
    run("--database", database, "--output", output, "--feature", "colmap_sift_sv32")
    assert output.stat().st_mtime_ns == output_before
    assert (database.read_bytes(), [*before[1], output]) == (before[0], sorted(tmp_path.iterdir()))


def test_affine_shapes():
    """The same as pycolmap says of the scale and the orientation of a keypoint."""
    rows = np.random.default_rng(0).normal(size=(5, 6)).astype(np.float32)
    scales, oris = colmap.shapes(rows)
    if hasattr(pycolmap, "FeatureKeypoint"):
        for row, scale, ori in zip(rows, scales, oris, strict=True):
            keypoint = pycolmap.FeatureKeypoint()
            keypoint.a11, keypoint.a12, keypoint.a21, keypoint.a22 = row[2:].tolist()
            assert scale == pytest.approx(keypoint.compute_scale(), rel=1e-5)
            assert np.deg2rad(ori) == pytest.approx(keypoint.compute_orientation(), rel=1e-5)
    assert colmap.shapes(rows[:, :2]) is None


def test_a_log_beside_the_database_is_read(found, tmp_path):
    """Of COLMAP at work, whose last images may be in the log only."""
    database = tmp_path / "database.db"
    write_old(database, {"a.jpg": found})
    with sqlite3.connect(database) as connection:
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("UPDATE images SET name = 'new.jpg'")
        connection.commit()
        with colmap.open_stored(database) as opened:
            assert list(opened.images) == ["new.jpg"] and len(opened.files()) == 2
    connection.close()


@pytest.mark.parametrize(
    "change, message",
    [
        (None, "There is no COLMAP database"),
        ("DROP TABLE images", "is not a COLMAP database (no such table: images)"),
        ("DELETE FROM descriptors", "has no descriptors"),
        ("DELETE FROM descriptors WHERE image_id = 1", "lacks the descriptors of 1 of 2 images"),
        ("UPDATE descriptors SET data = x'00'", "are truncated"),
        ("UPDATE descriptors SET cols = 64, data = zeroblob(64 * rows)", "these have 64 numbers"),
        ("ALTER TABLE descriptors ADD type INTEGER DEFAULT 1", "descriptors of ALIKED_N16ROT"),
        ("ALTER TABLE descriptors ADD type INTEGER DEFAULT 9", "descriptors of type 9"),
    ],
)
def test_wrong_databases(change, message, found, tmp_path, refused, scene):
    database, output = tmp_path / "database.db", tmp_path / "feats.h5"
    if change:
        write_old(database, {"a.jpg": found, "b.jpg": found})
        with sqlite3.connect(database) as connection:
            connection.execute(change)
        connection.close()
    options = ()
    if change == "DELETE FROM descriptors WHERE image_id = 1":
        model = pycolmap.Reconstruction()
        camera = pycolmap.Camera(
            model="SIMPLE_PINHOLE", width=320, height=240, params=[300, 160, 120], camera_id=1
        )
        for i, name in enumerate(("a.jpg", "b.jpg"), 1):
            image = pycolmap.Image(
                name=name, keypoints=found[0][:, :2].astype(float), camera_id=1, image_id=i
            )
            colmap.add_image(model, camera, image, pycolmap.Rigid3d())
        (tmp_path / "model").mkdir()
        model.write(tmp_path / "model")
        options = ("--model", tmp_path / "model")
    assert message in refused("--database", database, "--output", output, *options)
    assert not output.exists()


def test_files_that_are_no_databases(found, tmp_path, refused):
    text, output = tmp_path / "text.db", tmp_path / "feats.h5"
    text.write_text("no database, however long this text may be")
    assert "not a file of SQLite" in refused("--database", text, "--output", output)
    assert "is a folder" in refused("--database", tmp_path, "--output", output)
    database = tmp_path / "database.db"
    write_old(database, {"a.jpg": found})
    given = ("--database", database, "--output", output)
    message = refused(*given, "--feature", "sift_sv32")
    assert "choose a feature of colmap_sift" in message
    with sqlite3.connect(database, isolation_level=None) as connection:
        connection.execute("BEGIN EXCLUSIVE")
        assert "is locked by another program" in refused(*given)
        connection.execute("ROLLBACK")
    connection.close()
    database.write_bytes(database.read_bytes()[:6000])
    with pytest.raises(InputError, match=r"database\.db"):
        from_colmap.main(database, output)
    assert not output.exists()
