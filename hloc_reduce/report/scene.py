"""The map in 3D with its cameras and those of the queries, for the page to turn."""

import base64

import numpy as np
import pycolmap

from .. import localization
from ..io import get_keypoints, open_h5, read_image
from .runs import Run

POINTS = 6000  # shown, at most
IMAGES = 24  # map images that give points their colours
CAMERAS = 1000  # map cameras shown, at most


def scene(run: Run) -> dict:
    """Return what the page shows of a run: see `_packed` for arrays.

    `points` (N, 3) float32 in metres, `colours` (N, 3) uint8; cameras as (centre, right, down,
    forward) float32 in `map`, (C, 12); `queries`, each with its name, status, camera `pose` and,
    where it is known, `truth`; `up` and the `centre` and `radius` of what is worth seeing.
    """
    points, colours = _points(run)
    model = run.reconstruction
    poses = [] if model is None else [i.cam_from_world() for i in model.images.values()]
    poses = poses[:: -(-len(poses) // CAMERAS) or 1]
    queries = []
    for name, record in run.records.items():
        pose = localization.pose(record)
        queries.append(
            {
                "name": name,
                "status": run.rows[name]["status"],
                "pose": None if pose is None else _axes(pose),
                "truth": _axes(run.truth[name]) if name in run.truth else None,
            }
        )
    shown = np.array(
        [_axes(pose) for pose in poses]
        + [query["truth"] or query["pose"] for query in queries if query["truth"] or query["pose"]]
    ).reshape(-1, 12)
    # points and cameras alike, without what is far from all others
    groups = [part for part in (points, shown[:, :3]) if len(part)]
    centre = np.mean([np.median(part, axis=0) for part in groups], axis=0)
    radius = max(np.quantile(np.linalg.norm(part - centre, axis=1), 0.9) for part in groups)
    up = -shown[:, 6:9].mean(axis=0) if len(shown) else np.array([0.0, -1, 0])
    return {
        "points": _packed(points, np.float32),
        "colours": _packed(colours, np.uint8),
        "map": [_axes(pose) for pose in poses],
        "queries": queries,
        "up": (up / (np.linalg.norm(up) or 1)).tolist(),
        "centre": centre.tolist(),
        "radius": float(radius) or 1.0,
    }


def _packed(array: np.ndarray, kind: type) -> str:
    """Return an array as base64 of its little-endian bytes."""
    return base64.b64encode(np.ascontiguousarray(array, np.dtype(kind)).tobytes()).decode()


def _axes(pose: pycolmap.Rigid3d) -> list[float]:
    """Return the centre of a camera and its axes right, down and forward, in the world."""
    rotation = pose.rotation.matrix()
    values = [*(-rotation.T @ pose.translation), *rotation.ravel()]
    return [round(float(value), 5) for value in values]


def _points(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Return points of the map (N, 3) and their colours, from images spread over the map."""
    with open_h5(run.files["map_features"]) as file:
        used = {record["db"] for record in run.records.values()} - {None}
        model = run.reconstruction
        names = sorted(used if model is None else {i.name for i in model.images.values()})
        chosen = [names[i] for i in np.linspace(0, len(names) - 1, IMAGES).astype(int)]
        points, colours, seen = [], [], set()
        for name in dict.fromkeys(chosen):
            keypoints, _ = get_keypoints(file, name)
            ids, xyz = run.reference.lift(name, np.arange(len(keypoints)))
            rows = [row for row in np.flatnonzero(ids >= 0) if ids[row] not in seen]
            rows = np.array(rows[:: -(-len(rows) // (POINTS // IMAGES)) or 1], int)
            seen.update(ids[rows].tolist())
            image = read_image(run.files["map_images"] / name)
            x, y = keypoints[rows].round().astype(int).T
            points.append(xyz[rows])
            colours.append(image[y.clip(0, len(image) - 1), x.clip(0, image.shape[1] - 1)])
    return np.concatenate(points), np.concatenate(colours)
