"""Text files of COLMAP models."""

import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pycolmap

from ..cli import InputError
from ..parsers import camera_of, not_text, wrong_line
from .records import PARTS, Camera, Frame, Image, Pose, Records, Rig, Sensor

CAMERA_LINE = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS..."
RIG_LINE = (
    "RIG_ID NUM_SENSORS REF_SENSOR_TYPE REF_SENSOR_ID (SENSOR_TYPE SENSOR_ID HAS_POSE POSE)..."
)
FRAME_LINE = "FRAME_ID RIG_ID QW QX QY QZ TX TY TZ NUM_DATA_IDS (SENSOR_TYPE SENSOR_ID DATA_ID)..."
IMAGE_LINE = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
KEYPOINTS_LINE = "X Y POINT3D_ID X Y POINT3D_ID ..."
POINT_LINE = "POINT3D_ID X Y Z R G B ERROR (IMAGE_ID POINT2D_IDX)..."

_MARK, _UTF16 = b"\xef\xbb\xbf", (b"\xff\xfe", b"\xfe\xff")  # byte order marks
TOO_SHORT = "it has too few words"
_SUSPICIOUS = b",;#nNeE\t"  # in lists of other things, and in numbers that may not be finite
_NOT_FINITE = {b"nan", b"-nan", b"inf", b"-inf"}
_POINT_TYPES = [int, *[float] * 3, *[int] * 3, float]  # of the first words of POINT
_REAL = rb" -?\d+(?:\.\d+)?(?:e-\d+)?"  # with another exponent it may be infinite
_REGULAR = re.compile(rb"\d+(?:%b){3}(?: \d+){3}%b(?: \d[ \d]*)?\r?\n?" % (_REAL, _REAL))
# how many of the first words have all whole numbers among them, None for all
_WHOLE = {"cameras": 4, "rigs": None, "frames": None}
_CHUNK = 2**22  # bytes
_LONG = 500  # bytes of a line that is no image but keypoints


class ImageLines(NamedTuple):
    """The lines of an image: its words with the rest of the line as the name, and its keypoints."""

    place: str
    words: list[bytes]
    keypoints: bytes
    num_points2D: int
    as_colmap: bool  # whether COLMAP reads them in the same way


def read(folder: Path) -> Records:
    """Read the records of a text model, and check the form of the lines of keypoints and points.

    Unlike COLMAP, this takes the rest of a line for the name of an image, ignores byte order marks,
    comments at the ends of lines and errors of points that are not numbers, takes whole numbers
    that are written as others (1.0), and needs neither lines of keypoints nor points3D.txt.

    Raises:
        InputError: naming the file and the line that is wrong.
    """
    as_colmap = not any(_has_mark(folder / f"{part}.txt") for part in PARTS)
    images = []
    for lines in _image_lines(folder / "images.txt"):
        images.append(_image(lines))
        as_colmap &= lines.as_colmap
    few: dict[str, list[tuple[str, list[bytes]]]] = {part: [] for part in _WHOLE}
    for part, found in few.items():
        for place, line in _lines(folder / f"{part}.txt"):
            found.append((place, _few(part, line)))
            as_colmap &= line == b" ".join(found[-1][1])
    cameras = [_camera(*line) for line in few["cameras"]]
    rigs = [_rig(*line) for line in few["rigs"]]
    frames = [_frame(*line) for line in few["frames"]]
    num_elements, regular = _check_points(folder / "points3D.txt")
    return Records(cameras, rigs, frames, images, num_elements, as_colmap and regular)


