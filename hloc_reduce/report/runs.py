"""The runs that a report compares: their summaries, queries and files."""

import csv
import json
import re
from collections import Counter
from collections.abc import Callable
from functools import cache, cached_property
from pathlib import Path

import numpy as np
import pycolmap

from .. import logger
from ..datasets import scans
from ..evaluation import published
from ..evaluation.poses import ERRORS, counted_errors
from ..localization import panoramas
from ..localization.records import log_file, read_records
from ..localization.references import ScanMap, SfmMap
from ..maps.map import is_map
from ..runtime.outputs import CONF, SHARED
from ..utils import cli, colmap
from ..utils.cli import InputError, no_folder
from ..utils.codes import FLOATS
from ..utils.files import MEGABYTE
from ..utils.h5 import open_file
from ..utils.parsers import parse_poses, parse_retrieval

COUNTS = ("num_matches", "num_correspondences", "num_inliers")
BEGUN = (CONF, "summary.json")  # either tells that a pipeline has begun a run


class Run:
    """A finished run of a pipeline.

    Args:
        folder: its outputs folder.

    Attributes:
        summary: summary.json.
        files: the files of the run by their keys in the summary, None if the run has none.
        tries: by their number, the files of further tries, see `localization.stage.Matched`.
        rows: queries.csv by query, counts as int, errors as float or None if unknown.
        records: the record of each query, as from `localization.main`.
        feature: name of the feature.
        label: the name of the run in a report, with the size of a compact map, or the storage of
            a whole one unless that is float16.
        family: its feature without the dimension: `sift_sv` for sift_sv64; with this storage.
        bytes: size of a descriptor.
        map_bytes: size of the map, None if unknown.
        is_compact: whether the map is one file of `hloc_reduce.compact`.
        seconds: time of all stages.

    Raises:
        InputError: when the folder has no finished run of this version.
    """

    def __init__(self, folder: Path):
        if not folder.is_dir():
            raise no_folder(folder)
        self.folder = folder
        try:
            self.summary = dict(json.loads((folder / "summary.json").read_text()))
            files = self.summary["files"].items()
            self.files = {key: value and folder / value for key, value in files}
            self.tries = {
                int(number): {key: value and folder / value for key, value in found.items()}
                for number, found in self.summary["tries"].items()
            }
            self.rows = _read_rows(folder / "queries.csv")
            self.feature = self.label = str(self.summary["feature"])
            self.family = self.label.rstrip("0123456789")
            stored = self.summary["bytes_per_keypoint"].get("storage", FLOATS[0])
            self.map_bytes: int | None = self.summary.get("map_bytes")
            self.is_compact = "compact" in self.summary
            if self.is_compact:
                self.label += f", {int(self.summary['map_bytes']) / MEGABYTE:.3g} MB"
            elif stored != FLOATS[0]:
                self.label, self.family = f"{self.label}, {stored}", f"{self.family}, {stored}"
            self.bytes = int(self.summary["bytes_per_keypoint"]["descriptor"])
            self.seconds = float(sum(self.summary["seconds"].values()))
            self._poses = folder / self.summary["poses"]
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            why = "a broken file"
            if isinstance(error, FileNotFoundError):
                why = f"no {Path(error.filename).name}"
            elif isinstance(error, KeyError):
                why = f"no {error} in its summary.json or queries.csv"
            raise InputError(
                f"{folder} is not the outputs folder of a finished run of this version, it has "
                f"{why}: run its pipeline again, which computes only what is missing."
            ) from None
        self.records = read_records(log_file(self._poses))
        if self.records.keys() != self.rows.keys():
            raise InputError(f"{folder} is the folder of a run that did not finish: run it again.")

    @property
    def hloc_bytes(self) -> int | None:
        """Size of the files that hloc has in their place: features and the COLMAP model.

        The feature file of a data set has the queries, too, and the folder of the model has its
        database. None for a compact map or one of scans.
        """
        model = self.files["map"]
        if self.is_compact or not model.is_dir():
            return None
        return sum(path.stat().st_size for path in (self.files["map_features"], *model.iterdir()))

    @property
    def place(self) -> Path:
        """The data set, or the map that was localized in."""
        return Path(self.summary.get("dataset") or self.summary["map"])

    @cached_property
    def published(self) -> str | None:
        """The data set of the paper that the queries are from; None for another one."""
        lists: dict[str, list[str]] = {}
        for query, row in self.rows.items():
            lists.setdefault(row["list"], []).append(query)
        return published.dataset(lists)

    def errors(self, name: str) -> list[tuple[float, float]]:
        """Return `counted_errors` of the queries of a list."""
        return counted_errors(row for row in self.rows.values() if row["list"] == name)

    @cached_property
    def reference(self) -> SfmMap | ScanMap:
        """The map.

        Raises:
            InputError: when its files are missing or broken.
        """
        points, features = self.files["map"], self.files["map_features"]
        if points.is_dir():
            return SfmMap(colmap.read_model(points))
        of_points, of_features = open_file(points), open_file(features)
        names = sorted({name for names in self.retrieved.values() for name in names})
        poses = {name: scans.read_pose(self.files["map_images"], name) for name in names}
        return ScanMap(of_points, of_features, poses)

    @property
    def retrieved(self) -> dict[str, list[str]]:
        """The map images that were retrieved for each query in the first try, best first."""
        return self._retrieved(self.files["pairs"])

    @cached_property
    def _retrieved(self) -> Callable[[Path], dict[str, list[str]]]:
        return cache(parse_retrieval)

    def retrieved_for(self, query: str) -> list[str]:
        """Return the map images that were retrieved in the try that a record is of, best first."""
        return self._retrieved(self.file_of(query, "pairs")).get(self.shown(query)[0], [])

    def shown(self, query: str) -> tuple[str, dict, Path]:
        """Return the name, the record and the file of the photo that shows a query.

        Of a panorama it is the view with the most inliers, localized if the panorama is.
        """
        record = self.records[query]
        view = record.get("view")
        if view is None:
            return query, record, self.files["query_images"] / query
        told = {"localized": record["localized"]}
        return view, self._views[view] | told, self.folder / panoramas.SHOWN / view

    @cached_property
    def _views(self) -> dict[str, dict]:
        """The records of the views of panoramas."""
        return read_records(log_file(panoramas.results_of_views(self._poses)))

    def file_of(self, query: str, key: str) -> Path:
        """Return the `features`, `matches` or `pairs` of the try that a record is of."""
        number = self.records[query]["try"]
        return (self.tries[number][key] if number else None) or self.files[key]

    @cached_property
    def truth(self) -> dict[str, pycolmap.Rigid3d]:
        """The known true poses of queries, camera from world."""
        path = self.files["ground_truth"]
        if path is None or not path.is_file():
            return {}
        return {name: pose for name, pose in parse_poses(path).items() if name in self.rows}


