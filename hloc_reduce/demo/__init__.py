"""A small synthetic town in the layout of Aachen Day-Night v1.1.

Built-in demo and end-to-end test: map photos by day, queries by day and by night with their true
poses, and a reference model, all rendered from a seed.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from .. import logger
from ..utils.cli import InputError
from ..utils.progress import progress
from .cameras import DAY, MAP, NIGHT, Photo, list_photos
from .model import write_model
from .photo import take
from .render import rasterize
from .surface import View
from .town import build_town

VERSION = 1  # of the scene and of its photos; a data set of another version is not continued
IMAGES, MODEL = "images_upright", "3D-models/aachen_v_1_1"
LISTS = {
    DAY: "queries/day_time_queries_with_intrinsics.txt",
    NIGHT: "queries/night_time_queries_with_intrinsics.txt",
}
POSES = "queries/ground_truth_poses.txt"
MAX_WORKERS = 16  # each takes about half a gigabyte
DONE, PARTIAL = "town.json", "town.json.partial"


def main(dataset: Path, seed: int = 0, overwrite: bool = False) -> Path:
    """Render the town, unless it is already there; an interrupted run is continued.

    Args:
        dataset: folder of the data set, in the layout of Aachen Day-Night v1.1.
        seed: of everything random; the same seed gives the same files.
        overwrite: render a town again that is complete, or of another seed or version.

    Returns:
        ``dataset``.

    Raises:
        InputError: if the folder holds another data set, or a town of another seed or version
            and ``overwrite`` is not set.
    """
    dataset = Path(dataset)
    if not _start(dataset, {"seed": seed, "version": VERSION}, overwrite):
        return dataset
    photos = list_photos(seed)
    missing = [photo for photo in photos if not (dataset / IMAGES / photo.name).exists()]
    logger.info("Rendering %d photos of the demo town into %s", len(missing), dataset)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # before the fork: every process uses one core
    try:
        scene = build_town(seed)
        jobs = [(photo, dataset / IMAGES / photo.name, seed) for photo in missing]
        list(progress(_run(_render, jobs), "Rendering the town", "photo", len(jobs)))
        _write_lists(dataset, photos)
        map_photos = [photo for photo in photos if photo.kind == MAP]
        buffers = list(_run(_buffers, [(photo, seed) for photo in map_photos]))
        write_model(dataset / MODEL, scene, map_photos, buffers, seed)
    finally:
        cv2.setNumThreads(threads)
        build_town.cache_clear()
    os.replace(dataset / PARTIAL, dataset / DONE)
    return dataset


def _start(dataset: Path, state: dict[str, int], overwrite: bool) -> bool:
    """Mark the folder as the town of ``state``; False if that is there and complete."""
    done, partial = dataset / DONE, dataset / PARTIAL
    if done.exists():
        found = json.loads(done.read_text())
        if not overwrite:
            if found == state:
                return False
            raise InputError(
                f"{dataset} holds a demo town of {found}, not of {state}: "
                "choose another folder, or overwrite it"
            )
    elif partial.exists():
        found = json.loads(partial.read_text())
    elif any((dataset / name).exists() for name in (IMAGES, "3D-models", "queries")):
        raise InputError(f"{dataset} holds a data set that is not the demo town")
    else:
        found = state
    if overwrite or found != state:  # leftovers of another town must not be mixed in
        _write(partial, b"{}")  # whatever interrupts this, the next run starts from nothing
        done.unlink(missing_ok=True)
        for name in (IMAGES, "3D-models", "queries"):
            shutil.rmtree(dataset / name, ignore_errors=True)
    _write(partial, json.dumps(state).encode())
    return True


def _run(function: Callable, jobs: list[tuple]) -> Iterator:
    """Map over the jobs, in order, with one process per core."""
    workers = min(os.cpu_count() or 1, len(jobs), MAX_WORKERS)
    if workers <= 1:
        yield from map(function, jobs)
        return
    # A fork shares the town that is already built, and does not import the caller's script
    # again; elsewhere the processes build the town for themselves.
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    with ProcessPoolExecutor(workers, context, cv2.setNumThreads, (1,)) as pool:
        yield from pool.map(function, jobs)


def _render(job: tuple[Photo, Path, int]) -> None:
    photo, path, seed = job
    _write(path, take(build_town(seed), photo, seed))


def _buffers(job: tuple[Photo, int]) -> tuple[np.ndarray, np.ndarray]:
    photo, seed = job
    return rasterize(build_town(seed), View.of(photo.camera, photo.cam_from_world))


def _write(path: Path, content: bytes) -> None:
    """Write a file at once or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_bytes(content)
    os.replace(temporary, path)


def _write_lists(dataset: Path, photos: list[Photo]) -> None:
    """Write the lists of queries with their cameras, and the true poses."""
    poses = []
    lists = {kind: [] for kind in LISTS}
    for photo in photos:
        if photo.kind == MAP:
            continue
        camera, pose = photo.camera, photo.cam_from_world
        size_and_params = [camera.width, camera.height, *(float(p) for p in camera.params)]
        words = [photo.name, camera.model.name, *map(repr, size_and_params)]
        lists[photo.kind].append(" ".join(words))
        x, y, z, w = pose.rotation.quat
        numbers = (float(value) for value in (w, x, y, z, *pose.translation))
        poses.append(" ".join([photo.name, *map(repr, numbers)]))
    for kind, lines in lists.items():
        _write(dataset / LISTS[kind], "\n".join([*lines, ""]).encode())
    _write(dataset / POSES, "\n".join([*poses, ""]).encode())
