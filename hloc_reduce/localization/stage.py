"""Localize the queries of feature and match files in any map, and record each."""

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import h5py
import pycolmap

from .. import logger
from ..runtime import parallel
from ..runtime.executors import SERIAL, Executor
from ..runtime.group_writer import failure_of, failures
from ..utils import cli
from ..utils.cli import InputError
from ..utils.feature_files import get_image_size
from ..utils.h5 import open_h5
from ..utils.match_files import find_pair
from ..utils.parsers import parse_query_lists, parse_retrieval, write_poses
from ..utils.progress import progress
from .gate import DEFAULT_GATE, Gate, may_be_mirrored
from .inputs import Settings, of_matches, read_matches
from .mirrored import MirrorImages, mirror, mirror_options
from .query import localize
from .records import (
    RECORDS,
    Log,
    log_file,
    measures_of,
    nearness,
    pose_of,
    refused,
    to_record,
    with_mirror_image,
)
from .references import Reference, SfmMap
from .rig_pose import RigPose
from .rig_stage import (
    RigPhoto,
    SolvedFrame,
    localize_frames,
    open_frames,
    report_frames,
    with_images_about,
)
from .rigs import Frames, written

CHUNK = 8  # queries
SHOWN = 3  # queries whose reasons a message gives

Task = tuple[str, pycolmap.Camera | None, list[str]]  # a query, and the images retrieved for it
# matches pairs of queries and map images by the matcher of a try; returns the match file
MatchRigs = Callable[[int, Sequence[tuple[str, str]]], Path]


class Matched(NamedTuple):
    """Files of queries: their features and matches, and the pairs if these are others than before.

    Pairs are of queries and map images, best first.
    """

    features: Path
    matches: Path
    pairs: Path | None = None


class Try(NamedTuple):
    """A further way to match queries that are not localized.

    Args:
        match: matches queries, given their names.
        made_from: what determines the matches beside the features of the first try.
        mirror_images: extracts and matches mirror images of queries whose intrinsics are not
            given: if the poses of these are nearly as likely, their own are refused; None: no query
            is tested.
        names: the queries that may be tried; None: all.
        told: what the record of a query says of the try, as `main` returns it.
    """

    match: Callable[[list[str]], Matched]
    made_from: dict
    mirror_images: MirrorImages | None = None
    names: frozenset[str] | None = None
    told: Mapping[str, object] = MappingProxyType({"again": True})


FIRST = {"again": False, "turned": 0, "rig": None}  # what the records of the first try say of it


