"""What a report reads of a run: its summary, its queries and the files that it left."""

import csv
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import h5py
import numpy as np
import pycolmap

from .. import logger
from ..datasets import scans
from ..evaluation import published
from ..evaluation.poses import FAILED
from ..localization.records import log_file, read_records
from ..localization.references import Reference, ScanMap, SfmMap
from ..maps.map import is_map
from ..runtime.outputs import SHARED
from ..utils import cli, colmap
from ..utils.cli import InputError, no_folder
from ..utils.h5 import open_h5
from ..utils.parsers import parse_poses, parse_retrieval

NUMBERS = ("num_matches", "num_correspondences", "num_inliers")
ERRORS = ("position_error_m", "rotation_error_deg")
LEVELS = 2  # of folders in that of a batch: data sets and jobs


@dataclass
class Run:
    """The outputs folder of a pipeline.

    Args:
        folder: that has summary.json.

    Attributes:
        label: how the run is called in a report; its feature, unless another run has the same.
        family: what features of several sizes have in common, `sift_sv` of sift_sv64.
        summary: of summary.json.
        rows: of queries.csv by query, with numbers as numbers and None for an unknown error.
        records: of the queries, as of `localization.main`.

    Raises:
        InputError: when the folder is none of a finished run, or of an older version.
    """

    folder: Path
    label: str = field(init=False)
    family: str = field(init=False)
    summary: dict = field(init=False)
    rows: dict[str, dict] = field(init=False)
    records: dict[str, dict] = field(init=False)

    def __post_init__(self) -> None:
        try:
            self.summary = dict(json.loads((self.folder / "summary.json").read_text()))
            files = self.summary["files"].items()
            self.files = {key: value and self.folder / value for key, value in files}
            self.poses = self.folder / self.summary["poses"]
            self.rows = self._read_rows()
            self.label = str(self.summary["feature"])
            self.family = self.label.rstrip("0123456789")
            self.bytes = int(self.summary["bytes_per_keypoint"]["descriptor"])
            self.seconds = float(sum(self.summary["seconds"].values()))
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            if not self.folder.is_dir():
                raise no_folder(self.folder) from None
            why = "a broken file"
            if isinstance(error, FileNotFoundError):
                why = f"no {Path(error.filename).name}"
            elif isinstance(error, KeyError):
                why = f"no {error} in its summary.json or queries.csv"
            raise InputError(
                f"{self.folder} is not the outputs folder of a finished run of this version, it "
                f"has {why}: run its pipeline again, which computes only what is missing."
            ) from None
        self.records = self._read_records()

    def _read_rows(self) -> dict[str, dict]:
        with (self.folder / "queries.csv").open(newline="", encoding="utf-8") as file:
            rows = {row["query"]: row for row in csv.DictReader(file)}
        for row in rows.values():
            row |= {key: int(row[key]) for key in NUMBERS}
            row |= {key: float(row[key]) if row[key] else None for key in ERRORS}
        return rows

    @property
    def place(self) -> Path:
        """The data set, or the map that was localized in."""
        return Path(self.summary.get("dataset") or self.summary["map"])

    @cached_property
    def published(self) -> str | None:
        """The data set of the paper that was localized in; None for another place."""
        lists: dict[str, list[str]] = {}
        for query, row in self.rows.items():
            lists.setdefault(row["list"], []).append(query)
        return published.dataset(lists)

    def errors(self, name: str) -> list[tuple[float, float]]:
        """Return the errors of the queries of a list with known truth; of failures infinite."""
        rows = [row for row in self.rows.values() if row["list"] == name]
        return [
            (row[ERRORS[0]], row[ERRORS[1]]) if row["status"] == "localized" else FAILED
            for row in rows
            if row[ERRORS[0]] is not None
        ]

    def _read_records(self) -> dict[str, dict]:
        records = read_records(log_file(self.poses))
        if records.keys() != self.rows.keys():
            raise InputError(f"{self.folder} is of a run that did not finish: run it again.")
        return records

    @cached_property
    def reconstruction(self) -> pycolmap.Reconstruction | None:
        """The COLMAP model of the map; None where scans are the map."""
        return colmap.read_model(self.files["map"]) if self.files["map"].is_dir() else None

    @cached_property
    def reference(self) -> Reference:
        """The map, which knows what point each keypoint of its images shows."""
        if self.reconstruction is not None:
            return SfmMap(self.reconstruction)
        points, features = self.files["map"], self.files["map_features"]
        with open_h5(points), open_h5(features):  # or they say why not
            files = h5py.File(points), h5py.File(features)
        names = sorted({name for names in self.retrieved.values() for name in names})
        poses = {name: scans.read_pose(self.files["map_images"], name) for name in names}
        return ScanMap(*files, poses)

    @cached_property
    def retrieved(self) -> dict[str, list[str]]:
        """The map images that were retrieved for each query, best first."""
        return parse_retrieval(self.files["pairs"])

    @cached_property
    def truth(self) -> dict[str, pycolmap.Rigid3d]:
        """The true poses of queries, camera from world, as far as their file is there."""
        path = self.files["ground_truth"]
        if path is None or not path.is_file():
            return {}
        return {name: pose for name, pose in parse_poses(path).items() if name in self.rows}


