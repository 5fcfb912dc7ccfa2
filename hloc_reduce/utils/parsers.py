"""Text files in hloc's formats: image lists, query lists with intrinsics, pairs, poses; and YAML.

The words of a line are separated by spaces, as in hloc. If a name itself contains spaces, which
hloc's lists cannot represent, a tab follows each name of its line.
"""

import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np
import pycolmap
import yaml

from .cli import InputError, choose, some
from .files import replacing

CAMERA_MODELS = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
_ENDS = r"\t\n\v\f\r\x1c-\x1f\x85\u2028\u2029"  # ends of lines and of names
_LETTER = rf"[^{_ENDS}/\0\ud800-\udfff]"
_PART = rf"(?!\.\.?(?:/|$))(?!\s){_LETTER}+(?<!\s)"  # not . or ..
# lines of the lists that users write
IMAGE_LINE = "name"
QUERY_LINE = "name MODEL width height params..."
PAIR_LINE = "name0 name1"
POSE_LINE = "name qw qx qy qz tx ty tz"
_NUMBER = re.compile(r"[-+]?\d+\.\d+(e[-+]?\d+)?")
_NAME = re.compile(rf"(?!#){_PART}(?:/{_PART})*")


def check_names(names: list[str], place: Path | str) -> list[str]:
    """Return image names, paths relative to a folder, if they are valid.

    Args:
        names: from a list, a model, a folder or an h5 file.
        place: where they come from, for the message.

    Raises:
        InputError: for an invalid name, such as an absolute path.
    """
    wrong = [name for name in names if not _NAME.fullmatch(name)]
    if wrong:
        raise InputError(
            f"{place}: {some(map(repr, wrong), 3)} cannot be names of images: a name is a relative "
            "path in UTF-8 that does not begin with # or a space, does not end with a space, and "
            "has no tabs and no part . or .. in it. Rename them."
        )
    return names


def _lines(path: Path, form: str) -> Iterator[tuple[str, list[str]]]:
    """Yield ("file:number", words) for every line that is neither empty nor a comment.

    The words in `form` that begin with "name" stand for image names.
    """
    names = form.count("name")
    try:
        with path.open(encoding="utf-8-sig") as file:  # Windows may add a byte order mark
            for number, line in enumerate(file, 1):
                words = _words(line, names)
                if words and not words[0].startswith("#"):
                    place = f"{path}:{number}"
                    check_names(words[:names], place)
                    yield place, words
    except UnicodeDecodeError:
        raise not_text(path, f"A list has lines `{form}`; save it as UTF-8.") from None
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror}.") from None


def not_text(path: Path, expected: str) -> InputError:
    """Return the error for a file that is not UTF-8; `expected` says what it should contain."""
    data, line = path.read_bytes(), 1
    try:
        data.decode()
    except UnicodeDecodeError as error:
        line += data.count(b"\n", 0, error.start)
    return InputError(f"{path}:{line}: not text in UTF-8. {expected}")


def wrong_line(place: str, what: str, form: str, reason: str = "", hint: str = "") -> InputError:
    """Return the error for a line that is not of the form."""
    said = f" ({reason})" if reason else ""
    return InputError(f"{place}: not {what}{said}. A line must look like `{form}`{hint}.")


def _words(line: str, names: int) -> list[str]:
    """Split a line that begins with `names` image names."""
    # lists of other programs may mix spaces and tabs
    after = line.partition("\t")[0].split()[1:]
    if "\t" not in line or any(map(_is_value, after)):
        return line.split()
    *first, rest = line.strip().split("\t", names)
    if len(first) < names:
        return [word.strip() for word in (*first, rest)]
    return [word.strip() for word in first] + rest.split()


def _is_value(word: str) -> bool:
    """Tell whether a word is a camera model or a number, so not part of a name."""
    return word in CAMERA_MODELS or _NUMBER.fullmatch(word) is not None


def to_line(*words: object, names: int = 1) -> str:
    """Join words to a line of a list; the first `names` words are image names."""
    named, rest = list(map(str, words[:names])), list(map(str, words[names:]))
    if any(name.split() != [name] for name in named):
        return "\t".join([*named, *[" ".join(rest)] * bool(rest)]) + "\n"
    return " ".join([*named, *rest]) + "\n"