def main(
    load_reference: Callable[[], Reference],
    queries: Sequence[tuple[str, pycolmap.Camera | None]],
    retrieved: Mapping[str, list[str]],
    features: Path,
    matches: Path,
    results: Path,
    config: Callable[[str, pycolmap.Camera], dict],
    made_from: dict,
    overwrite: bool = False,
    skip_matches: int = 0,
    name_parts: int | None = 1,
    executor: Executor = SERIAL,
    gate: Gate = DEFAULT_GATE,
    mirror_images: MirrorImages | None = None,
    again: Sequence[Try] = (),
    rigs: Frames = MappingProxyType({}),
    match_rigs: MatchRigs | None = None,
) -> dict[str, dict]:
    """Localize queries by the files of their features and matches.

    A query whose photo could not be read, or is of another size than its intrinsics, is not
    localized.

    Args:
        load_reference: returns the map; called in each process that localizes queries.
        queries: names and intrinsics, None if these are not known.
        retrieved: the map images of each query, best first.
        features: feature file of the queries.
        matches: match file of the pairs.
        results: text file of poses, camera from world, one line for every query that has one.
        config: returns the options for `localize` from the name and the intrinsics of a query.
        made_from: provenance of the poses; the run resumes from `<results>_logs.jsonl` unless its
            records are stale.
        overwrite: localize all queries again.
        skip_matches: leave out retrieved images with fewer matches.
        name_parts: as in `parsers.write_poses`.
        executor: does the work; `load_reference` and `config` are pickled for other processes.
        gate: what a pose must have for the query to be called localized; what is not given is that
            for the matcher and the dimension in the files.
        mirror_images: see `Try`.
        again: how queries that are not localized are matched once more, one after the other.
        rigs: queries of which one pose is estimated together; their intrinsics are exact. If it is
            trusted, it replaces their own ones.
        match_rigs: matches photos of rigs with map images about an uncertain pose of the rig, in a
            COLMAP model; None: they are not.

    Returns:
        A record for each query, of the try that localized it or else came nearest: `localized`;
        `reason`, why it is not localized, None if it is; `try`, the index of the try in `again`
        plus 1, or 0; `tried`, that of the last one that was made; `again`, whether a second matcher
        matched it in that try, and `turned`, by how many degrees, counterclockwise, it was turned
        there, beyond what EXIF data say; `confidence` and `agreement`; the written pose as `qvec`
        (w, x, y, z) and `tvec`, the fallback if the query is not localized, None if there is none;
        `camera`, the model, width, height and parameters in a list, None if not known;
        `max_error`, RANSAC's inlier threshold in pixels, None for pycolmap's default; `measures`,
        see `Measures`; the numbers and `db` of `localize`; and `rig`, None or, of a photo of a rig,
        its `frame`, the `reason` why the pose of that is not trusted, None if it is, and `tried`,
        as above. The measures, but not the numbers, of such a pose are those of all photos.
    """
    header = {"records": RECORDS, "gate": asdict(gate), **made_from}
    header |= {"rigs": written(rigs), "match_rigs": bool(match_rigs)} if rigs else {}
    header |= {"mirror_images": True} if mirror_images else {}
    header |= {"again": [one.made_from for one in again]} if again else {}
    with Log(log_file(results), header, overwrite) as log:
        all_tasks = [(name, camera, retrieved.get(name, [])) for name, camera in queries]
        reasons = _reasons(features, queries)
        refuse = [task for task in all_tasks if task[0] in reasons.keys() - log.records.keys()]
        for name, record in _refuse(load_reference, refuse, reasons):
            log.add(name, {**record, **FIRST, "try": 0, "tried": 0})
        tasks = [task for task in all_tasks if task[0] not in reasons]
        if any(name not in log.records for name, _, _ in tasks):
            _check_some_matched(matches, [name for name, _ in queries], retrieved)
        settings = Settings(load_reference, config, skip_matches, gate, executor)
        localizing = _Localizing(log, settings, match_rigs)
        matched = Matched(features, matches)
        tries = [Try(lambda _: matched, {}, mirror_images, told=FIRST), *again]
        for number, one in enumerate(tries):
            localizing.run(number, one, tasks)
        for number, one in enumerate(tries):
            if one.names is None:  # it shows photos as they are
                localizing.run_rigs(number, one, rigs, tasks)
    records = {name: log.records[name] for name, _ in queries}
    poses = {name: pose_of(record) for name, record in records.items()}
    submitted = {name: known for name, known in poses.items() if known is not None}
    write_poses(submitted, results, name_parts)
    report_frames(records.values())
    _report(records, failures(features), log.path)
    localized = sum(record["localized"] for record in records.values())
    logger.info("Localized %d of %d queries: %s", localized, len(records), results)
    return records


