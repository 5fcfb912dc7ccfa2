"""Localize the frames of rigs by the files of features and matches of their photos."""

from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from .. import logger
from ..runtime import parallel
from ..utils import cli
from ..utils.h5 import open_h5
from ..utils.progress import progress
from . import gate as gates
from . import rig_pose
from .inputs import Settings, read_matches
from .near import Surroundings
from .records import to_record
from .references import Reference, SfmMap
from .rigs import Frames

CHUNK = 4  # frames
SHOWN = 3  # frames whose reasons a message gives


class RigPhoto(NamedTuple):
    """A photo of a frame.

    Args:
        name: of the photo.
        camera: its intrinsics, which are exact.
        cam_from_rig: the pose of its camera in the rig.
        retrieved: map images, best first.
    """

    name: str
    camera: pycolmap.Camera
    cam_from_rig: pycolmap.Rigid3d
    retrieved: list[str]


# the name of a frame, its pose, and the records of its photos
SolvedFrame = tuple[str, rig_pose.RigPose, dict[str, dict]]


def open_frames(
    number: int,
    rigs: Frames,
    tasks: Iterable[tuple[str, pycolmap.Camera | None, list[str]]],
    records: Mapping[str, dict],
) -> list[tuple[str, list[RigPhoto]]]:
    """Return the frames of several photos whose pose no earlier try has found.

    Args:
        number: of the try.
        rigs: all frames.
        tasks: names of queries with known intrinsics, these, and the retrieved images.
        records: of the queries, so far.
    """
    queries = {name: (camera, retrieved) for name, camera, retrieved in tasks}
    frames = []
    for frame, poses in rigs.items():
        photos = []
        for name, cam_from_rig in poses.items():
            camera, retrieved = queries.get(name, (None, []))
            if camera is not None:
                photos.append(RigPhoto(name, camera, cam_from_rig, retrieved))
        told = [records[photo.name]["rig"] for photo in photos]
        is_open = any(not one or (one["reason"] and one["tried"] < number) for one in told)
        if is_open and len(photos) > 1:
            frames.append((frame, photos))
    return frames


def with_images_about(
    reference: SfmMap,
    frames: Sequence[tuple[str, list[RigPhoto]]],
    poses: Mapping[str, pycolmap.Rigid3d | None],
) -> list[tuple[str, list[RigPhoto]]]:
    """Return the frames with likely poses that have other map images about them, with these.

    A camera in the dark may retrieve other places.

    Args:
        reference: the map.
        frames: names of frames and their photos.
        poses: of some frames, rig from world, None without one.
    """
    surroundings = Surroundings(reference, sorted(reference.images), reference.views)
    found = []
    for frame, photos in frames:
        if (likely := poses.get(frame)) is None or surroundings.is_far(likely):
            continue
        more = []
        for photo in photos:
            near = surroundings.guess(photo.cam_from_rig * likely, None, photo.camera).images
            more.append(photo._replace(retrieved=[*dict.fromkeys([*photo.retrieved, *near])]))
        if more != photos:
            found.append((frame, more))
    return found


def localize_frames(
    settings: Settings,
    features: Path,
    matches: Path,
    frames: Sequence[tuple[str, Sequence[RigPhoto]]],
) -> Iterator[SolvedFrame]:
    """Yield of each frame its name, pose and records.

    Args:
        settings: how they are localized.
        features: feature file of the photos.
        matches: match file of the pairs.
        frames: names of frames and their photos.

    Returns:
        The records are of the photos, as `stage.main` returns them, with the pose that the rig
        gives each, and the measures of all of them together.
    """
    of_files = settings.of_files(features, matches)
    work = partial(_localize_chunk, of_files, features, matches)
    with closing(settings.executor.map(work, frames, CHUNK)) as found:
        yield from progress(found, "Localizing rigs", "frame", len(frames))


def _localize_chunk(
    settings: Settings,
    features: Path,
    matches: Path,
    frames: Iterable[tuple[str, Sequence[RigPhoto]]],
) -> Generator[SolvedFrame, None, None]:
    reference, gate = settings.load_reference(), settings.gate

    def read(photo: RigPhoto) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        files = feature_file, match_file
        keypoints, found = read_matches(*files, photo.name, photo.retrieved, reference)
        least = settings.skip_matches
        return keypoints, {name: pairs for name, pairs in found.items() if len(pairs) >= least}

    def solve(task: tuple) -> SolvedFrame:
        frame, seen = task
        names = dict.fromkeys(name for *_, found in seen for name in found)
        floors = reference.floors([*names]) if names else [[]]
        solved = [on_floor(seen, floor) for floor in floors]
        number, pose = rig_pose.best_of([pose for pose, _ in solved], gate)
        verdict = gates.verdict(pose.measures, gate) | {"reason": pose.refusal}
        told = solved[number][1]
        records = {one[0].name: _record(reference, pose, verdict, *one) for one in told}
        return frame, pose, records

    def on_floor(seen: list, floor: list[str]) -> tuple[rig_pose.RigPose, list[tuple]]:
        sights, infos = [], []
        for photo, keypoints, found in seen:
            options = settings.config(photo.name, photo.camera)
            there = {name: found[name] for name in found if name in floor}
            given = keypoints, there, options, gate, *photo[:3]
            sight, info = rig_pose.sight(reference, *given)
            sights.append(sight)
            infos.append(info | {"db": next(iter(there), None)})
        pose = rig_pose.estimate(sights, gate)
        photos = [photo for photo, *_ in seen]
        return pose, list(zip(photos, sights, infos, pose.inliers, strict=True))

    with open_h5(features) as feature_file, open_h5(matches) as match_file:
        tasks = ((frame, [(one, *read(one)) for one in photos]) for frame, photos in frames)
        with closing(parallel.ordered("localize", solve, tasks)) as solved:
            yield from solved


def _record(
    reference: Reference,
    pose: rig_pose.RigPose,
    verdict: dict,
    photo: RigPhoto,
    sight: rig_pose.Sight,
    info: dict,
    inliers: np.ndarray,
) -> dict:
    """Return the record of a photo whose pose the rig gives."""
    measures, cam_from_rig = pose.measures, photo.cam_from_rig
    cam_from_world = pose.rig_from_world and cam_from_rig * pose.rig_from_world
    covariance = pose.covariance
    if covariance is not None:  # of a motion of the camera, not of the rig
        moved = cam_from_rig.adjoint()
        covariance = moved @ covariance @ moved.T
    info = {
        **info,
        **verdict,
        "confidence": round(max(0.0, measures.confidence), 2),
        "agreement": round(measures.agreement, 3),
        "num_inliers": int(inliers.sum()),
        "camera": photo.camera,
        "max_error": sight.max_error,
        "covariance": covariance,
    }
    names = [name for name in photo.retrieved if name in reference]
    return to_record(reference, names, cam_from_world, info)


def reasons(records: Iterable[dict]) -> dict[str, str | None]:
    """Return why the poses of frames are not trusted, None if they are, by records of photos."""
    return {rig["frame"]: rig["reason"] for record in records if (rig := record["rig"])}


def report_frames(records: Iterable[dict]) -> None:
    """Log how many frames of rigs are localized, and why others are not."""
    frames = reasons(records)
    refused = [f"{frame} ({reason})" for frame, reason in frames.items() if reason]
    if frames:
        logger.info("Localized %d of %d frames.", len(frames) - len(refused), len(frames))
    if refused:
        logger.warning("Frames without a trusted pose of the rig: %s.", cli.some(refused, SHOWN))