def read_yaml(path: Path) -> object:
    """Read a YAML file of plain values.

    Raises:
        InputError: when it is missing or broken.
    """
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except UnicodeDecodeError:
        raise not_text(path, "A YAML file is expected.") from None
    except Exception as error:  # yaml raises many types for broken values
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise InputError(f"{path} cannot be read ({reason}).") from None


def parse_image_list(path: Path) -> list[str]:
    """Read image names, the first word of every line."""
    return [words[0] for _, words in _lines(path, IMAGE_LINE)]


def image_names(images: Path | str | Iterable[str]) -> list[str]:
    """Return the image names in a list file, given by its path, or in any other iterable.

    Raises:
        InputError: when there is none.
    """
    if isinstance(images, (Path, str)):
        names = parse_image_list(Path(images))
    else:
        names = check_names(list(images), "The list of images")
    if not names:
        raise InputError(f"There is no image in the list {images}.")
    return names


def parse_query_list(path: Path) -> list[tuple[str, pycolmap.Camera]]:
    """Read queries with intrinsics, one `name MODEL width height params...` a line.

    Raises:
        InputError: for a broken line, with file and line number, a name that is listed twice, an
            empty list, or COLMAP's cameras.txt.
    """
    queries: dict[str, pycolmap.Camera] = {}
    for place, (name, *words) in _lines(path, QUERY_LINE):
        try:
            camera = parse_camera(words)
        except ValueError as error:
            # a name with spaces, or commas between the words, leave no model behind the name
            spaced = not any(word in CAMERA_MODELS for word in words[:1])
            hint = "; put spaces between the words, and put a tab after a name that has spaces"
            raise wrong_line(place, "a query", QUERY_LINE, str(error), hint * spaced) from None
        if name in queries:
            raise InputError(f"{place}: query {name} is listed twice.")
        queries[name] = camera
    if not queries:
        raise InputError(f"{path} lists no query.")
    if all(name.isdecimal() for name in queries):
        raise InputError(
            f"{path} lists cameras by their numbers, as COLMAP's cameras.txt does, and no images. "
            f"A query list has lines `{QUERY_LINE}`, one for each photo."
        )
    return list(queries.items())


def parse_camera(words: list[str]) -> pycolmap.Camera:
    """Return the camera of the words `MODEL width height params...`.

    Raises:
        ValueError: with what is wrong.
    """
    camera = camera_of(words)
    check_camera(camera)
    return camera


def camera_of(words: list[str]) -> pycolmap.Camera:
    """Return the camera of the words `MODEL width height params...`, whatever their values.

    Raises:
        ValueError: when they are not of this form.
    """
    if len(words) < 3:
        raise ValueError("it has no camera model, width and height")
    model, *sizes = words[:3]
    try:
        choose("camera model", model, CAMERA_MODELS)
    except InputError as error:
        raise ValueError(str(error).rstrip(".")) from None
    camera = pycolmap.Camera(model=model)
    try:
        camera.width, camera.height = map(int, sizes)
    except (ValueError, TypeError):  # a TypeError if it is not of 64 bits
        raise ValueError(f"{' '.join(sizes)} are not a width and a height in pixels") from None
    try:
        camera.params = list(map(float, words[3:]))
    except ValueError:
        raise ValueError("its parameters are not all numbers") from None
    if not camera.verify_params():
        raise ValueError(f"the parameters of {model} are {camera.params_info}")
    return camera


def check_camera(camera: pycolmap.Camera) -> None:
    """Check that a camera has focal lengths, these and sizes are positive, all parameters finite.

    Raises:
        ValueError: otherwise.
    """
    focal_lengths = camera.params[camera.focal_length_idxs()]
    if not len(focal_lengths):  # COLMAP crashes when it is asked for one
        raise ValueError(
            f"{camera.model.name} has no focal length: render perspective views of panoramas"
        )
    smallest = min(camera.width, camera.height, *focal_lengths)
    if not (np.isfinite(camera.params).all() and smallest > 0):
        raise ValueError("sizes and focal lengths are positive and finite")


