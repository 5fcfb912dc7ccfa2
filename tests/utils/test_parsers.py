"""Lists of images, queries, pairs and poses."""

import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.utils import parsers
from hloc_reduce.utils.cli import InputError


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return tmp_path_factory.mktemp("parsers") / "list.txt"


def test_query_list(file):
    file.write_text(
        "# comment\n\nquery/a.jpg PINHOLE 640 480 500 501 320 240\n"
        "query/b.jpg SIMPLE_RADIAL 640 480 500 320 240 0.1\n"
    )
    (name, camera), (_, other) = parsers.parse_query_list(file)
    assert name == "query/a.jpg" and camera.params.tolist() == [500, 501, 320, 240]
    assert (camera.width, camera.height) == (640, 480)
    assert other.model == pycolmap.CameraModelId.SIMPLE_RADIAL


@pytest.mark.parametrize(
    "line",
    [
        "a.jpg",
        "a.jpg PINHOLE 640 480 500 501 320",
        "a.jpg PINHOLE 640 480 500 501 320 240 1",
        "a.jpg NOMODEL 640 480 500 501 320 240",
        "a.jpg PINHOLE wide 480 500 501 320 240",
        "a.jpg PINHOLE 640 480 500 501 320 nan",
        "a.jpg PINHOLE 0 480 500 501 320 240",
        "a.jpg PINHOLE 640 480 -500 501 320 240",
        "a.jpg PINHOLE -640 480 500 501 320 240",
    ],
)
def test_broken_query_line_is_named_with_its_number(file, line):
    file.write_text(f"ok.jpg PINHOLE 640 480 500 501 320 240\n\n{line}\n")
    with pytest.raises(InputError, match="list.txt:3: not a query"):
        parsers.parse_query_list(file)


def test_query_listed_twice_or_nowhere(tmp_path):
    line = "q.jpg PINHOLE 640 480 500 501 320 240\n"
    with pytest.raises(InputError, match="no query list"):
        parsers.parse_query_lists(tmp_path / "*.txt")
    (tmp_path / "day.txt").write_text(line)
    (tmp_path / "night.txt").write_text(line)
    with pytest.raises(InputError, match="night.txt: query q.jpg is in day.txt too"):
        parsers.parse_query_lists(tmp_path / "*.txt")
    (tmp_path / "night.txt").write_text(line + line)
    with pytest.raises(InputError, match="night.txt:2: query q.jpg is listed twice"):
        parsers.parse_query_list(tmp_path / "night.txt")
    (tmp_path / "night.txt").write_text("# nothing\n")
    with pytest.raises(InputError, match="lists no query"):
        parsers.parse_query_lists(tmp_path / "*.txt")


names = st.text(st.characters(categories=["L", "N"]), min_size=1).map(lambda name: f"db/{name}")


@given(st.lists(st.tuples(names, names)))
def test_pairs_round_trip(file, pairs):
    parsers.write_pairs(pairs, file)
    retrieval = parsers.parse_retrieval(file)
    expected = {}
    for name0, name1 in pairs:
        expected.setdefault(name0, []).append(name1)
    assert retrieval == expected


@pytest.mark.parametrize("name", ["a b.jpg", "a/b c/d e.jpg", "a\u00a0b.jpg"])
def test_names_with_spaces_are_between_tabs(file, name):
    pairs = [(name, "c.jpg"), ("c.jpg", name), (name, name), ("c.jpg", "d.jpg")]
    parsers.write_pairs(pairs, file)
    assert list(parsers.parse_pairs(file)) == pairs
    assert file.read_text(encoding="utf-8").splitlines()[-1] == "c.jpg d.jpg"  # as in hloc
    parsers.write_poses({name: pycolmap.Rigid3d(), "c.jpg": pycolmap.Rigid3d()}, file, None)
    assert list(parsers.parse_poses(file)) == [name, "c.jpg"]
    file.write_text(f"{name}\tPINHOLE 640 480 500 501 320 240\n", encoding="utf-8")
    ((found, camera),) = parsers.parse_query_list(file)
    assert found == name and camera.width == 640
    file.write_text(f"{name}\t\nc.jpg\n", encoding="utf-8")
    assert parsers.parse_image_list(file) == [name, "c.jpg"]
    file.write_text(f"{name} PINHOLE 640 480 500 501 320 240\n", encoding="utf-8")
    with pytest.raises(InputError, match="put a tab after a name that has spaces"):
        parsers.parse_query_list(file)


def test_columns_may_be_separated_by_tabs(file):
    file.write_text("a.jpg \tPINHOLE\t640\t480\t500 501\t320 240\n")
    assert parsers.parse_query_list(file)[0][0] == "a.jpg"
    file.write_text("a.jpg\tb.jpg\n")
    assert list(parsers.parse_pairs(file)) == [("a.jpg", "b.jpg")]


@given(st.integers(0, 2**32 - 1))
def test_poses_round_trip_by_base_name(file, seed):
    generator = np.random.default_rng(seed)
    rotation = Rotation.random(rng=generator).as_matrix()
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), generator.normal(size=3) * 100)
    parsers.write_poses({"query/day/a.jpg": pose}, file)
    ((name, read),) = parsers.parse_poses(file).items()
    assert name == "a.jpg" and max(pose_error(read, pose)) < 1e-6
    parsers.write_poses({"query/day/a.jpg": pose}, file, name_parts=2)
    assert list(parsers.parse_poses(file)) == ["day/a.jpg"]
