"""What a localization run leaves behind: queries.csv, summary.json and the recall table."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pycolmap

from ..localization.records import pose_of
from ..utils.feature_files import stored_descriptors
from ..utils.files import replacing
from ..utils.h5 import list_h5_names, open_h5
from ..utils.tables import aligned
from .poses import FAILED, pose_error, summarize_errors

COLUMNS = (
    "query",
    "list",
    "status",
    "num_matches",
    "num_without_point",
    "num_correspondences",
    "num_inliers",
    "inlier_ratio",
    "confidence",
    "agreement",
    "position_error_m",
    "rotation_error_deg",
    "retrieved",
    "reason",
)


def query_table(
    lists: Mapping[str, Iterable[str]],
    records: Mapping[str, dict],
    truth: Mapping[str, pycolmap.Rigid3d],
) -> list[dict]:
    """Make the rows of queries.csv.

    Args:
        lists: the queries of each list.
        records: of each query, as from `localization.main`.
        truth: true poses, camera from world, by full name; may lack some or all.

    Returns:
        A dict of `COLUMNS` for each query. The error of a query is that of the submitted pose,
        be it localized or a fallback, and infinite if there is none; it is None where the truth
        is not known.
    """
    rows = []
    for list_name, queries in lists.items():
        for name in queries:
            record = records[name]
            correspondences, inliers = record["num_correspondences"], record["num_inliers"]
            estimate = pose_of(record)
            errors = (None, None)
            if name in truth:
                errors = pose_error(estimate, truth[name]) if estimate else FAILED
            values = (
                name,
                list_name,
                "localized" if record["localized"] else "fallback" if estimate else "failed",
                record["num_matches"],
                record["num_without_point"],
                correspondences,
                inliers,
                round(inliers / correspondences, 4) if correspondences else 0.0,
                record["confidence"],
                record["agreement"],
                *errors,
                record["db"],
                record["reason"],
            )
            rows.append(dict(zip(COLUMNS, values, strict=True)))
    return rows


def summarize_list(rows: list[dict], thresholds: tuple[tuple[float, float], ...]) -> dict:
    """Summarize the rows of one list.

    Returns:
        Counts, mean inliers, and where the truth is known recall in percent at each of the
        thresholds, and median errors. Recall counts a fallback as a failure; medians are of the
        submitted poses, None if half of the queries have none.
    """
    summary = {
        "queries": len(rows),
        "localized": sum(row["status"] == "localized" for row in rows),
        "mean_inliers": round(float(np.mean([row["num_inliers"] for row in rows])), 1),
    }
    known = [row for row in rows if row["position_error_m"] is not None]
    if known:
        errors = [(row["position_error_m"], row["rotation_error_deg"]) for row in known]
        counted = [
            error if row["status"] == "localized" else FAILED
            for row, error in zip(known, errors, strict=True)
        ]
        summary |= summarize_errors(errors, counted, thresholds)
    return summary


def bytes_per_keypoint(features: Path) -> dict:
    """Measure the size of a feature file: bytes of one descriptor, and of all per keypoint.

    `storage` is the type of the numbers of a descriptor.
    """
    names = list_h5_names(features)
    with open_h5(features) as file:
        descriptors = [stored_descriptors(file, name) for name in names]
        total = sum(dataset.shape[1] for dataset in descriptors)
        size = descriptors[0].shape[0] * descriptors[0].dtype.itemsize
    return {
        "descriptor": size,
        "storage": descriptors[0].dtype.name,
        "feature_file": round(features.stat().st_size / total, 1) if total else 0.0,
        "keypoints": total,
    }


def write_summary(summary: dict, path: Path) -> None:
    """Write summary.json."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(summary, indent=1) + "\n")


def recall_table(feature: str, lists: Mapping[str, dict]) -> str:
    """Format recall in the form of the paper's tables, a column for each list."""
    columns = [[feature, "distance [m]", "orient. [deg]", "recall [%]"]]
    for name, summary in lists.items():
        if "recall_percent" in summary:
            metres, degrees = zip(*summary["thresholds_m_deg"], strict=True)
            columns.append(
                [
                    name.split("_")[0],
                    " / ".join(f"{value:g}" for value in metres),
                    " / ".join(f"{value:g}" for value in degrees),
                    " / ".join(f"{value:.1f}" for value in summary["recall_percent"]),
                ]
            )
    return aligned(list(zip(*columns, strict=True)), left=0)
