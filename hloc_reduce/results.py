"""What a localization run leaves behind: queries.csv, summary.json and the recall table."""

import json
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pycolmap

from . import stamps, trace
from .cli import InputError
from .evaluation.poses import FAILED, pose_error, summarize_errors
from .io import Lock, list_h5_names, open_h5, replacing
from .localization import pose
from .storage import stored_descriptors

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
# what a run leaves in its folder, first what says that it is whole; but for lists of pairs, which
# are always written anew
PRODUCTS = (
    "map.json",
    "*feats-*",
    "points3D.h5*",
    ".*.tmp",
    "sfm*",
    "*_hloc_*",
    "queries.csv",
    "s*.json",
)
STAGES = "stages.json"
BOOKKEEPING = {"conf.json", STAGES, "summary.json", "queries.csv", "trace.json"}
DELETING = {"is": "being deleted"}
NAMED = 3  # differences that a message names
SHORT = 40  # characters of values that it quotes


class RunFolder:
    """An output folder that belongs to one configuration and knows how long its stages took.

    In a `with` block no other run can write to it.

    Args:
        path: the folder; made if need be.
        conf: what determines the results.
        overwrite: begin anew, with this configuration; what a run left in the folder is deleted
            first, so that a run that is stopped can go on without `overwrite`.
        inputs: files and folders that the run reads, which are not to be deleted.
        stale: where the configuration is the same, begin anew all the same: what the results
            were made from has changed.

    Raises:
        InputError: when the folder holds results of another configuration, or an input that would
            be deleted, or another run is at work in it.
    """

    def __init__(
        self,
        path: Path,
        conf: dict,
        overwrite: bool,
        inputs: Iterable[Path] = (),
        stale: bool = False,
    ):
        self.path, self._stages_file = path, path / STAGES
        self._lock = Lock(path)
        try:
            self._claim(conf, overwrite, inputs, stale)
        except BaseException:
            self._lock.release()
            raise

    def __enter__(self) -> "RunFolder":
        return self

    def __exit__(self, *_) -> None:
        self._lock.release()

    def _claim(self, conf: dict, overwrite: bool, inputs: Iterable[Path], stale: bool) -> None:
        """Check that the folder is of a configuration, or make it so."""
        path, conf_file = self.path, self.path / "conf.json"
        conf = json.loads(json.dumps(conf))
        before = None
        if conf_file.exists() and not overwrite:
            try:
                before = dict(json.loads(conf_file.read_text()))
            except (ValueError, TypeError):
                raise InputError(f"{conf_file} is broken: use --overwrite.") from None
            changes = _changes(before, conf)
            if before == DELETING or not changes and stale:
                overwrite = True
            elif changes:
                named = " and ".join(f"{key}{which}" for key, which in changes.items())
                raise InputError(
                    f"What {path} was made from differs: {named}. "
                    "Choose other --outputs, one folder for each configuration, or --overwrite."
                )
        if overwrite and conf_file.exists():
            for file in inputs:
                if path.resolve() in file.resolve().parents:
                    raise InputError(f"{file} is in {path}, which is to be made anew: move it.")
            # whoever finds this, because the deletion was cut short, deletes again
            with replacing(conf_file) as temporary:
                temporary.write_text(json.dumps(DELETING))
            for product in (file for pattern in PRODUCTS for file in path.glob(pattern)):
                shutil.rmtree(product) if product.is_dir() else product.unlink()
        if overwrite or before is None:
            with replacing(conf_file) as temporary:
                temporary.write_text(json.dumps(conf, indent=1))

    def seconds(self) -> dict[str, float]:
        """Return how long each stage took, all runs together."""
        return {name: stage["seconds"] for name, stage in stamps.read(self._stages_file).items()}

    def bytes(self) -> dict[str, int]:
        """Return how large the files and folders are that each stage wrote."""
        sizes = {name: size for name, (size, _) in self._contents().items()}
        return {
            name: sum(sizes.get(written, 0) for written in stage["wrote"])
            for name, stage in stamps.read(self._stages_file).items()
        }

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure a stage; what a run that failed spent counts too."""
        contents, start = self._contents(), time.perf_counter()
        try:
            with trace.span(name):
                yield
        except BaseException:
            with suppress(OSError):  # of a full disk: the error in the stage says more
                self._measure(name, contents, start)
            raise
        self._measure(name, contents, start)

    def _measure(self, name: str, contents: dict, start: float) -> None:
        """Write down what a stage spent and wrote since a time when there were other contents."""
        stages = stamps.read(self._stages_file)
        changed = {
            written for written, state in self._contents().items() if contents.get(written) != state
        }
        if changed or name not in stages:  # a look at what is there does not count
            before = stages.get(name, {"seconds": 0.0, "wrote": []})
            spent = before["seconds"] + time.perf_counter() - start
            wrote = sorted(changed.union(before["wrote"]))
            stages[name] = {"seconds": round(spent, 3), "wrote": wrote}
            stamps.write(self._stages_file, stages)

    def _contents(self) -> dict[str, tuple[int, int]]:
        """Return the size and the time of the last change of all that stages wrote, by name."""
        contents = {}
        for path in self.path.iterdir():
            if path.name in BOOKKEEPING or path.name.startswith("."):
                continue
            files = [path] if path.is_file() else [p for p in path.rglob("[!.]*") if p.is_file()]
            states = [file.stat() for file in files]
            contents[path.name] = (
                sum(state.st_size for state in states),
                max((state.st_mtime_ns for state in states), default=0),
            )
        return contents


def _changes(before: dict, after: dict) -> dict[str, str]:
    """Return the keys whose values differ, each with the entries that differ where it has some."""
    changes = {}
    for key in {**before, **after}:
        old, new = before.get(key), after.get(key)
        if old == new:
            continue
        changes[key] = ""
        if isinstance(old, dict) and isinstance(new, dict):
            names = [name for name in {**old, **new} if old.get(name) != new.get(name)]
            more = ", ..." if len(names) > NAMED else ""
            said = [
                f"{name} {old.get(name, 'not given')} before, {new.get(name, 'not given')} now"
                if len(f"{old.get(name)}{new.get(name)}") < SHORT
                else name
                for name in names[:NAMED]
            ]
            changes[key] = f" ({', '.join(said)}{more})"
    return changes


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
            estimate = pose(record)
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


def aligned(lines: list[Sequence[str]], left: int = 1) -> str:
    """Format lines of cells as a table, the first `left` columns to the left, others centred."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        " | ".join(
            cell.ljust(width) if i < left else cell.center(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def joined(values: Sequence[float | None] | None, kind: str) -> str:
    """Format numbers, as far as they are known, in one cell of a table."""
    known = [value for value in values or () if value is not None]
    return " / ".join(format(value, kind) for value in known) or "-"