def _read_rows(path: Path) -> dict[str, dict]:
    with path.open(newline="", encoding="utf-8") as file:
        rows: dict[str, dict] = {row["query"]: row for row in csv.DictReader(file)}
    for row in rows.values():
        row |= {key: int(row[key]) for key in COUNTS}
        row |= {key: float(row[key]) if row[key] else None for key in ERRORS}
    return rows


def load(folders: list[Path]) -> list[Run]:
    """Load runs, each with a label of its own.

    Args:
        folders: as for `find`. The folder that the jobs of a batch share, which a shell's `batch/*`
            includes, is skipped unless it is the only one.

    Raises:
        InputError: for a folder without a finished run.
    """
    folders = [folder for folder in folders if not _is_shared(folder)] or folders
    found = [run for folder in folders for run in find(folder.resolve())]
    runs = list({run.folder: run for run in found}.values())
    if len(runs) < len(found):
        logger.warning("A folder that is given twice is shown once.")
    for label, number in Counter(run.label for run in runs).items():
        if number > 1:
            _tell_apart([run for run in runs if run.label == label])
    if len({run.place.resolve() for run in runs}) > 1:  # a line joins runs on the same place only
        for run in runs:
            run.family = f"{run.family}, {run.place.name}"
    return runs


def _tell_apart(runs: list[Run]) -> None:
    """Add to the labels of runs the ends of their paths, as long as it takes."""
    depth = 1
    while len({run.folder.parts[-depth:] for run in runs}) < len(runs):
        depth += 1
    for run in runs:
        run.label = f"{run.label} ({'/'.join(run.folder.parts[-depth:])})"


