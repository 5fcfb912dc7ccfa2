"""What is kept of each query."""

import json
from pathlib import Path

import numpy as np
import pycolmap

from ..utils.cli import InputError
from ..utils.files import naming, replacing
from .intrinsics import from_list, to_list
from .references import Reference

RECORDS = 9  # the version of what a record holds, and of the gate


def pose_of(record: dict) -> pycolmap.Rigid3d | None:
    """Return the pose of a query's record, camera from world."""
    if record["qvec"] is None:
        return None
    w, x, y, z = record["qvec"]
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), np.array(record["tvec"]))


def camera_of(record: dict) -> pycolmap.Camera:
    """Return the intrinsics of a query's record, as they were refined."""
    return from_list(record["camera"])


def to_stamp(queries: list[tuple[str, pycolmap.Camera | None]]) -> dict[str, list | None]:
    """Return the intrinsics of queries as a stamp has them."""
    return {name: camera and to_list(camera) for name, camera in queries}


def read_records(path: Path) -> dict[str, dict]:
    """Read the records of queries that `main` left in `log_file`.

    Raises:
        InputError: when they are not there, broken, or of another version.
    """
    try:
        header, *lines = path.read_text().splitlines()
        if json.loads(header)["records"] == RECORDS:
            records = dict(json.loads(line) for line in lines)
            for record in records.values():
                record["localized"] = bool(record["localized"])
                pose_of(record)
            return records
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        pass
    raise InputError(f"{path} is not there or broken: run the localization again.")


def log_file(results: Path) -> Path:
    """Return the file of the records of queries, beside that of poses."""
    return Path(f"{results}_logs.jsonl")


def to_record(
    reference: Reference, names: list[str], cam_from_world: pycolmap.Rigid3d | None, info: dict
) -> dict:
    """Return the record of a query, from its pose and the info of `query.localize`."""
    localized = info["reason"] is None
    if not localized:
        cam_from_world = reference.fallback(names) or cam_from_world
    qvec = tvec = None
    if cam_from_world is not None:
        x, y, z, w = cam_from_world.rotation.quat
        qvec = [float(value) for value in (w, x, y, z)]
        tvec = [float(value) for value in cam_from_world.translation]
    numbers = ("num_matches", "num_without_point", "num_correspondences", "num_inliers")
    return {
        "localized": localized,
        "reason": info["reason"],
        "confidence": info["confidence"],
        "agreement": info["agreement"],
        "qvec": qvec,
        "tvec": tvec,
        "camera": to_list(info["camera"]),
        "max_error": info["max_error"],
        **{key: info[key] for key in numbers},
        "db": info["db"] if localized else next(iter(names), None),
    }


class Log:
    """Records of queries, one JSON line each, under a first line that says what made them."""

    def __init__(self, path: Path, made_from: dict, overwrite: bool):
        self.path, self.records = path, {}
        header = json.dumps(made_from, sort_keys=True)
        lines = [] if overwrite or not path.exists() else path.read_text().split("\n")
        if lines and lines[0] == header:
            # what follows the last line end was cut off by a kill
            self.records = dict(json.loads(line) for line in lines[1:-1])
        kept = [json.dumps(item) for item in self.records.items()]
        with replacing(path) as temporary:
            temporary.write_text("\n".join([header, *kept]) + "\n")

    def __enter__(self) -> None:
        self.file = self.path.open("a")

    def __exit__(self, *_) -> None:
        with naming(self.path):
            self.file.close()

    def add(self, name: str, record: dict) -> None:
        """Add the record of a query."""
        self.records[name] = record
        with naming(self.path):
            self.file.write(json.dumps([name, record]) + "\n")
            self.file.flush()