def rewrite(folder: Path, output: Path, with_tracks: bool) -> None:
    """Write a text model in a way that COLMAP reads, with the ids of images for their names."""
    for part in _WHOLE:
        if (folder / f"{part}.txt").is_file():
            with (output / f"{part}.txt").open("wb") as file:
                for _, line in _lines(folder / f"{part}.txt"):
                    file.write(b" ".join(_few(part, line)) + b"\n")
    kept = None if with_tracks else len(_POINT_TYPES)
    with (output / "points3D.txt").open("wb") as file:
        for place, line in _lines(folder / "points3D.txt"):
            file.write(b" ".join(_point(place, line)[:kept]) + b"\n")
    with (output / "images.txt").open("wb") as file:
        for _, words, keypoints, *_ in _image_lines(folder / "images.txt"):
            file.write(b" ".join([*words[:9], words[0]]) + b"\n")
            file.write(keypoints + b"\n")


def count_images(folder: Path) -> int:
    """Return the number of images of a text model."""
    return sum(1 for _ in _image_lines(folder / "images.txt"))


def explain(folder: Path) -> None:
    """Raise an InputError that names the line of points3D.txt that COLMAP cannot read, if any."""
    places: dict[int, str] = {}
    for place, line in _lines(folder / "points3D.txt"):
        point_id = int(_point(place, line)[0])
        if (first := places.setdefault(point_id, place)) != place:
            raise InputError(f"{place}: the id {point_id} is used twice, first at {first}.")


def wrong_keypoints(place: str) -> InputError:
    """Return the error for an image whose keypoints COLMAP reads only in part."""
    return _wrong(f"{place} or the line after it", "keypoints", KEYPOINTS_LINE, [])


def _has_mark(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_MARK)) == _MARK


def _numbered(path: Path) -> Iterator[tuple[str, bytes]]:
    """Yield the places and lines of a file, stripped, without a byte order mark.

    A file that is not there has none.
    """
    try:
        with path.open("rb") as file:
            for number, line in enumerate(file, 1):
                if number == 1 and line.startswith(_UTF16):
                    raise not_text(path, "Save it as UTF-8.")
                yield (
                    f"{path}:{number}",
                    (line.removeprefix(_MARK) if number == 1 else line).strip(),
                )
    except FileNotFoundError:
        return
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror}.") from None


def _lines(path: Path) -> Iterator[tuple[str, bytes]]:
    """Yield the places and lines of a file that are neither empty nor comments."""
    return ((place, line) for place, line in _numbered(path) if line and line[:1] != b"#")


def _words(line: bytes) -> list[bytes]:
    """Return the words of a line before a comment."""
    return re.split(rb"\s#", line, maxsplit=1)[0].split()


def _whole(word: bytes) -> bytes:
    """Return a whole number that is written as another, such as 1.0, as one; or another word."""
    try:
        number = float(word)
    except ValueError:
        return word
    is_whole = number.is_integer() and not word.lstrip(b"+-").isdigit() and b"_" not in word
    return b"%d" % number if is_whole else word


def _few(part: str, line: bytes) -> list[bytes]:
    """Return the words of a line that is neither of images nor of points, as COLMAP reads them."""
    words = _words(line)
    words[: _WHOLE[part]] = map(_whole, words[: _WHOLE[part]])
    return words


def _image_lines(path: Path) -> Iterator[ImageLines]:
    """Yield the lines of each image.

    COLMAP takes the line after that of an image for its keypoints, whatever it is.
    """
    image: ImageLines | None = None
    after: list[bytes] = []  # lines without words after that of the image
    for place, line in _numbered(path):
        if not line or line[:1] == b"#":
            after.append(line)
            continue
        no_keypoints = None
        if image is not None:
            try:
                number, keypoints = _keypoints(line)
                as_colmap = image.as_colmap and keypoints == line and not after
                yield image._replace(keypoints=keypoints, num_points2D=number, as_colmap=as_colmap)
                image = None
                continue
            except ValueError as error:
                no_keypoints = error
        following = _image_line(place, line, no_keypoints)
        if image is not None:
            yield image._replace(as_colmap=image.as_colmap and after[:1] == [b""])
        image, after = following, []
    if image is not None:
        yield image._replace(as_colmap=image.as_colmap and after[:1] == [b""])