@dataclass(frozen=True)
class _Localizing:
    """Localizes the queries of `main` and logs their records."""

    log: Log
    settings: Settings
    match_rigs: MatchRigs | None

    def run(self, number: int, given: Try, tasks: list[Task]) -> None:
        """Localize queries by the first try, number 0, or those not localized by a further one.

        Queries whose records are of the same try, of an interrupted run, are only tested for being
        mirrored.
        """
        records = self.log.records
        todo, done = [], []
        for task in tasks:
            name, record = task[0], records.get(task[0])
            if record is None:
                todo.append(name)
            elif record["tried"] < number:
                # without an image that was retrieved there is nothing to be matched with
                is_left = not record["localized"] and task[2]
                if is_left and (given.names is None or name in given.names):
                    todo.append(name)
            elif record["try"] == number:
                done.append(name)
        if not todo + done:
            return
        matched = given.match(todo + done)
        cameras = {name: camera for name, camera, _ in tasks}
        retrieved = {name: retrieved for name, _, retrieved in tasks}
        if matched.pairs:
            retrieved = parse_retrieval(matched.pairs)

        def of_try(names: list[str]) -> list[Task]:
            return [(name, cameras[name], retrieved.get(name, [])) for name in names]

        files = matched.features, matched.matches
        solved = localize_all(self.settings, *files, of_try(todo), True, "Localizing")
        for name, record in solved:
            before = records.get(name)
            record |= {**FIRST, **given.told, "try": number, "tried": number}
            if before and not record["localized"]:
                best = max(before, record, key=nearness)
                record = {**best, "tried": number}
            self.log.add(name, record)
        if given.mirror_images:
            self._try_mirror_images(given.mirror_images, files, of_try(todo + done))

    def run_rigs(self, number: int, given: Try, rigs: Frames, tasks: list[Task]) -> None:
        """Localize the frames of rigs by a try, unless an earlier one found a trusted pose."""
        frames = open_frames(number, rigs, tasks, self.log.records)
        if not frames:
            return
        matched = given.match([photo.name for _, photos in frames for photo in photos])
        uncertain: dict[str, SolvedFrame] = {}
        for solved in localize_frames(self.settings, matched.features, matched.matches, frames):
            if self.match_rigs and solved[1].may_gain:
                uncertain[solved[0]] = solved
            else:
                self._log_frame(number, given, *solved)
        for solved in self._match_again(number, matched.features, frames, uncertain):
            uncertain[solved[0]] = solved
        for solved in uncertain.values():
            self._log_frame(number, given, *solved)

    def _match_again(
        self,
        number: int,
        features: Path,
        frames: list[tuple[str, list[RigPhoto]]],
        uncertain: Mapping[str, SolvedFrame],
    ) -> Iterator[SolvedFrame]:
        """Localize the frames of uncertain poses with map images about these, too."""
        if not self.match_rigs or not uncertain:
            return
        reference = self.settings.load_reference()
        assert isinstance(reference, SfmMap)
        poses = {frame: pose.rig_from_world for frame, pose, _ in uncertain.values()}
        wider = with_images_about(reference, frames, poses)
        if wider:
            pairs = [
                (one.name, other) for _, seen in wider for one in seen for other in one.retrieved
            ]
            matches = self.match_rigs(number, pairs)
            yield from localize_frames(self.settings, features, matches, wider)

    def _log_frame(
        self, number: int, given: Try, frame: str, pose: RigPose, of_photos: dict[str, dict]
    ) -> None:
        """Log the records of the photos of a frame by a try."""
        records, reason = self.log.records, pose.refusal
        rig = {"frame": frame, "reason": reason, "tried": number}
        for name, record in of_photos.items():
            before = records[name]
            told = {**FIRST, **given.told, "try": number, "tried": before["tried"]}
            self.log.add(name, {**(before if reason else record | told), "rig": rig})

    def _try_mirror_images(
        self, mirror_images: MirrorImages, files: tuple[Path, Path], tasks: list[Task]
    ) -> None:
        """Refuse localized queries whose mirror images are nearly as likely."""
        records = self.log.records
        if not any(records[name]["localized"] for name, _, _ in tasks):
            return
        gate = of_matches(self.settings.gate, *files)
        flipped: list[Task] = [
            (name, mirror(camera), names)
            for name, camera, names in tasks
            if camera and _may_be_mirrored(records[name], gate)
        ]
        if not flipped:
            return
        reference = self.settings.load_reference()
        settings = self.settings._replace(config=partial(_mirrored, self.settings.config))
        mirrored = mirror_images([name for name, _, _ in flipped])
        retrieved = {name: names for name, _, names in flipped}
        solved = localize_all(settings, *mirrored, flipped, False, "Trying mirror images")
        for name, record in solved:
            names = [other for other in retrieved[name] if other in reference]
            before = records[name]
            self.log.add(name, with_mirror_image(before, record, reference, names, gate))


def _report(records: dict[str, dict], unreadable: Mapping[str, str], log_path: Path) -> None:
    """Warn of queries that are not localized, except unreadable ones: the extraction did."""
    if failed := [name for name, record in records.items() if record["qvec"] is None]:
        logger.warning("%d queries have no pose: %s.", len(failed), cli.some(failed))
    reasons = [
        f"{name} ({record['reason']})"
        for name, record in records.items()
        if record["reason"] and name not in unreadable
    ]
    if reasons:
        logger.warning("Not localized: %s.", cli.some(reasons, SHOWN))
    if len(reasons) > SHOWN:
        logger.warning("The reasons of all %d are in %s.", len(reasons), log_path)


def _refuse(
    load_reference: Callable[[], Reference], tasks: list[Task], reasons: Mapping[str, str]
) -> Iterator[tuple[str, dict]]:
    """Yield the names and the records of queries that are not to be localized."""
    if tasks:
        reference = load_reference()
        for name, camera, retrieved in tasks:
            names = [other for other in retrieved if other in reference]
            yield name, refused(reference, names, camera, reasons[name])


