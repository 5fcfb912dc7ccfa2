"""COLMAP databases that other versions of COLMAP read, too.

A version reads the databases of earlier ones, which it upgrades, but not those of later ones. So
they get the tables of COLMAP 3.8, the version of Debian 12 and Ubuntu 24.04, and nothing else.
"""

import sqlite3
from contextlib import closing
from pathlib import Path

from .databases import full_disk

# as COLMAP 3.8 creates them; it refuses tables that lack a column
SCHEMA = """
PRAGMA user_version = 3800;
CREATE TABLE cameras (
    camera_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, model INTEGER NOT NULL,
    width INTEGER NOT NULL, height INTEGER NOT NULL, params BLOB,
    prior_focal_length INTEGER NOT NULL);
CREATE TABLE images (
    image_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, name TEXT NOT NULL UNIQUE,
    camera_id INTEGER NOT NULL,
    prior_qw REAL, prior_qx REAL, prior_qy REAL, prior_qz REAL,
    prior_tx REAL, prior_ty REAL, prior_tz REAL,
    CONSTRAINT image_id_check CHECK(image_id >= 0 and image_id < 2147483647),
    FOREIGN KEY(camera_id) REFERENCES cameras(camera_id));
CREATE UNIQUE INDEX index_name ON images(name);
CREATE TABLE keypoints (
    image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
    FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE);
CREATE TABLE descriptors (
    image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
    FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE);
CREATE TABLE matches (
    pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB);
CREATE TABLE two_view_geometries (
    pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
    config INTEGER NOT NULL, F BLOB, E BLOB, H BLOB, qvec BLOB, tvec BLOB);
"""
# columns that mean the same in all versions
COPIED = {
    "cameras": "camera_id, model, width, height, params, prior_focal_length",
    "images": "image_id, name, camera_id",
    "keypoints": "image_id, rows, cols, data",
    "matches": "pair_id, rows, cols, data",
    "two_view_geometries": "pair_id, rows, cols, data, config, F, E, H",
}


def write_for_all(source: Path, target: Path) -> None:
    """Write a database that COLMAP 3.8 and later versions can map.

    Args:
        source: of the installed pycolmap. Its descriptors, relative poses, rigs and pose priors
            are left out.
        target: the new database.

    Raises:
        OSError: when the disk is full.
    """
    with full_disk(target), closing(sqlite3.connect(target)) as connection:
        connection.executescript(SCHEMA)
        connection.execute("ATTACH DATABASE ? AS source", (str(source),))
        for table, columns in COPIED.items():
            connection.execute(
                f"INSERT INTO {table} ({columns}) SELECT {columns} FROM source.{table}"
            )
        connection.commit()
