"""The 3D view of a report: points, map cameras and query cameras."""

import base64
from collections.abc import Sequence

import numpy as np
import pycolmap

from ..datasets import scans
from ..localization.records import pose_of
from ..localization.references import SfmMap
from ..utils.cli import InputError
from ..utils.feature_files import get_keypoints
from ..utils.h5 import open_h5
from ..utils.images import read_image
from .runs import Run

MAX_POINTS = 6000
SAMPLED_IMAGES = 24  # of the map, from which the points and their colours are taken
MAX_CAMERAS = 1000  # of the map, about
GREY = 120  # colour of points if there is no photo


def scenes(run: Run) -> dict[str, dict]:
    """Return the 3D view of a run by label, or of each floor, as the scans of each have a frame.

    Returns:
        For each view, with the middle of what to look at as its origin: `points` (N, 3) float32 in
        metres and `colours` (N, 3) uint8, in base64; `map`, cameras or scans as (centre, right,
        down, forward) (12,); `queries`, dicts of `name`, `status`, and the cameras `pose` and
        `truth` or None; `up`, the vertical; and the `radius` of what to look at.

    Raises:
        InputError: when the files of the map are missing or broken.
    """
    reference = run.reference
    if isinstance(reference, SfmMap):
        images = reference.images.items()
        cameras = {name: _axes(image.cam_from_world()) for name, image in images}
        return {run.label: _scene(run, cameras, run.records)}
    floors: dict[str, dict] = {}
    for name, pose in reference.poses.items():
        floors.setdefault(scans.floor_of(name), {})[name] = [*pose[:3, 3], *pose[:3, :3].T.ravel()]
    found = {}
    for floor, cameras in floors.items():
        records = {
            name: record
            for name, record in run.records.items()
            if record["db"] is not None and scans.floor_of(record["db"]) == floor
        }
        label = run.label if len(floors) == 1 else f"{run.label}, {floor}"
        found[label] = _scene(run, cameras, records)
    return found


def _scene(run: Run, cameras: dict[str, list[float]], records: dict[str, dict]) -> dict:
    points, colours = _points(run, sorted(cameras))
    queries = []
    for name, record in records.items():
        pose = pose_of(record)
        queries.append(
            {
                "name": name,
                "status": run.rows[name]["status"],
                "pose": None if pose is None else _axes(pose),
                "truth": _axes(run.truth[name]) if name in run.truth else None,
            }
        )
    shown = list(cameras.values())[:: -(-len(cameras) // MAX_CAMERAS)]
    looks = np.array([*shown, *(q["truth"] or q["pose"] for q in queries if q["pose"])])
    # points and cameras count alike; a tenth of them may be far off
    groups = [part for part in (points, looks[:, :3]) if len(part)]
    centre = np.mean([np.median(part, axis=0) for part in groups], axis=0)
    radius = max(np.quantile(np.linalg.norm(part - centre, axis=1), 0.9) for part in groups)
    up = -looks[:, 6:9].mean(axis=0)

    def near(camera: Sequence[float] | None) -> list[float] | None:
        if camera is None:
            return None
        return np.round([*(camera[:3] - centre), *camera[3:]], 5).tolist()

    for query in queries:
        query |= {"pose": near(query["pose"]), "truth": near(query["truth"])}
    return {
        # numbers that the page keeps as float32 would be metres off in UTM
        "points": _packed(points - centre, np.float32),
        "colours": _packed(colours, np.uint8),
        "map": [near(camera) for camera in shown],
        "queries": queries,
        "up": (up / (np.linalg.norm(up) or 1)).tolist(),
        "radius": float(radius) or 1.0,
    }


def _packed(array: np.ndarray, kind: type) -> str:
    """Return an array as base64 of its little-endian bytes."""
    return base64.b64encode(np.ascontiguousarray(array, np.dtype(kind)).tobytes()).decode()


def _axes(pose: pycolmap.Rigid3d) -> list[float]:
    """Return (centre, right, down, forward) of a camera in the world (12,)."""
    rotation = pose.rotation.matrix()
    return [*(-rotation.T @ pose.translation).tolist(), *rotation.ravel().tolist()]


def _points(run: Run, names: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 3) that some of the map images see and their colours (N, 3)."""
    chosen = [names[i] for i in np.linspace(0, len(names) - 1, SAMPLED_IMAGES).astype(int)]
    points, colours = [], []
    seen: set[int] = set()
    with open_h5(run.files["map_features"]) as file:
        for name in dict.fromkeys(chosen):
            keypoints, _ = get_keypoints(file, name)
            ids, xyz = run.reference.lift(name, np.arange(len(keypoints)))
            new = [row for row in np.flatnonzero(ids >= 0) if ids[row] not in seen]
            rows = np.array(new[:: max(1, -(-len(new) // (MAX_POINTS // SAMPLED_IMAGES)))], int)
            seen.update(ids[rows].tolist())
            points.append(xyz[rows])
            try:
                image = read_image(run.files["map_images"] / name)
            except InputError:  # a photo that was moved, for example
                colours.append(np.full((len(rows), 3), GREY))
                continue
            x, y = keypoints[rows].round().astype(int).T
            colours.append(image[y.clip(0, len(image) - 1), x.clip(0, image.shape[1] - 1)])
    return np.concatenate(points), np.concatenate(colours)
