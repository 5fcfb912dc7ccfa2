"""Poses of the frames of a video by time, as programs for trajectories read them."""

from collections.abc import Mapping
from pathlib import Path

from .. import logger
from ..utils.files import replacing, write_csv
from ..utils.time_stamps import time_stamps
from .records import pose_of

TUM, CSV = "trajectory_tum.txt", "trajectory.csv"
COLUMNS = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")


def write(records: Mapping[str, dict], folder: Path) -> bool:
    """Write the poses of queries, world from camera, if their names are time stamps.

    `trajectory_tum.txt` has the localized ones, one `timestamp tx ty tz qx qy qz qw` a line;
    `trajectory.csv` has all, with the same columns, which are empty if a query is not localized.
    Both are sorted by time.

    Args:
        records: of the queries, see `records`, by name.
        folder: for the files.

    Returns:
        Whether the names are time stamps.
    """
    stamps = time_stamps(records)
    if stamps is None:
        return False
    rows = [
        {"timestamp": str(stamps[name]), "query": name, **_columns(records[name])}
        for name in sorted(records, key=lambda name: stamps[name])
    ]
    write_csv(rows, folder / CSV, ("timestamp", "query", "localized", *COLUMNS))
    localized = [row for row in rows if row["localized"]]
    with replacing(folder / TUM) as temporary:
        lines = (" ".join(str(row[key]) for key in ("timestamp", *COLUMNS)) for row in localized)
        temporary.write_text("".join(f"{line}\n" for line in lines))
    logger.info(
        "Poses by time, world from camera, of %d of %d frames: %s and %s.",
        len(localized),
        len(rows),
        folder / TUM,
        CSV,
    )
    return True


def _columns(record: dict) -> dict[str, object]:
    """Return the cells of a query; the fallback of one that is not localized is no pose of it."""
    pose = pose_of(record) if record["localized"] else None
    if pose is None:
        return {"localized": 0, **dict.fromkeys(COLUMNS)}
    world_from_cam = pose.inverse()
    numbers = (*world_from_cam.translation, *world_from_cam.rotation.quat)
    written = (repr(float(number)) for number in numbers)
    return {"localized": 1, **dict(zip(COLUMNS, written, strict=True))}
