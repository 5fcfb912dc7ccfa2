"""Write the sharp frames of a video into a folder, named by their time stamps in seconds."""

import uuid
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, NamedTuple

import cv2
import numpy as np

from . import logger
from .runtime import provenance
from .runtime.provenance import MADE_FROM
from .utils import cli, options, videos
from .utils.cli import InputError, make_folder
from .utils.files import delete
from .utils.paths import strings_as_paths
from .utils.time_stamps import name_of
from .utils.videos import Frame

JPEG_QUALITY = 95
SIDE = 640  # pixels of the longer side, at which frames are compared
# A frame is chosen when the image has moved by NEAR to FAR since the one chosen before, as a share
# of its longer side. FAR is less than twice NEAR: frames after the sharpest one stay near to it.
NEAR, FAR = 0.06, 0.11
MIN_TRACKED = 0.4  # of the corners of the frame chosen before: with fewer the image has moved far
MAX_CORNERS, CORNER_QUALITY, CORNER_DISTANCE = 300, 0.01, 8  # of goodFeaturesToTrack
# The sharpest of at most WINDOW frames is chosen, but none that is less sharp than MIN_SHARPNESS
# times the median of the last NEIGHBOURS ones: motion blur loses corners, which looks like motion.
WINDOW, NEIGHBOURS, MIN_SHARPNESS = 30, 61, 0.5
# Defocused and dark frames have fewer FAST corners
FAST_THRESHOLD, MIN_FAST_CORNERS = 10, 30
CHOICE = {  # what the provenance of frames says
    "moved": [NEAR, FAR, MIN_TRACKED, SIDE],
    "sharp": [WINDOW, NEIGHBOURS, MIN_SHARPNESS, FAST_THRESHOLD, MIN_FAST_CORNERS],
}


@strings_as_paths
def main(
    video: Path,
    output: Path,
    fps: Annotated[float, options.ABOVE_0] | None = None,
    overwrite: bool = False,
) -> Path:
    """Write frames of a video as JPEG files, unless they were written before.

    By default a new frame is chosen whenever the camera has moved: the sharpest of those that still
    overlap the frame chosen before by about nine tenths.

    Args:
        video: the file, of a format that OpenCV decodes.
        output: new folder of the frames. Frames of a video that has changed are replaced.
        fps: number of frames per second at a steady rate, sharp or not; default: only sharp frames,
            when the camera has moved.
        overwrite: write the frames again.

    Returns:
        `output`.

    Raises:
        InputError: if the video cannot be decoded, or has one frame or no sharp one, or the folder
            has other files.
    """
    if not video.is_file():
        raise InputError(f"There is no file {video}.")
    before = provenance.read(output / MADE_FROM)
    is_free = not output.exists() or (output.is_dir() and not any(output.iterdir()))
    if "choice" not in before and not is_free:
        raise InputError(f"{output} exists and has no frames of a video: choose another folder.")
    made_from = _made_from(video, fps, before)
    if overwrite or not _is_same(made_from, before):
        _replace(video, output, fps, made_from)
    elif before != made_from:
        provenance.write(output / MADE_FROM, made_from)
    return output


def is_current(video: Path, output: Path, fps: float | None = None) -> bool:
    """Tell whether a folder has the frames of a video, as it is now."""
    before = provenance.read(output / MADE_FROM)
    return _is_same(_made_from(video, fps, before), before)


def _made_from(video: Path, fps: float | None, before: dict) -> dict:
    """Return the provenance of frames of a video, given an earlier one."""
    [(_, known)] = provenance.fingerprints({"video": video}, before).items()
    choice = {"fps": fps} if fps else CHOICE
    return {"path": str(video.resolve()), "video": known, "choice": choice}


def _is_same(made_from: dict, before: dict) -> bool:
    """Tell whether frames of two provenances are the same, wherever the video is."""
    same_video = before.get("video", [])[2:] == made_from["video"][2:]
    return same_video and before.get("choice") == made_from["choice"]