def _keypoints(line: bytes) -> tuple[int, bytes]:
    """Check the keypoints in a line.

    Those that are not finite and show no point become 0 0: COLMAP 4 stops at them.

    Returns:
        Their number, and the line as COLMAP reads it.

    Raises:
        ValueError: with why the line is none of keypoints.
    """
    number, rest = divmod(line.count(b" ") + 1, 3)
    suspicious = rest or any(mark in line for mark in _SUSPICIOUS) or b"  " in line[:_LONG]
    if len(line) > _LONG and not suspicious and b"." not in b"".join(line.split(b" ")[2::3]):
        return number, line
    words = _words(line)
    number, rest = divmod(len(words), 3)
    if rest:
        raise ValueError("the number of its words is no multiple of 3")
    words[2::3] = map(_whole, words[2::3])
    if b"n" in line.lower():
        for i in range(0, 3 * number, 3):
            if words[i + 2] == b"-1" and _NOT_FINITE & {word.lower() for word in words[i : i + 2]}:
                words[i : i + 2] = b"0", b"0"
    _take(iter(words), *[float, float, int] * number)
    return number, b" ".join(words)


def _image_line(place: str, line: bytes, no_keypoints: ValueError | None) -> ImageLines:
    """Return the line of an image without its keypoints.

    Args:
        place: of the line.
        line: its words.
        no_keypoints: why it is no line of keypoints, where it may be one.
    """
    words = line.split(None, 9)
    try:
        words[:9:8] = map(_whole, words[:9:8])
        for kind, word in zip([int, *[float] * 7, int], [*words, *[b""] * 9], strict=False):
            _number(word, kind)
        if len(words) < 10:
            raise ValueError(TOO_SHORT)
    except ValueError as error:
        what, form, reason = "an image", IMAGE_LINE, error
        if no_keypoints is not None:
            what, form = (
                f"an image ({error}) nor its keypoints",
                f"{IMAGE_LINE}` or, after that, `{KEYPOINTS_LINE}",
            )
            reason = no_keypoints
        raise _wrong(place, what, form, words, reason) from None
    as_colmap = line == b" ".join(words) and words[9].split() == [words[9]]
    return ImageLines(place, words, b"", 0, as_colmap)


def _image(lines: ImageLines) -> Image:
    """Return the record of an image."""
    image_id, *pose, camera_id = lines.words[:9]
    try:
        name = lines.words[9].decode()
    except UnicodeDecodeError:
        shown = lines.words[9].decode(errors="replace")
        raise InputError(
            f"{lines.place}: the name {shown} is not in UTF-8. Save the file as UTF-8."
        ) from None
    numbers = tuple(map(float, pose))
    return Image(lines.place, int(image_id), numbers, int(camera_id), name, lines.num_points2D)


def _camera(place: str, words: list[bytes]) -> Camera:
    """Return the record of a camera."""
    try:
        camera_id = int(_number(words[0], int))
        for word in words[4:]:
            _number(word, float)
        camera = camera_of([word.decode(errors="replace") for word in words[1:]])
    except ValueError as error:
        raise _wrong(place, "a camera", CAMERA_LINE, words, error) from None
    return Camera(place, camera_id, camera)


def _rig(place: str, words: list[bytes]) -> Rig:
    """Return the record of a rig."""
    rest = iter(words)
    sensors: list[Sensor] = []
    poses: dict[Sensor, Pose] = {}
    try:
        rig_id, number = _take(rest, int, int)
        for i in range(number):
            sensors.append(_sensor(rest))
            if i and _take(rest, int) == [1]:
                poses[sensors[-1]] = tuple(_take(rest, *[float] * 7))
    except ValueError as error:
        raise _wrong(place, "a rig", RIG_LINE, words, error) from None
    return Rig(place, rig_id, sensors, poses)


