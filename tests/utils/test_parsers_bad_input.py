"""Hostile lists are read or refused, and any name survives a round trip."""

import os
import subprocess
import sys

import numpy as np
import pycolmap
import pytest
from hostile import check_text, fuzzed
from hypothesis import given
from hypothesis import strategies as st

from hloc_reduce.localization import intrinsics
from hloc_reduce.utils import parsers
from hloc_reduce.utils.cli import InputError


def read_poses(path):
    for pose in parsers.parse_poses(path).values():
        rotation = pose.rotation.matrix()
        assert np.isfinite(pose.matrix()).all()
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)


def read_queries(path):
    for _, camera in parsers.parse_query_list(path):
        assert np.isfinite(camera.params).all() and camera.width > 0


# what is read: the lines of a sound file, and the parser of its path
TEXTS = {
    "images": (["db/a.jpg", "db/b.jpg 1 2"], parsers.parse_image_list),
    "queries": (
        ["a.jpg PINHOLE 640 480 500 501 320 240", "b.jpg SIMPLE_RADIAL 640 480 500 320 240 0.1"],
        read_queries,
    ),
    "pairs": (["a.jpg b.jpg", "a.jpg c.jpg"], lambda path: list(parsers.parse_pairs(path))),
    "retrieval": (["a.jpg b.jpg", "a.jpg c.jpg"], parsers.parse_retrieval),
    "poses": (["a.jpg 1 0 0 0 1 2 3", "b.jpg 0.6 0.8 0 0 -1 2e3 .5"], read_poses),
}


@pytest.mark.parametrize("kind", TEXTS)
def test_text_files_are_read_or_refused(kind, tmp_path):
    check_text(tmp_path / "l.txt", *TEXTS[kind])


# what is no list of queries -> what the message says; it also shows a line
PANORAMA = "EQUIRECTANGULAR"
NO_QUERIES = {
    "b.jpg,PINHOLE,640,480,500,501,320,240": "2: not a query (it has no camera model",
    "b.jpg, PINHOLE, 640, 480, 500, 501, 320, 240": "2: not a query (Unknown camera model 'PINHOLE",
    "b.jpg PINHOLE 640.5 480 500 501 320 240": "(640.5 480 are not a width and a height in pixels)",
    "b.jpg PINHOLE 640 480 500 501 320 2x": "(its parameters are not all numbers)",
    "b.jpg PINHOLE 640 480 500 501 320": "(the parameters of PINHOLE are fx, fy, cx, cy)",
    b"\xff\xd8\xff\xe0": "2: not text in UTF-8",
    "\n2 PINHOLE 640 480 500 501 320 240": "COLMAP's cameras.txt",
}


@pytest.mark.parametrize("line", NO_QUERIES)
def test_other_files_are_no_lists_of_queries(line, tmp_path):
    path, words = tmp_path / "l.txt", NO_QUERIES[line]
    first = b"1 PINHOLE 640 480 500 501 320 240\n"
    path.write_bytes(first + (line if isinstance(line, bytes) else line.encode()))
    with pytest.raises(InputError) as error:
        parsers.parse_query_list(path)
    message = str(error.value)
    assert str(path) in message and words in message and f"`{parsers.QUERY_LINE}`" in message


@pytest.mark.fault(7)
@pytest.mark.skipif(PANORAMA not in parsers.CAMERA_MODELS, reason="this COLMAP has no panoramas")
def test_panoramas_are_refused_as_queries(tmp_path):
    """COLMAP crashes when it is asked for their focal length."""
    path = tmp_path / "l.txt"
    path.write_text(f"pano.jpg {PANORAMA} 64 32 64 32\n")
    with pytest.raises(InputError, match=f"l.txt:1: not a query .{PANORAMA} has no focal length"):
        parsers.parse_query_list(path)


@pytest.mark.parametrize("kind", TEXTS)
def test_photos_and_folders_are_no_lists(kind, tmp_path):
    _, read = TEXTS[kind]
    path = tmp_path / "photo.jpg"
    path.write_bytes(b"a.jpg\n\xff\xd8\xff\xe0\x00\x10JFIF")
    with pytest.raises(InputError, match="photo.jpg:2: not text in UTF-8. A list has lines `name"):
        read(path)
    with pytest.raises(InputError, match=f"Cannot read {tmp_path}: Is a directory."):
        read(tmp_path)