def _replace(video: Path, output: Path, fps: float | None, made_from: dict) -> None:
    """Write the frames of a video, in place of earlier ones."""
    make_folder(output.parent)
    for left in output.parent.glob(f".{output.name}.*.tmp"):  # of a killed run
        delete(left)
    temporary = output.with_name(f".{output.name}.{uuid.uuid4().hex[:8]}.tmp")
    temporary.mkdir()
    try:
        frames = videos.read(video)
        number = 0
        for frame in steady(frames, fps) if fps else sharp(frames):
            encoded = cv2.imencode(".jpg", frame.pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            (temporary / name_of(frame.seconds)).write_bytes(encoded[1].tobytes())
            number += 1
        if not number:
            raise InputError(
                f"{video} has no sharp frame: all are dark, blurred or without texture. Record it "
                "in more light, with slower movements."
            )
        provenance.write(temporary / MADE_FROM, made_from)
        delete(output)
        temporary.rename(output)
    finally:
        delete(temporary)
    logger.info("Wrote %d frames of %s to %s.", number, video, output)


def steady(frames: Iterable[Frame], fps: float) -> Iterator[Frame]:
    """Yield frames at a steady rate, or all if there are fewer.

    Args:
        frames: of a video.
        fps: frames per second.
    """
    last, begin = -1, None
    for frame in frames:
        begin = frame.seconds if begin is None else begin
        # time stamps are often rounded to milliseconds
        if (tick := int((frame.seconds - begin + 5e-4) * fps)) > last:
            yield frame
            last = tick


def sharp(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Yield sharp frames between which the image has moved.

    Args:
        frames: of a video.
    """
    tracks: Tracks | None = None
    near = 0.0  # the first one is chosen from the beginning on
    recent = deque[float](maxlen=NEIGHBOURS)
    best: Candidate | None = None
    later: list[np.ndarray] = []  # frames after the best one, small and grey
    waited = 0
    for frame in frames:
        grey = _small(frame.pixels)
        now = Candidate(frame, grey, float(cv2.Laplacian(grey, cv2.CV_32F).var()))
        recent.append(now.sharpness)
        tracks = tracks or Tracks(grey)
        moved = tracks.follow(grey)
        if best is not None:
            later, waited = [*later, grey], waited + 1
            if moved >= FAR or waited >= WINDOW:
                yield best.frame
                tracks, near, best = Tracks(best.grey), NEAR, None
                moved = [tracks.follow(grey) for grey in later][-1]
        if moved < near or now.sharpness < MIN_SHARPNESS * np.median(recent):
            continue
        if (best is None or now.sharpness > best.sharpness) and _has_detail(grey):
            waited = 0 if best is None else waited
            best, later = now, []
    if best is not None:
        yield best.frame


class Candidate(NamedTuple):
    """A frame that may be chosen.

    Args:
        frame: itself.
        grey: its pixels (H, W) uint8, small.
        sharpness: the variance of their Laplacian.
    """

    frame: Frame
    grey: np.ndarray
    sharpness: float


class Tracks:
    """Corners of a frame, followed through the frames after it.

    Args:
        grey: (H, W) uint8.
    """

    def __init__(self, grey: np.ndarray):
        found = cv2.goodFeaturesToTrack(grey, MAX_CORNERS, CORNER_QUALITY, CORNER_DISTANCE)
        self._begin = np.zeros((0, 1, 2), np.float32) if found is None else found
        self._now, self._grey, self._number = self._begin, grey, len(self._begin)

    def follow(self, grey: np.ndarray) -> float:
        """Return how far the corners have moved, as a share of the longer side.

        Args:
            grey: the next frame, (H, W) uint8.

        Returns:
            The median, infinite if too few corners are left.
        """
        if len(self._now):
            now, found, _ = cv2.calcOpticalFlowPyrLK(self._grey, grey, self._now, self._now.copy())
            inside = ((now >= 0) & (now < grey.shape[::-1])).all(axis=(1, 2))
            kept = inside & found.ravel().astype(bool)
            self._begin, self._now = self._begin[kept], now[kept]
        self._grey = grey
        if len(self._now) <= MIN_TRACKED * self._number:
            return np.inf
        distances = np.linalg.norm(self._now - self._begin, axis=2)
        return float(np.median(distances)) / max(grey.shape)


def _small(pixels: np.ndarray) -> np.ndarray:
    """Return a frame (H, W, 3) in grey, of at most `SIDE` pixels."""
    grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    scale = SIDE / max(grey.shape)
    if scale >= 1:
        return grey
    return cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _has_detail(grey: np.ndarray) -> bool:
    """Tell whether a frame has enough corners to be matched."""
    detector = cv2.FastFeatureDetector.create(FAST_THRESHOLD)
    return len(detector.detect(grey)) >= MIN_FAST_CORNERS


def _main() -> None:
    options.call(main, __doc__, "--video walk.mp4 --output photos")


if __name__ == "__main__":
    cli.run(_main)
