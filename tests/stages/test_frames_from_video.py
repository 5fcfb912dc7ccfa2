"""Which frames of a video are chosen, and videos that cannot be used."""

import os

import cv2
import numpy as np
import pytest
from command import refused, state
from command import run as run_command

from hloc_reduce import frames_from_video
from hloc_reduce.utils import videos
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.time_stamps import time_stamps
from hloc_reduce.utils.videos import Frame

SIZE = (320, 240)


@pytest.fixture
def shots(textured):
    """Returns views of a texture that is moved to the left by pixels."""
    wide = cv2.cvtColor(np.hstack([textured, textured[:, ::-1]] * 2), cv2.COLOR_GRAY2BGR)

    def take(shifts):
        return [np.ascontiguousarray(wide[:, shift : shift + SIZE[0]]) for shift in shifts]

    return take


def encode(path, pictures, fps=25.0):
    """Write a video."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), fps, SIZE)
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return path


def blurred(picture):
    return cv2.blur(picture, (15, 15))


def chosen(pictures):
    """Return the numbers of the frames that are chosen."""
    frames = [Frame(float(number), picture) for number, picture in enumerate(pictures)]
    return [round(frame.seconds) for frame in frames_from_video.sharp(frames)]


def test_frames_overlap_those_chosen_before(shots):
    """By nine tenths, however fast the camera moves, or as far as one frame does."""
    for step in (1, 4, 50):
        shifts = np.array(range(0, 600, step))
        moved = np.diff(shifts[chosen(shots(shifts))]) / SIZE[0]
        assert len(moved) > 9
        assert (moved >= frames_from_video.NEAR - 0.01).all()
        assert (moved <= max(frames_from_video.FAR, step / SIZE[0]) + 0.01).all()


def test_a_camera_that_stands_still_gives_one_frame(shots):
    assert len(chosen(shots([0] * 90))) == 1
    there_and_back = [*range(0, 200, 5), *range(200, 0, -5)]
    assert len(chosen(shots([0] * 50 + there_and_back + [0] * 50))) > 10


def test_the_sharpest_frames_are_chosen(shots):
    """Four of five are blurred by motion."""
    pictures = shots(range(0, 600, 4))
    pictures = [p if i % 5 == 2 else blurred(p) for i, p in enumerate(pictures)]
    found = chosen(pictures)
    assert len(found) > 10 and all(number % 5 == 2 for number in found)


def test_a_blurred_part_is_left_out(shots):
    """Although blur loses tracks; frames after it are chosen."""
    pictures = shots(range(0, 600, 4))
    pictures[60:80] = map(blurred, pictures[60:80])
    found = chosen(pictures)
    assert not {*range(60, 80)} & {*found}
    assert any(number < 60 for number in found) and any(number >= 80 for number in found)


def test_dark_frames_before_others(shots):
    pictures = [np.zeros((240, 320, 3), np.uint8)] * 40 + shots(range(0, 100, 4))
    assert chosen(pictures)[0] >= 40


def test_frames_at_a_steady_rate(shots):
    def times(fps, rate):
        frames = [Frame(1 + round(i / rate, 3), None) for i in range(61)]
        return [frame.seconds - 1 for frame in frames_from_video.steady(frames, fps)]

    assert times(2, 30) == pytest.approx([0, 0.5, 1, 1.5, 2])
    assert times(10, 30) == pytest.approx(np.arange(21) / 10, abs=1e-3)
    assert len(times(30, 30)) == len(times(99, 30)) == 61


def test_frames_are_written_once(shots, tmp_path, monkeypatch):
    video = encode(tmp_path / "walk.avi", shots(range(0, 200, 4)))
    output = frames_from_video.main(str(video), tmp_path / "frames")
    names = sorted(path.name for path in output.glob("*.jpg"))
    stamps = time_stamps(names)
    assert len(names) > 3 and all(0 <= float(s) < 2 for s in stamps.values())
    first = cv2.imread(str(output / names[0]))
    number = round(float(stamps[names[0]]) * 25)
    assert abs(first.astype(int) - shots([4 * number])[0]).mean() < 3
    written = state(output)
    os.utime(video, (1, 1))  # copied: its content counts
    read = videos.read
    monkeypatch.setattr(videos, "read", None)
    frames_from_video.main(video, output)
    monkeypatch.setattr(videos, "read", read)
    jpeg = {path: at for path, at in written.items() if path.suffix == ".jpg"}
    assert jpeg.items() <= state(output).items()
    steady = frames_from_video.main(video, output, fps=5)
    assert len([*steady.glob("*.jpg")]) == 10
    encode(video, shots(range(0, 100, 4)))
    frames_from_video.main(video, output)
    names = {path.name for path in output.glob("*.jpg")}
    assert names and max(map(float, time_stamps(names).values())) < 1


def test_a_killed_run_leaves_no_frames(shots, tmp_path, monkeypatch):
    video, output = encode(tmp_path / "walk.avi", shots(range(0, 200, 4))), tmp_path / "frames"
    left = tmp_path / ".frames.0.tmp"
    left.mkdir()

    def interrupted(frames):
        yield next(iter(frames))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(frames_from_video, "sharp", interrupted)
        frames_from_video.main(video, output)
    assert [path.name for path in tmp_path.iterdir()] == [video.name]
    frames_from_video.main(video, output)
    assert {path.name for path in tmp_path.iterdir()} == {video.name, "frames"}


def test_videos_that_cannot_be_used(shots, tmp_path, caplog):
    output = tmp_path / "frames"
    text = tmp_path / "text.mp4"
    text.write_text("no video")
    grey = [np.full((240, 320, 3), 128, np.uint8)] * 40
    black = [np.zeros((240, 320, 3), np.uint8)] * 40
    soft = [cv2.blur(picture, (61, 61)) for picture in shots(range(0, 160, 4))]
    for video, message in (
        (text, "text.mp4 cannot be decoded: it is not a video"),
        (tmp_path / "none.mp4", "There is no file .*none.mp4"),
        (encode(tmp_path / "one.avi", shots([0])), "one.avi has only one frame"),
        (encode(tmp_path / "grey.avi", grey), "grey.avi has no sharp frame: all are dark"),
        (encode(tmp_path / "black.avi", black), "black.avi has no sharp frame"),
        (encode(tmp_path / "soft.avi", soft), "soft.avi has no sharp frame"),
    ):
        with pytest.raises(InputError, match=message):
            frames_from_video.main(video, output)
        assert not output.exists()
    whole = encode(tmp_path / "whole.avi", shots(range(0, 200, 4))).read_bytes()
    (tmp_path / "cut.avi").write_bytes(whole[: len(whole) // 2])
    frames_from_video.main(tmp_path / "cut.avi", output)
    assert "of 50 frames" in caplog.text and "it may be truncated" in caplog.text


def test_wrong_options(shots, tmp_path, monkeypatch, caplog):
    video = encode(tmp_path / "walk.avi", shots(range(0, 200, 4)))
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "mine.jpg").write_bytes(b"")
    (photos / "made_from.json").write_text('{"map": "of others"}')
    given = ("--video", video, "--output")
    message = refused(monkeypatch, caplog, frames_from_video, *given, photos)
    assert f"{photos} exists and has no frames of a video" in message
    assert (photos / "mine.jpg").exists()
    message = refused(monkeypatch, caplog, frames_from_video, *given, video, "--fps", 0)
    assert "--fps 0: it must be above 0" in message
    run_command(monkeypatch, frames_from_video, *given, tmp_path / "new", "--fps", "2")
    assert len([*(tmp_path / "new").glob("*.jpg")]) == 4