def parse_query_lists(paths: Path) -> dict[str, list[tuple[str, pycolmap.Camera]]]:
    """Read all query lists that match a glob, for example `queries/*_with_intrinsics.txt`.

    Returns:
        The queries of each list by its stem, in the order of the file names.

    Raises:
        InputError: when no file matches or a name is listed twice.
    """
    files = sorted(paths.parent.glob(paths.name))
    if not files:
        raise InputError(f"There is no query list {paths}.")
    lists = {path.stem: parse_query_list(path) for path in files}
    of_list: dict[str, str] = {}
    for path in files:
        for name, _ in lists[path.stem]:
            if name in of_list:
                raise InputError(f"{path}: query {name} is in {of_list[name]} too.")
            of_list[name] = path.name
    return lists


def parse_pairs(path: Path) -> Iterator[tuple[str, str]]:
    """Yield pairs, one `name0 name1` a line, without reading the whole list."""
    for place, words in _lines(path, PAIR_LINE):
        if len(words) != 2:
            hint = "; put a tab between names that have spaces"
            raise wrong_line(place, "a pair", PAIR_LINE, hint=hint)
        yield words[0], words[1]


def parse_retrieval(path: Path) -> dict[str, list[str]]:
    """Read pairs, one `name0 name1` a line, as name0 -> [name1, ...] in the order of the file."""
    retrieval: dict[str, list[str]] = {}
    for name0, name1 in parse_pairs(path):
        retrieval.setdefault(name0, []).append(sys.intern(name1))
    return retrieval


def write_pairs(pairs: Iterable[tuple[str, str]], path: Path) -> int:
    """Write pairs, one `name0 name1` a line, as they are drawn, and return their number."""
    number = 0
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        for name0, name1 in pairs:
            file.write(to_line(name0, name1, names=2))
            number += 1
    return number


def write_pairs_of(names: Iterable[str], pairs: Path, suffix: str) -> Path:
    """Write the pairs of some queries beside all pairs, and return the file."""
    path, retrieved = pairs.with_name(f"{pairs.stem}-{suffix}.txt"), parse_retrieval(pairs)
    write_pairs([(name, other) for name in names for other in retrieved[name]], path)
    return path


def parse_poses(path: Path) -> dict[str, pycolmap.Rigid3d]:
    """Read poses, one `name qw qx qy qz tx ty tz` (camera from world, metres) a line.

    Raises:
        InputError: for a broken line, or a name that is listed twice.
    """
    poses = {}
    for place, (name, *values) in _lines(path, POSE_LINE):
        if name in poses:
            raise InputError(
                f"{place}: {name} is listed twice: full names are needed, as in the "
                "*_logs.jsonl of a pipeline."
            )
        try:
            qw, qx, qy, qz, *translation = map(float, values)
            quaternion = np.array([qx, qy, qz, qw])
            norm = np.linalg.norm(quaternion)
            if not (np.isfinite(translation).all() and 1e-9 < norm < 1e9):
                raise ValueError
            rotation = pycolmap.Rotation3d(quaternion / norm)
            poses[name] = pycolmap.Rigid3d(rotation, np.array(translation).reshape(3))
        except ValueError:
            raise wrong_line(place, "a pose", POSE_LINE) from None
    return poses


def write_poses(
    poses: Mapping[str, pycolmap.Rigid3d], path: Path, name_parts: int | None = 1
) -> None:
    """Write poses (camera from world) in the submission format of visuallocalization.net.

    Args:
        poses: by image name.
        path: the text file, one `name qw qx qy qz tx ty tz` a line.
        name_parts: parts of the names that are written: 1 for `basename`, 2 for `folder/basename`
            (RobotCar's format), None for all.
    """
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        for name, pose in poses.items():
            written = name if name_parts is None else "/".join(name.split("/")[-name_parts:])
            x, y, z, w = pose.rotation.quat
            numbers = (repr(float(value)) for value in (w, x, y, z, *pose.translation))
            file.write(to_line(written, *numbers))
