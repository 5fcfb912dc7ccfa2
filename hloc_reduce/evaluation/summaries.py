"""Results of a localization run: queries.csv, summary.json and the recall table."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pycolmap

from ..localization.frame import UNKNOWN, Frame
from ..localization.records import pose_of
from ..utils.codes import storage_of
from ..utils.feature_files import stored_descriptors
from ..utils.files import replacing
from ..utils.h5 import list_h5_names, open_h5, stored_bytes
from ..utils.tables import aligned, joined
from .poses import ERRORS, pose_error, status, summarize_errors


def query_table(
    lists: Mapping[str, Iterable[str]],
    records: Mapping[str, dict],
    truth: Mapping[str, pycolmap.Rigid3d],
    frame: Frame = UNKNOWN,
) -> list[dict]:
    """Make the rows of queries.csv.

    Args:
        lists: the queries of each list.
        records: of each query, as from `localization.main`.
        truth: true poses, camera from world, by full name, of all, some or no queries.
        frame: of the map.

    Returns:
        A dict for each query. Its errors are of the submitted pose, even if that is a fallback:
        infinite without a pose, None without a true pose. Its `Frame.row` has values only if it is
        localized.
    """
    return [
        _query_row(name, list_name, records[name], truth.get(name), frame)
        for list_name, queries in lists.items()
        for name in queries
    ]


def _query_row(
    name: str, list_name: str, record: dict, true: pycolmap.Rigid3d | None, frame: Frame
) -> dict[str, object]:
    correspondences, inliers = record["num_correspondences"], record["num_inliers"]
    pose, rig = pose_of(record), record["rig"]
    return {
        "query": name,
        "list": list_name,
        "status": status(pose, record["localized"]),
        "again": record["again"],
        "turned": record["turned"],
        "frame": rig["frame"] if rig and not rig["reason"] else None,
        "num_matches": record["num_matches"],
        "num_without_point": record["num_without_point"],
        "num_correspondences": correspondences,
        "num_inliers": inliers,
        "inlier_ratio": round(inliers / correspondences, 4) if correspondences else 0.0,
        "confidence": record["confidence"],
        "agreement": record["agreement"],
        "probability": record["probability"],
        **dict(zip(ERRORS, (None, None) if true is None else pose_error(pose, true), strict=True)),
        **frame.row(pose if record["localized"] else None),
        "retrieved": record["db"],
        "reason": record["reason"],
    }


def summarize_list(rows: list[dict], thresholds: tuple[tuple[float, float], ...]) -> dict:
    """Summarize the rows of one list.

    Returns:
        Counts and mean inliers, and `summarize_errors` of the queries with known true poses, if
        there are any.
    """
    summary = {
        "queries": len(rows),
        "localized": sum(row["status"] == "localized" for row in rows),
        "mean_inliers": round(float(np.mean([row["num_inliers"] for row in rows])), 1),
    }
    known = [row for row in rows if row[ERRORS[0]] is not None]
    return {**summary, **(summarize_errors(known, thresholds) if known else {})}


def bytes_per_keypoint(features: Path) -> dict:
    """Measure the size of descriptors and of a feature file.

    Returns:
        `descriptor`, bytes of one of a map image; `storage`, how it is stored; `feature_file`,
        bytes of the file for each keypoint; `keypoints`, of all images; and `images`.
    """
    names = list_h5_names(features)
    with open_h5(features) as file:
        descriptors = [stored_descriptors(file, name) for name in names]
        total = sum(dataset.shape[1] for dataset in descriptors)
        # queries in the same file may be floats
        size, name = min(
            (dataset.shape[0] * dataset.dtype.itemsize, name)
            for dataset, name in zip(descriptors, names, strict=True)
        )
        storage = storage_of(file[name])
    return {
        "descriptor": size,
        "storage": storage,
        "feature_file": round(features.stat().st_size / total, 1) if total else 0.0,
        "keypoints": total,
        "images": len(names),
    }


def map_bytes(sfm: Path, names: list[str], files: Iterable[Path]) -> int:
    """Measure what localization needs of a map.

    Args:
        sfm: COLMAP model; its database is not counted.
        names: the images of the map.
        files: h5 files with their features and global descriptors, and perhaps those of queries,
            which are not counted; missing files are left out.
    """
    size = sum(path.stat().st_size for path in sfm.glob("*.bin"))
    for path in files:
        if path.is_file():
            with open_h5(path) as file:
                size += sum(stored_bytes(file, name) for name in names)
    return size


def write_summary(summary: dict, path: Path) -> None:
    """Write summary.json."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(summary, indent=1) + "\n")


def recall_table(feature: str, lists: Mapping[str, dict]) -> str:
    """Format recall like the paper's tables, with a column for each list."""
    columns = [[feature, "distance [m]", "orient. [deg]", "recall [%]"]]
    for name, summary in lists.items():
        if "recall_percent" in summary:
            limits = [
                joined(values, "g") for values in zip(*summary["thresholds_m_deg"], strict=True)
            ]
            columns.append([name.split("_")[0], *limits, joined(summary["recall_percent"], ".1f")])
    return aligned(list(zip(*columns, strict=True)), left=0)
