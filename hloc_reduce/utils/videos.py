"""Videos: their frames with time stamps."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from .. import logger
from .cli import InputError
from .images import VIDEO_SUFFIXES
from .progress import progress

# FFmpeg prints a line for each damaged frame; what the user needs to know is logged here
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
DEFAULT_RATE = 30.0  # frames per second of a video that does not tell
MIN_SHARE = 0.9  # of the frames that a file announces: with fewer it is truncated


class Frame(NamedTuple):
    """A frame of a video.

    Args:
        seconds: its time stamp, from the beginning of the video.
        pixels: (H, W, 3) BGR uint8, upright.
    """

    seconds: float
    pixels: np.ndarray


def is_video(path: Path) -> bool:
    """Tell from its name whether a file is a video: FFmpeg reads text files as videos, too."""
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.is_dir()


def read(video: Path) -> Iterator[Frame]:
    """Yield the frames of a video and show the progress.

    Raises:
        InputError: if there is no such file, it cannot be decoded, or it has only one frame.
    """
    if not video.is_file():
        raise InputError(f"There is no file {video}.")
    capture = cv2.VideoCapture(str(video))
    try:
        announced = max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))
        interval = 1 / (capture.get(cv2.CAP_PROP_FPS) or DEFAULT_RATE)
        number, seconds = 0, -interval
        with progress(None, f"Reading {video.name}", "frame", announced or None) as shown:
            while (found := capture.read())[0]:
                told = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
                seconds = told if told > seconds else seconds + interval
                yield Frame(seconds, found[1])
                number += 1
                shown.update()
    finally:
        capture.release()
    if not number:
        raise InputError(
            f"{video} cannot be decoded: it is not a video, truncated, or has an unknown codec. "
            f"Convert it, for example with: ffmpeg -i {video.name} -c:v libx264 converted.mp4"
        )
    if number == 1:
        raise InputError(f"{video} has only one frame: give it as a photo in a folder.")
    if number < MIN_SHARE * announced:
        logger.warning(
            "Only %d of %d frames of %s could be decoded: it may be truncated.",
            number,
            announced,
            video,
        )
