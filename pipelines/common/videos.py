"""Videos instead of folders of photos: their frames are written into the outputs folder."""

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hloc_reduce import frames_from_video, maps
from hloc_reduce.runtime import provenance
from hloc_reduce.runtime.outputs import Lock
from hloc_reduce.runtime.provenance import MADE_FROM
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.images import VIDEO_SUFFIXES
from hloc_reduce.utils.videos import is_video

from .queries import NOT_IN_NAMES

# what a map of a video has unless other options are given
OF_VIDEO = {"camera_mode": "single", "pairs": "sequential"}


def check(given: Mapping[str, Any]) -> None:
    """Raise an InputError for files that are no videos, and options that are not for videos."""
    for option in ("map_images", "query_images"):
        path = given[option]
        if path is not None and path.is_file() and not is_video(path):
            suffixes = ", ".join(sorted(VIDEO_SUFFIXES))
            raise InputError(f"{path} is neither a folder of photos nor a video ({suffixes}).")
    added = given["add_images"]
    if added is not None and is_video(added):
        raise InputError(
            f"--add_images {added} is a video: write its frames into a folder, and add that: "
            f"python -m hloc_reduce.frames_from_video --video {added} --output FOLDER"
        )
    video, queries = given["map_images"], given["query_images"]
    source = next((name for name in ("model_or_map", "database") if given[name]), None)
    if video is not None and is_video(video) and source:
        option = "map" if source == "model_or_map" else source
        raise InputError(
            f"{video} is a video, of which a map is built without --{option}: give the folder of "
            f"the photos of --{option}, or leave it out."
        )
    if given["fps"] is not None and (queries is None or not is_video(queries)):
        raise InputError("--fps is for a video of queries: give it by --query_images.")


def as_folders(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return options with folders of frames in place of videos, and the defaults of their maps.

    Raises:
        InputError: if a video cannot be used.
    """
    found, outputs, overwrite = dict(given), given["outputs"], given["overwrite"]
    map_images, query_images = given["map_images"], given["query_images"]
    if map_images is not None and is_video(map_images):
        frames = _folder(map_images, outputs / "map_images")
        is_built = maps.is_map(outputs / "map") and frames.exists()
        if is_built and not overwrite and not frames_from_video.is_current(map_images, frames):
            raise InputError(
                f"{map_images} has changed since the map in {outputs} was built of it: choose "
                "other --outputs, or --overwrite."
            )
        found["map_images"] = _frames(map_images, frames, overwrite)
        found |= {key: given[key] or value for key, value in OF_VIDEO.items()}
        if given.get("panoramas"):  # their views have cameras of their own
            found["camera_mode"] = given["camera_mode"]
    if query_images is not None and is_video(query_images):
        frames = _folder(query_images, outputs / "query_images", given["fps"])
        found["query_images"] = _frames(query_images, frames, overwrite, given["fps"])
    return found


def _folder(video: Path, parent: Path, fps: float | None = None) -> Path:
    """Return the folder for the frames of a video, which has its name.

    If another video of that name has it, a digest of the path is appended to the name.
    """
    name = video.stem if fps is None else f"{video.stem}-{fps:g}fps"
    name = re.sub(NOT_IN_NAMES, "_", name).replace(".", "_").strip("_-") or "video"
    path = str(video.resolve())
    if provenance.read(parent / name / MADE_FROM).get("path", path) != path:
        name = f"{name}-{hashlib.sha256(path.encode()).hexdigest()[:8]}"
    return parent / name


def _frames(video: Path, folder: Path, overwrite: bool, fps: float | None = None) -> Path:
    """Write the frames of a video into a folder, and return that."""
    with Lock(folder.parent):
        return frames_from_video.main(video, folder, fps, overwrite)