def _reasons(
    features: Path, queries: Sequence[tuple[str, pycolmap.Camera | None]]
) -> dict[str, str]:
    """Return why queries are not to be localized, without those that are."""
    with open_h5(features) as file:
        reasons = {name: _reason(file, name, camera) for name, camera in queries}
    return {name: reason for name, reason in reasons.items() if reason}


def _reason(feature_file: h5py.File, name: str, camera: pycolmap.Camera | None) -> str | None:
    """Return why a query is not to be localized, None if it is."""
    if failure := failure_of(feature_file, name):
        return failure
    if camera is None:
        return "its intrinsics are not known"
    if f"{name}/image_size" not in feature_file:
        return None
    width, height = get_image_size(feature_file, name)
    if (width, height) == (camera.width, camera.height):
        return None
    return (
        f"the intrinsics are for {camera.width}x{camera.height} pixels, the photo has "
        f"{width}x{height}"
    )


def _check_some_matched(
    matches: Path, names: list[str], retrieved: Mapping[str, list[str]]
) -> None:
    """Refuse a match file that has not a single pair."""
    pairs = [(name, other) for name in names for other in retrieved.get(name, [])]
    with open_h5(matches) as file:
        if pairs and not any(find_pair(file, *pair)[0] for pair in pairs):
            raise InputError(
                f"The pair {pairs[0][0]}, {pairs[0][1]} is not in the match file {matches}, and no "
                "other of the queries is."
            )


def _may_be_mirrored(record: dict, gate: Gate) -> bool:
    """Tell whether the mirror image of a query is yet to be tried."""
    measures = measures_of(record)
    untried = record["localized"] and measures.mirror_image is None
    return untried and may_be_mirrored(measures, gate)


def _mirrored(
    config: Callable[[str, pycolmap.Camera], dict], name: str, camera: pycolmap.Camera
) -> dict:
    """Return the options of the mirror image of a query, whose intrinsics are mirrored."""
    return mirror_options(config(name, camera))


def localize_all(
    settings: Settings,
    features: Path,
    matches: Path,
    tasks: list[Task],
    thorough: bool,
    said: str,
) -> Iterator[tuple[str, dict]]:
    """Yield the names and the records of queries.

    Args:
        settings: how they are localized.
        features: feature file of the queries.
        matches: match file of the pairs.
        tasks: names and intrinsics of the queries, with the images that are retrieved for each.
        thorough: also try matches of single images, as `absolute_pose.estimate` does.
        said: what the progress bar says.
    """
    of_files = settings.of_files(features, matches)
    work = partial(_localize_chunk, of_files, features, matches, thorough)
    with closing(settings.executor.map(work, tasks, CHUNK)) as found:
        yield from progress(found, said, "query", len(tasks))


def check_threshold(ransac_thresh: float) -> None:
    """Raise an InputError for an inlier threshold that is not above 0."""
    if not ransac_thresh > 0:
        raise InputError(f"ransac_thresh is {ransac_thresh}: it must be above 0.")


def _localize_chunk(
    settings: Settings,
    features: Path,
    matches: Path,
    thorough: bool,
    queries: Iterable[Task],
) -> Generator[tuple[str, dict], None, None]:
    """Yield the names and the records of queries with their intrinsics and retrieved images."""
    reference, least = settings.load_reference(), settings.skip_matches

    def solve(task: tuple) -> tuple[str, dict]:
        name, camera, keypoints, found = task
        used = {other: pairs for other, pairs in found.items() if len(pairs) >= least}
        options = settings.config(name, camera)
        query = keypoints, camera, used, options, settings.gate
        cam_from_world, info = localize(reference, *query, thorough)
        info["max_error"] = options.get("estimation", {}).get("ransac", {}).get("max_error")
        return name, to_record(reference, list(found), cam_from_world, info)

    with open_h5(features) as feature_file, open_h5(matches) as match_file:
        tasks = (
            (name, camera, *read_matches(feature_file, match_file, name, retrieved, reference))
            for name, camera, retrieved in queries
        )
        with closing(parallel.ordered("localize", solve, tasks)) as solved:
            yield from solved


def read_queries(queries: Path) -> list[tuple[str, pycolmap.Camera]]:
    """Read the queries of all lists that match a glob."""
    return [query for part in parse_query_lists(queries).values() for query in part]