@pytest.mark.parametrize("kind", ["images", "queries", "pairs", "poses"])
def test_a_mark_of_byte_order_is_no_part_of_a_name(kind, tmp_path):
    lines, read = TEXTS[kind]
    path = tmp_path / "l.txt"
    found = []
    for encoding in ("utf-8", "utf-8-sig"):
        path.write_text("\n".join(lines), encoding=encoding)
        found.append(read(path))
    assert found[0] == found[1]


letters = st.text(st.characters(exclude_categories=["C", "Z"], exclude_characters="/"), min_size=1)


some_names = st.lists(
    st.lists(letters, min_size=1, max_size=3)
    .map("/".join)
    .filter(lambda name: parsers._NAME.fullmatch(name)),
    min_size=1,
    max_size=5,
    unique=True,
)


@fuzzed
@given(names=some_names)
def test_names_of_lists_round_trip(tmp_path, names):
    path = tmp_path / "list.txt"
    path.write_text("\n".join(names), encoding="utf-8")
    assert parsers.parse_image_list(path) == names
    pairs = [(name, other) for name in names for other in names]
    assert parsers.write_pairs(pairs, path) == len(pairs)
    assert list(parsers.parse_pairs(path)) == pairs
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([1.0, -2e-9, 3e9]))
    parsers.write_poses(dict.fromkeys(names, pose), path, name_parts=None)
    read = parsers.parse_poses(path)
    assert list(read) == names
    assert all((found.translation == pose.translation).all() for found in read.values())


@fuzzed
@given(
    name=some_names.map(min).filter(lambda name: not name.isdecimal()),
    model=st.sampled_from(sorted({*parsers.CAMERA_MODELS} - {PANORAMA})),
    size=st.tuples(st.integers(1, 10**6), st.integers(1, 10**6)),
    seed=st.integers(0, 2**32 - 1),
)
def test_queries_round_trip(tmp_path, name, model, size, seed):
    path = tmp_path / "queries.txt"
    kind = getattr(pycolmap.CameraModelId, model)
    new = hasattr(pycolmap.Camera, "create_from_model_id")  # pycolmap 4
    make = pycolmap.Camera.create_from_model_id if new else pycolmap.Camera.create
    camera = make(1, kind, 500.0, *size)
    camera.params = camera.params * np.random.default_rng(seed).uniform(0.5, 2, len(camera.params))
    intrinsics.write_queries({name: (camera, "guess")}, path)
    ((read_name, read),) = parsers.parse_query_list(path)
    assert read_name == name and read.model == camera.model
    assert (read.width, read.height) == size and (read.params == camera.params).all()


def test_lists_are_utf8_whatever_the_locale(tmp_path):
    code = (
        "import sys; from pathlib import Path; from pycolmap import Camera, Rigid3d; "
        "from hloc_reduce.localization import intrinsics; "
        "from hloc_reduce.utils import files, parsers; "
        "name = '\\xe9\\u6771.jpg'; "
        "folder = Path(sys.argv[1]); "
        "camera = Camera(model='SIMPLE_PINHOLE', width=9, height=9, params=[9, 4, 4]); "
        "parsers.write_poses({name: Rigid3d()}, folder / 'poses.txt'); "
        "intrinsics.write_queries({name: (camera, 'list')}, folder / 'queries.txt'); "
        "files.write_csv([{'query': name}], folder / 'queries.csv')"
    )
    environment = {**os.environ, "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "LC_ALL": "C"}
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], env=environment, check=True)
    assert list(parsers.parse_poses(tmp_path / "poses.txt")) == ["\xe9\u6771.jpg"]
    assert parsers.parse_query_list(tmp_path / "queries.txt")[0][0] == "\xe9\u6771.jpg"
    assert (tmp_path / "queries.csv").read_text(encoding="utf-8").split()[1] == "\xe9\u6771.jpg"