def _frame(place: str, words: list[bytes]) -> Frame:
    """Return the record of a frame."""
    rest = iter(words)
    try:
        frame_id, rig_id, *pose, number = _take(rest, int, int, *[float] * 7, int)
        data = [(_sensor(rest), *_take(rest, int)) for _ in range(number)]
    except ValueError as error:
        raise _wrong(place, "a frame", FRAME_LINE, words, error) from None
    return Frame(place, frame_id, rig_id, tuple(pose), data)


def _sensor(words: Iterator[bytes]) -> Sensor:
    kinds = {name.encode(): int(kind) for name, kind in pycolmap.SensorType.__members__.items()}
    if (kind := next(words, b"")) not in kinds:
        raise ValueError(f"{kind[:30].decode(errors='replace')} is no type of a sensor")
    return kinds[kind], *_take(words, int)


def _take(words: Iterator[bytes], *kinds: Callable[[bytes], float]) -> list:
    """Take numbers of these types from words."""
    return [_number(next(words, b""), kind) for kind in kinds]


def _check_points(path: Path) -> tuple[int, bool]:
    """Check the form of the lines of points3D.txt.

    Returns:
        The number of elements of all tracks, and whether COLMAP reads the file.
    """
    if not path.is_file():
        return 0, False
    number: int | None = 0
    with path.open("rb") as file:
        while number is not None and (lines := file.readlines(_CHUNK)):
            found = _num_elements(lines)
            number = None if found is None else number + found
    if number is not None:
        return number, True
    first = len(_POINT_TYPES)
    return sum(len(_point(*line)) - first for line in _lines(path)) // 2, False


def _num_elements(lines: list[bytes]) -> int | None:
    """Return the number of elements of the tracks in lines of points.

    None if the lines are not as COLMAP writes them, judged by what is found fast.
    """
    lines = [line for line in lines if line[:1] != b"#"]
    spaces = [line.count(b" ") for line in lines]
    regular = (
        all(number % 2 for number in {*spaces})
        and all(map(_REGULAR.fullmatch, lines))
        and b"  " not in b"".join(lines)
    )
    return (sum(spaces) - 7 * len(lines)) // 2 if regular else None


def _point(place: str, line: bytes) -> list[bytes]:
    """Return the words of a point as COLMAP reads them, or raise an InputError if they are none.

    ERROR counts for nothing, and may be missing.
    """
    words = _words(line)
    given, first = words[:], len(_POINT_TYPES)
    words[:1], words[4:] = map(_whole, words[:1]), map(_whole, words[4:])
    try:
        if len(words) % 2:
            words.insert(first - 1, b"-1")
        words[first - 1 : first] = map(_error, words[first - 1 : first])
        _take(iter(words), *_POINT_TYPES, *[int] * max(0, len(words) - first))
    except ValueError as error:
        raise _wrong(place, "a point", POINT_LINE, given, error) from None
    return words


def _error(word: bytes) -> bytes:
    """Return ERROR, or -1, which is COLMAP's for an unknown one."""
    try:
        _number(word, float)
    except ValueError:
        return b"-1"
    return word


def _number(word: bytes, kind: Callable[[bytes], float]) -> float:
    """Convert a word to a finite number.

    Raises:
        ValueError: with what is wrong.
    """
    try:
        number = kind(word)
        if math.isfinite(number) and b"_" not in word:
            return number
    except (ValueError, OverflowError):
        pass
    if not word:
        raise ValueError(TOO_SHORT)
    what = "a whole number" if kind is int else "a finite number"
    raise ValueError(f"{word[:30].decode(errors='replace')} is not {what}")


def _wrong(place: str, what: str, form: str, words: list[bytes], error: object = "") -> InputError:
    """Return the error for a line that is not of the form."""
    separated = any(mark in word for word in words for mark in (b",", b";"))
    hint = "; put spaces between the words, and points into decimal numbers" * separated
    return wrong_line(place, what, form, str(error), hint)