def find(folder: Path) -> list[Run]:
    """Return the run in a folder or, if it is not a run's, the finished runs below it.

    Args:
        folder: of a run; or with runs at most `LEVELS` below it, such as that of a batch. Runs
            that are not finished are skipped with a warning.

    Raises:
        InputError: when the folder is not there, or there is no finished run.
    """
    if _is_run(folder) or not folder.is_dir():
        return [Run(folder)]
    finished, unfinished = [], []
    for path in _below(folder, LEVELS):
        try:
            finished.append(Run(path))
        except InputError:
            unfinished.append(path.relative_to(folder).as_posix())
    some = cli.some(unfinished)
    if not finished:
        why = f"its runs are not finished ({some})" if unfinished else "it has no runs"
        raise InputError(
            f"{folder} is not the outputs folder of a pipeline or a batch, or {why}: run the "
            "pipeline again, which computes only what is missing."
        )
    if unfinished:
        logger.warning("Skipping %d unfinished runs in %s: %s.", len(unfinished), folder, some)
    return finished


def _is_run(folder: Path) -> bool:
    """Return whether a pipeline has begun a run in a folder."""
    return any((folder / name).exists() for name in ("conf.json", "summary.json"))


def _below(folder: Path, levels: int) -> Iterator[Path]:
    """Yield the folders of runs below a folder, without what jobs share and without maps."""
    for path in sorted(path for path in folder.iterdir() if path.is_dir()):
        if not _is_run(path):
            yield from _below(path, levels - 1) if levels > 1 else ()
        elif not _is_shared(path) and not is_map(path):
            yield path


def _is_shared(folder: Path) -> bool:
    """Return whether a folder has what the jobs of a batch share on a data set."""
    return folder.name == SHARED and _is_run(folder)


def load(folders: list[Path]) -> list[Run]:
    """Load runs, each with a label of its own.

    Args:
        folders: as of `find`. What jobs share is left out if it is named beside them, as a shell
            does.

    Raises:
        InputError: for a folder without a finished run.
    """
    folders = [folder for folder in folders if not _is_shared(folder)] or folders
    found = [run for folder in folders for run in find(folder.resolve())]
    runs = list({run.folder: run for run in found}.values())
    if len(runs) < len(found):
        logger.warning("A folder that is given twice is shown once.")
    for alike in [[r for r in runs if r.label == label] for label in {run.label for run in runs}]:
        ends = [run.folder.parts for run in alike]
        depth = next(n for n in range(1, 999) if len({parts[-n:] for parts in ends}) == len(ends))
        for run in alike if len(alike) > 1 else ():
            run.label = f"{run.label} ({'/'.join(run.folder.parts[-depth:])})"
    if len({run.place.resolve() for run in runs}) > 1:  # what is joined by a line is of one place
        for run in runs:
            run.family = f"{run.family}, {run.place.name}"
    return runs


def short(query_list: str) -> str:
    """Return the name of a list without what all lists of queries have: `day`, for example."""
    return re.sub(r"(_time)?(_queries)?(_with_intrinsics)$", "", query_list) or query_list


def ranked(runs: list[Run]) -> list[str]:
    """Return the queries of all runs, the worst first.

    Worse is what fewer runs localize, then the larger position error in any run or, where it is
    not known, the fewer inliers.
    """

    def badness(name: str) -> tuple[int, float, float]:
        rows = [run.rows[name] for run in runs if name in run.rows]
        localized = sum(row["status"] == "localized" for row in rows)
        known = [row[ERRORS[0]] for row in rows if row[ERRORS[0]] is not None]
        return localized, -max(known, default=0.0), min(row["num_inliers"] for row in rows)

    return sorted(dict.fromkeys(name for run in runs for name in run.rows), key=badness)


def recall_tables(runs: list[Run]) -> list[dict]:
    """Return the recall of each list of queries, by its short name.

    Returns:
        A dict for each list: `list`; `thresholds`, pairs of metres and degrees, those of the paper
        where no true pose is known but the paper has numbers, or none; and `rows`, a dict for each
        run that has the list: `run`, `summary` of it, and as many numbers in percent or None of
        `recall` and of `paper`, which is None unless the paper has the feature on this data set.
    """
    tables: dict[str, dict] = {}
    for run in runs:
        for name, summary in run.summary["lists"].items():
            table = tables.setdefault(
                short(name), {"list": short(name), "thresholds": [], "rows": []}
            )
            paper = run.published and published.recall(run.summary["feature"], name)
            limits = summary.get("thresholds_m_deg") or (paper and published.thresholds(name))
            table["thresholds"] = table["thresholds"] or limits or []
            row = {"run": run, "summary": summary, "paper": paper}
            table["rows"].append({**row, "recall": summary.get("recall_percent")})
    for table in tables.values():
        for row in table["rows"]:
            row["recall"] = row["recall"] or [None] * len(table["thresholds"])
    return list(tables.values())


def spread(names: list[str], number: int) -> list[str]:
    """Choose so many of ranked names, evenly, with the first and the last."""
    places = np.linspace(0, len(names) - 1, min(number, len(names))).round().astype(int)
    return [names[i] for i in places]
