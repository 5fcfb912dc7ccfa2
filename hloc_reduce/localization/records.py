"""The record of each query: its pose, or why it has none, and how well it fits."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from ..utils.cli import InputError
from ..utils.files import naming, replacing
from . import gate as gates
from .gate import Gate
from .intrinsics import to_list
from .measures import Measures
from .references import Reference

RECORDS = 33  # the version of the content of records, and of the gate
NUMBERS = ("num_matches", "num_without_point", "num_correspondences", "num_inliers")


def nearness(found: Mapping) -> tuple[bool, float, int]:
    """Return how near a try came to localizing a query, given its record or info, to compare it."""
    return found["reason"] is None, found["confidence"], found["num_inliers"]


def pose_of(record: dict) -> pycolmap.Rigid3d | None:
    """Return the pose in a record, camera from world."""
    if record["qvec"] is None:
        return None
    w, x, y, z = record["qvec"]
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), np.array(record["tvec"]))


def measures_of(record: dict) -> Measures:
    """Return the measures in a record."""
    return Measures.from_dict(record["measures"])


def camera_of(record: dict) -> pycolmap.Camera:
    """Return the intrinsics in a record; those of a pose that is not trusted may be absurd."""
    model, width, height, *params = record["camera"]
    return pycolmap.Camera(model=model, width=width, height=height, params=params)


def read_records(path: Path) -> dict[str, dict]:
    """Read the records of queries from a `log_file`.

    Raises:
        InputError: if it is missing, broken, or of another version.
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
    """Return the file of the records of queries, next to their poses."""
    return Path(f"{results}_logs.jsonl")


def to_record(
    reference: Reference, names: list[str], cam_from_world: pycolmap.Rigid3d | None, info: dict
) -> dict:
    """Return the record of a query.

    Args:
        reference: the map.
        names: the retrieved images, best first.
        cam_from_world: the pose.
        info: as `query.localize` returns it, with `max_error`.
    """
    localized, covariance = info["reason"] is None, info["covariance"]
    if not localized:
        cam_from_world, covariance = reference.fallback(names) or cam_from_world, None
    return {
        "localized": localized,
        "reason": info["reason"],
        "confidence": info["confidence"],
        "agreement": info["agreement"],
        "probability": info["probability"],
        **written(cam_from_world),
        "camera": info["camera"] and to_list(info["camera"]),
        "max_error": info["max_error"],
        **{key: info[key] for key in NUMBERS},
        "db": info["db"] if localized else next(iter(names), None),
        "covariance": None if covariance is None else covariance.tolist(),
        "measures": info["measures"].to_dict(),
    }


def written(cam_from_world: pycolmap.Rigid3d | None) -> dict:
    """Return the written pose of a record."""
    if cam_from_world is None:
        return {"qvec": None, "tvec": None}
    x, y, z, w = cam_from_world.rotation.quat
    return {
        "qvec": [float(value) for value in (w, x, y, z)],
        "tvec": [float(value) for value in cam_from_world.translation],
    }


def with_mirror_image(
    record: dict, other: dict, reference: Reference, names: list[str], gate: Gate
) -> dict:
    """Return the record of a localized query after its mirror image was localized, too.

    Args:
        record: of the query.
        other: of its mirror image.
        reference: the map.
        names: the retrieved images, best first.
        gate: what a pose must have for the query to be called localized.
    """
    measures = replace(measures_of(record), mirror_image=other["confidence"])
    found = gates.verdict(measures, gate)
    record = {**record, **found, "measures": measures.to_dict()}
    if not found["reason"]:
        return record
    fallback = reference.fallback(names) or pose_of(record)
    first = next(iter(names), None)
    return record | written(fallback) | {"localized": False, "db": first, "covariance": None}


def refused(
    reference: Reference, names: list[str], camera: pycolmap.Camera | None, reason: str
) -> dict:
    """Return the record of a query that is not to be localized."""
    info = {"reason": reason, "confidence": 0.0, "agreement": 0.0, "probability": 0.0}
    info["max_error"] = None
    info |= {"measures": Measures(), "covariance": None}
    return to_record(reference, names, None, info | dict.fromkeys(NUMBERS, 0) | {"camera": camera})


class Log:
    """Records of queries, one JSON line each, after a first line with their provenance.

    Until the localization is finished, a query may have a second line, which replaces the first.

    Args:
        path: the file.
        made_from: the provenance; stale records are dropped.
        overwrite: drop all records.
    """

    def __init__(self, path: Path, made_from: dict, overwrite: bool):
        self.path = path
        self.records: dict[str, dict] = {}
        self.header = json.dumps(made_from, sort_keys=True)
        lines = [] if overwrite or not path.exists() else path.read_text().split("\n")
        if lines and lines[0] == self.header:
            # a killed run may have cut off the last line, after the last line end
            self.records = dict(json.loads(line) for line in lines[1:-1])
        self._write()

    def _write(self) -> None:
        """Replace the file by one with a line for each query."""
        lines = [json.dumps(item) for item in self.records.items()]
        with replacing(self.path) as temporary:
            temporary.write_text("\n".join([self.header, *lines]) + "\n")

    def __enter__(self) -> "Log":
        self.file = self.path.open("a")
        return self

    def __exit__(self, failure: type[BaseException] | None, *_: object) -> None:
        with naming(self.path):
            self.file.close()
        if failure is None:
            self._write()

    def add(self, name: str, record: dict) -> None:
        """Add the record of a query."""
        self.records[name] = record
        with naming(self.path):
            self.file.write(json.dumps([name, record]) + "\n")
            self.file.flush()