def find(folder: Path) -> list[Run]:
    """Return the run in a folder or, if there is none, the finished runs below it.

    Args:
        folder: the outputs folder of a run or a batch, or another folder with runs at most two
            levels below. Unfinished runs are skipped with a warning.

    Raises:
        InputError: when the folder is missing or has no finished run.
    """
    if _is_run(folder) or not folder.is_dir():
        return [Run(folder)]
    finished, unfinished = [], []
    for path in _runs_below(folder):
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
    return any((folder / name).exists() for name in BEGUN)


def _is_shared(folder: Path) -> bool:
    """Return whether a folder has what the jobs of a batch share on a data set."""
    return folder.name == SHARED and _is_run(folder)


def _runs_below(folder: Path) -> list[Path]:
    """List the outputs folders of runs one or two levels below, without shared ones and maps."""
    levels = ("*", "*/*")  # a data set of a batch, its jobs
    found = {
        file.parent for level in levels for name in BEGUN for file in folder.glob(f"{level}/{name}")
    }
    return sorted(
        path
        for path in found
        if path.parent not in found and not _is_shared(path) and not is_map(path)
    )


def short(query_list: str) -> str:
    """Shorten the name of a query list, day_time_queries_with_intrinsics to day."""
    return re.sub(r"(_time)?(_queries)?(_with_intrinsics)$", "", query_list) or query_list


def ranked(runs: list[Run]) -> list[str]:
    """Return the queries of all runs, the worst first.

    Queries that fewer runs localize are worse; then those with a larger position error in any run
    or, where errors are unknown, with fewer inliers.
    """

    def quality(name: str) -> tuple[int, float, float]:
        rows = [run.rows[name] for run in runs if name in run.rows]
        localized = sum(row["status"] == "localized" for row in rows)
        known = [row[ERRORS[0]] for row in rows if row[ERRORS[0]] is not None]
        return localized, -max(known, default=0.0), min(row["num_inliers"] for row in rows)

    return sorted(dict.fromkeys(name for run in runs for name in run.rows), key=quality)


def spread(names: list[str], number: int) -> list[str]:
    """Choose `number` of ranked names, evenly, with the first and the last."""
    places = np.linspace(0, len(names) - 1, min(number, len(names))).round().astype(int)
    return [names[i] for i in places]


def recall_tables(runs: list[Run]) -> list[dict]:
    """Return a table of recall for each query list.

    Returns:
        A dict for each list: `list`, its short name; `thresholds`, pairs of metres and degrees, the
        paper's if no true pose is known; and `rows`, a dict for each run: `run`; `summary` of the
        list; `recall` [%] at each threshold, None if unknown; and `paper`, the paper's recall [%],
        None unless it has the feature on this data set.
    """
    tables: dict[str, dict] = {}
    for run in runs:
        for name, summary in run.summary["lists"].items():
            new = {"list": short(name), "thresholds": [], "rows": []}
            table = tables.setdefault(short(name), new)
            paper = run.published and published.recall(run.summary["feature"], name)
            limits = summary.get("thresholds_m_deg") or (paper and published.thresholds(name))
            table["thresholds"] = table["thresholds"] or limits or []
            recall = summary.get("recall_percent")
            table["rows"].append({"run": run, "summary": summary, "paper": paper, "recall": recall})
    for table in tables.values():
        for row in table["rows"]:
            row["recall"] = row["recall"] or [None] * len(table["thresholds"])
    return list(tables.values())
