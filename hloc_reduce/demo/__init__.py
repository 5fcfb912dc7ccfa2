"""A small synthetic town in the layout of Aachen Day-Night v1.1.

Built-in demo and end-to-end test: map photos by day, queries by day and by night with their true
poses, and a reference model, all rendered from a seed.
"""

import multiprocessing
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import cv2

from .. import logger
from ..datasets.aachen import MODEL_FOLDER
from ..runtime import provenance
from ..utils.cli import InputError
from ..utils.files import replacing
from ..utils.parsers import to_line, write_poses
from ..utils.progress import progress
from .cameras import DAY, MAP, NIGHT, WALK, Photo, list_photos
from .model import Buffers, write_model
from .photo import take
from .render import rasterize
from .surface import View
from .town import build_town

TOWN_VERSION = 1  # of the scene and its photos; a town of another version is not resumed
IMAGE_FOLDER, QUERY_FOLDER = "images_upright", "queries"
FOLDERS = (IMAGE_FOLDER, "3D-models", QUERY_FOLDER)
MAX_WORKERS = 16  # each takes about half a gigabyte
DONE, PARTIAL = "town.json", "town.json.partial"


def main(
    dataset: Path, seed: int = 0, overwrite: bool = False, num_photos: int | None = None
) -> Path:
    """Render the town, unless it is complete; resume an interrupted run.

    Args:
        dataset: folder of the data set, in the layout of Aachen Day-Night v1.1.
        seed: of everything random; the same seed gives the same files.
        overwrite: render again a town that is complete, or of another seed, version or number.
        num_photos: number of map photos, with one query by day and one by night for each eight,
            but at least ten of each; default: 32. 400 photos take about 2 GB of memory.

    Returns:
        `dataset`.

    Raises:
        InputError: if the folder holds another data set, or a town of another seed,
            version or number and `overwrite` is not set, or the number is too small.
    """
    dataset = Path(dataset)
    num_photos = len(WALK) if num_photos is None else num_photos
    if num_photos < len(WALK):
        raise InputError(f"The demo town has at least {len(WALK)} photos, not {num_photos}.")
    state = {"seed": seed, "version": TOWN_VERSION}
    if num_photos > len(WALK):
        state["photos"] = num_photos
    if not _start(dataset, state, overwrite):
        return dataset
    photos = list_photos(seed, num_photos)
    missing = [photo for photo in photos if not (dataset / IMAGE_FOLDER / photo.name).exists()]
    logger.info("Rendering %d photos of the demo town into %s", len(missing), dataset)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # before the fork: every process uses one core
    try:
        scene = build_town(seed)
        rendered = _run(partial(_render, seed, dataset / IMAGE_FOLDER), missing)
        list(progress(rendered, "Rendering the town", "photo", len(missing)))
        _write_lists(dataset / QUERY_FOLDER, photos)
        map_photos = [photo for photo in photos if photo.kind == MAP]
        buffers = list(_run(partial(_rasterize, seed), map_photos))
        write_model(dataset / MODEL_FOLDER, scene, map_photos, buffers, seed)
    finally:
        cv2.setNumThreads(threads)
        build_town.cache_clear()
    os.replace(dataset / PARTIAL, dataset / DONE)
    return dataset


def _start(dataset: Path, state: dict[str, int], overwrite: bool) -> bool:
    """Mark the folder as the town of `state`; return False if it holds that town, complete."""
    done, partial = dataset / DONE, dataset / PARTIAL
    if done.exists() and not overwrite:
        found = provenance.read(done)
        if found == state:
            return False
        raise InputError(
            f"{dataset} holds a demo town of {found}, not of {state}: choose another folder, or "
            "overwrite it."
        )
    is_town = done.exists() or partial.exists()
    if not is_town and any((dataset / name).exists() for name in FOLDERS):
        raise InputError(f"{dataset} holds a data set that is not the demo town.")
    if overwrite or provenance.read(partial) != state:  # never mix photos of two towns
        provenance.write(partial, {})  # if this is interrupted, the next run deletes the rest
        done.unlink(missing_ok=True)
        for name in FOLDERS:
            shutil.rmtree(dataset / name, ignore_errors=True)
        provenance.write(partial, state)
    return True


def _run(function: Callable, photos: list[Photo]) -> Iterator:
    """Map a function over photos, in order, with one process per core."""
    workers = min(os.cpu_count() or 1, len(photos), MAX_WORKERS)
    if workers <= 1:
        yield from map(function, photos)
        return
    # A fork shares the town that is already built, and does not import the caller's script
    # again; elsewhere the processes build the town for themselves.
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    with ProcessPoolExecutor(workers, context, cv2.setNumThreads, (1,)) as pool:
        yield from pool.map(function, photos)


def _render(seed: int, images: Path, photo: Photo) -> None:
    with replacing(images / photo.name) as temporary:
        temporary.write_bytes(take(build_town(seed), photo, seed))


def _rasterize(seed: int, photo: Photo) -> Buffers:
    return rasterize(build_town(seed), View.of(photo.camera, photo.cam_from_world))


def _write_lists(folder: Path, photos: list[Photo]) -> None:
    """Write the query lists with intrinsics, and the true poses."""
    for kind, time in ((DAY, "day"), (NIGHT, "night")):
        cameras = {photo.name: photo.camera for photo in photos if photo.kind == kind}
        lines = [
            to_line(name, camera.model.name, camera.width, camera.height, *camera.params.tolist())
            for name, camera in cameras.items()
        ]
        with replacing(folder / f"{time}_time_queries_with_intrinsics.txt") as temporary:
            temporary.write_text("".join(lines))
    poses = {photo.name: photo.cam_from_world for photo in photos if photo.kind != MAP}
    write_poses(poses, folder / "ground_truth_poses.txt", name_parts=None)
