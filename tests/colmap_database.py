"""COLMAP databases with given features, of an old version and of the installed pycolmap."""

import sqlite3
from pathlib import Path

import numpy as np
import pycolmap

SIZE = (320, 240)
Features = dict[str, tuple[np.ndarray, np.ndarray]]  # keypoints (N, 4) and descriptors (N, 128)
# what is read of the tables of COLMAP 3.8
SCHEMA = """
CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, model INTEGER NOT NULL,
    width INTEGER NOT NULL, height INTEGER NOT NULL, params BLOB, prior_focal_length INTEGER);
CREATE TABLE images (image_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, name TEXT NOT NULL UNIQUE,
    camera_id INTEGER NOT NULL, prior_qw REAL, prior_qx REAL, prior_qy REAL, prior_qz REAL,
    prior_tx REAL, prior_ty REAL, prior_tz REAL);
CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL,
    cols INTEGER NOT NULL, data BLOB);
CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL,
    cols INTEGER NOT NULL, data BLOB);
CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL,
    cols INTEGER NOT NULL, data BLOB);
"""


def write_old(path: Path, features: Features, size: tuple[int, int] = SIZE) -> Path:
    """Write a database with the tables of COLMAP 3.8."""
    with sqlite3.connect(path) as connection:
        connection.executescript(SCHEMA)
        connection.execute("INSERT INTO cameras VALUES (1, 0, ?, ?, NULL, 0)", size)
        for i, (name, (keypoints, descriptors)) in enumerate(features.items(), 1):
            connection.execute("INSERT INTO images VALUES (?, ?, 1" + ", 0" * 7 + ")", (i, name))
            for table, array in (
                ("keypoints", keypoints.astype(np.float32)),
                ("descriptors", descriptors.astype(np.uint8)),
            ):
                row = (i, *array.shape, array.tobytes())
                connection.execute(f"INSERT INTO {table} VALUES (?, ?, ?, ?)", row)
    connection.close()
    return path


def write_with_pycolmap(path: Path, features: Features, size: tuple[int, int] = SIZE) -> Path:
    """Write a database of the installed version."""
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=size[0], height=size[1], params=[300, 160, 120]
    )
    with pycolmap.Database.open(path) as database:
        camera_id = database.write_camera(camera)
        for name, (keypoints, descriptors) in features.items():
            image_id = database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
            database.write_keypoints(image_id, keypoints.astype(np.float32))
            described = np.ascontiguousarray(descriptors, np.uint8)
            if hasattr(pycolmap, "FeatureDescriptors"):  # pycolmap 4
                described = pycolmap.FeatureDescriptors(
                    type=pycolmap.FeatureExtractorType.SIFT, data=described
                )
            database.write_descriptors(image_id, described)
    return path
