"""The reader of compact maps in C++ reads what Python's reads, and finds the same matches."""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from compact_files import LIES, change
from hostile import HARMFUL
from safetensors.numpy import load_file, save_file

from hloc_reduce.confs import features as features_confs
from hloc_reduce.hlm import signs, writer
from hloc_reduce.hlm.images import Images
from hloc_reduce.hlm.reader import CompactMap
from hloc_reduce.localization.intrinsics import MapCameras
from hloc_reduce.localization.query import correspondences
from hloc_reduce.maps import contents
from hloc_reduce.projections.files import WEIGHTS, split_prefix
from hloc_reduce.utils.codes import FLOATS, restore, store
from hloc_reduce.utils.parsers import CAMERA_MODELS

EXAMPLE = Path(__file__).parents[2] / "examples/cpp"
STRICT = ["-std=c++17", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Wpedantic", "-Werror"]
SANITIZED = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
FEATURE, WORDS = "colmap_sift_sv32", 3
PROJECTION = WEIGHTS / f"{FEATURE}.safetensors"
ALONE = [], [-1], [2, 3]  # what some images show: nothing, a point, two of the same descriptor

pytestmark = pytest.mark.check


def compiled(folder, source, *options):
    """Compile a program without a warning; return its path."""
    known = filter(None, [os.environ.get("CXX"), "c++", "g++", "clang++"])
    if (compiler := next(filter(shutil.which, known), None)) is None:
        pytest.skip("no C++ compiler is on this machine")
    path = folder / source.stem
    command = [compiler, *STRICT, *options, "-I", EXAMPLE, source, "-o", path]
    done = subprocess.run(command, capture_output=True, text=True)
    if re.search("cannot find.*san|unsupported option.*sanitize", done.stderr):
        pytest.skip(f"{compiler} has no sanitizers on this machine")
    assert done.returncode == 0 and not done.stderr, done.stderr
    return path


@pytest.fixture(scope="module")
def print_map(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cpp")
    return compiled(folder, Path(__file__).with_name("print_map.cpp"), "-O1")


def unit(rows):
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


class Random:
    """A map of random points, of which two always have the same descriptor."""

    def __init__(self, dim, images, points):
        self.generator = generator = np.random.default_rng(0)
        self.xyz_of = generator.uniform(-50, 500, (points, 3))
        self.described = unit(generator.standard_normal((points // 2, dim))).repeat(2, axis=0)
        shares = generator.choice([0.02, 0.1, 0.5, 0.9], images)
        self.shown = [np.flatnonzero(generator.random(points) < share) for share in shares]
        self.shown[3:6] = [np.arange(points)[rows] for rows in ALONE]
        self.vocabulary = generator.standard_normal((WORDS, dim), np.float32)
        self.global_descriptors = generator.standard_normal((images, WORDS * dim), np.float32)
        self.global_descriptors[11] = self.global_descriptors[10]

    def __len__(self):
        return len(self.xyz_of)

    def xyz(self, part):
        return self.xyz_of[part]

    def descriptors(self, part):
        return self.described[part]

    def visible(self, image):
        return self.shown[image]

    def images(self):
        """A camera of each model, and names that are longer or shorter than those before."""
        number, generator = len(self.shown), self.generator
        cameras = [
            pycolmap.Camera.create_from_model_id(1, getattr(pycolmap.CameraModelId, model), 9, 8, 7)
            for model in CAMERA_MODELS
            if model != "EQUIRECTANGULAR"  # whose photos have no place in a map
        ]
        return Images(
            sorted(f"day {i % 3}/ä/{i:0{i % 7 + 1}}.jpg" for i in range(number)),
            generator.standard_normal((number, 4)),
            generator.normal(0, 99, (number, 3)),
            cameras,
            np.arange(number) % len(cameras),
        )


def make(
    path,
    feature=FEATURE,
    storage="uint4",
    matcher="NN-ratio90",
    images=40,
    points=600,
    projection=None,
):
    """Write a map, and features of a photo, `photo.bin`; return these, local and global."""
    conf = {**features_confs.get(feature)[1], "storage": storage}
    if projection:
        conf["model"] = {**conf["model"], "projection": str(projection)}
    made = Random(int(re.findall(r"\d+", feature)[-1]), images, points)
    vocabulary = path.with_name("vocabulary.safetensors")
    save_file({"vocabulary": made.vocabulary}, vocabulary)
    source = writer.Source(
        model=pycolmap.Reconstruction(),
        feature=feature,
        conf=conf,
        matcher=matcher,
        global_descriptors=path,
        vocabulary=vocabulary,
        cameras=MapCameras({}, {(8, 7)}),
        doubts=['it is "random" \\ by chance: é'],
    )
    packed, _ = signs.pack(made.global_descriptors)
    size = made.global_descriptors.shape[1]
    with path.open("wb") as file:
        writer.write(file, made, made.images(), source, packed, size, 0.01)
    noise = made.generator.standard_normal((points // 4, made.described.shape[1])) / 12
    local = unit(made.described[: points // 4][::-1] + noise)
    local[2] = local[3]
    of_photo = made.global_descriptors[12] + 0.5 * made.global_descriptors[10]
    write_photo(path.with_name("photo.bin"), local, of_photo)
    return local, of_photo


def write_photo(path, local, of_photo):
    sizes = np.array([*local.shape, len(of_photo)], "<u4")
    path.write_bytes(sizes.tobytes() + local.tobytes() + of_photo.tobytes())


def run(program, projection, folder, files):
    """Return the line of output for each of the files in a folder."""
    command = [program, projection, "photo.bin", *files]
    done = subprocess.run(command, capture_output=True, cwd=folder)
    assert done.returncode == 0 and not done.stderr, done.stderr[-3000:].decode()
    lines = done.stdout.decode(errors="replace").split("\n")
    assert len(lines) == len(files) + 1
    return lines[:-1]


def matched(path, local, names):
    """Return what Python matches: keypoints, points and their coordinates."""
    opened = contents.read(path)
    kept = opened.storage if opened.storage in FLOATS else "float16"
    rounded = restore(*store({"descriptors": local.T}, kept)).T
    matches = opened.steps[0].match({"descriptors": rounded}, names)
    found, _ = correspondences(opened.reference, names, matches)
    return found["keypoints"], found["point3D_ids"], found["points3D"]


@pytest.mark.parametrize(
    "feature, storage, matcher",
    [
        (FEATURE, "uint4", "NN-ratio90"),
        (FEATURE, "uint2", "NN-mutual"),
        (FEATURE, "uint1", "NN-ratio95"),
        (FEATURE, "uint8", "NN-ratio"),
        (FEATURE, "float16", "NN-mutual"),
        (FEATURE, "float32", "NN-ratio85"),
        ("sift_nested@24", "uint4", "NN-ratio90"),
    ],
)
def test_everything_is_as_in_python(feature, storage, matcher, print_map, tmp_path):
    path = tmp_path / "place.hlm"
    local, of_photo = make(path, feature, storage, matcher)
    projection = WEIGHTS / f"{split_prefix(feature)[0]}.safetensors"
    found = json.loads(*run(print_map, projection, tmp_path, [path]))
    expected = CompactMap(path)
    names = [name for name, *_ in found["images"]]
    assert names == list(expected.names)
    for name, rotation, translation, *camera, shown in found["images"]:
        pose, known = expected.pose(name), expected.camera(name)
        np.testing.assert_allclose(rotation, pose.rotation.quat, atol=1e-12)
        np.testing.assert_allclose(translation, pose.translation, atol=1e-9)
        assert camera == [known.model.name, known.width, known.height, known.params.tolist()]
        assert shown == expected.visible(name).tolist()
    xyz = np.array(found["points"])
    np.testing.assert_allclose(xyz, expected.points.all(), atol=1e-12)
    described = np.array(found["descriptors"], np.float32).reshape(len(xyz), -1)
    its = expected.descriptors(np.arange(len(xyz)))
    assert np.abs(described - its).max() <= (1e-7 if storage == "uint8" else 0)

    images, similar = np.array(found["similar"]).T
    rows, similarity = expected.retrieve(of_photo, 30)
    assert images.tolist() == rows.tolist() and rows[0] == 12
    np.testing.assert_allclose(similar, similarity, atol=2e-6)

    keypoints, points, coordinates = matched(path, local, names)
    assert [match[:2] for match in found["matches"]] == np.stack([keypoints, points], 1).tolist()
    np.testing.assert_allclose([match[2] for match in found["matches"]], coordinates, atol=1e-12)
    assert len(keypoints) > 30


@pytest.mark.parametrize("number", [0, 1, 2])
def test_few_keypoints(number, print_map, tmp_path):
    path = tmp_path / "place.hlm"
    local, of_photo = make(path)
    write_photo(tmp_path / "photo.bin", local[:number], of_photo)
    [line] = run(print_map, PROJECTION, tmp_path, [path])
    found = [match[:2] for match in json.loads(line)["matches"]]
    keypoints, points, _ = matched(path, local[:number], list(CompactMap(path).names))
    assert found == np.stack([keypoints, points], axis=1).tolist() and bool(found) == (number > 0)


def test_similar_images_of_a_large_map(print_map, tmp_path, monkeypatch):
    """The best of those that seem best by some of the signs."""
    monkeypatch.setattr(signs, "FEW", 3)
    monkeypatch.setattr(signs, "COARSE", 2)
    path = tmp_path / "place.hlm"
    _, of_photo = make(path, images=900, points=60)
    [line] = run(print_map, PROJECTION, tmp_path, [path])
    found = [image for image, _ in json.loads(line)["similar"]]
    rows, similarity = CompactMap(path).retrieve(of_photo, 30)
    assert found == rows[np.isfinite(similarity)].tolist() and len(found) > 20
    monkeypatch.setattr(signs, "CANDIDATES", 900)
    assert found != CompactMap(path).retrieve(of_photo, 30)[0].tolist()  # many are not compared


@pytest.fixture(scope="module")
def sanitized(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sanitized")
    return compiled(folder, Path(__file__).with_name("print_map.cpp"), *SANITIZED)


@pytest.fixture
def small(tmp_path):
    """The file of a small map, with the levels of a projection of one's own."""
    path, own = tmp_path / "place.hlm", tmp_path / "own_sv32.safetensors"
    levels = load_file(PROJECTION)["levels.uint4"]
    save_file({"levels.uint4": levels}, own, {"layers": "[32]"})  # all that is read of it here
    make(path, images=18, points=16, projection=own)
    return path


def test_a_map_with_levels_needs_no_projection(sanitized, small):
    assert run(sanitized, "", small.parent, [small])[0].startswith("{")


def refusals(program, folder, contents_of_files):
    """Return what each content of a file is refused by, None for one that is read."""
    files = []
    for i, content in enumerate(contents_of_files):
        files.append(f"{i}.hlm")
        (folder / files[-1]).write_bytes(content)
    lines = run(program, "", folder, files)
    return [None if line.startswith("{") else line for line in lines]


def test_truncated_anywhere(sanitized, small):
    content = small.read_bytes()
    ends = {*range(20), *np.linspace(20, len(content) - 1, 300).astype(int).tolist()}
    found = refusals(sanitized, small.parent, (content[:end] for end in sorted(ends)))
    assert None not in found and len(set(found)) > 2


def test_damaged_anywhere(sanitized, small):
    """Bytes are replaced by others, or numbers, words and signs of the header by something."""
    content, generator = small.read_bytes(), np.random.default_rng(0)
    end, damaged = 8 + int.from_bytes(content[:8], "little"), []
    for begin in (0, end):
        for _ in range(300):
            damaged.append(bytearray(content))
            for place in generator.integers(begin, len(content), generator.integers(1, 5)):
                damaged[-1][place] = generator.integers(256)
    for found in re.finditer(rb"[\d.e+-]+|\w+|\W", content[8:end]):
        for value in generator.choice([*HARMFUL, "", "[" * 999], 1):
            first, last = (8 + place for place in found.span())
            header = content[8:first] + value.encode() + content[last:end]
            damaged.append(len(header).to_bytes(8, "little") + header + content[end:])
    outcomes = refusals(sanitized, small.parent, damaged)
    assert None in outcomes and any(outcomes)


MORE_LIES = [
    *LIES,
    ("coordinates", lambda a: a.reshape(1, -1), {}),
    ("descriptors", lambda a: a.astype(np.uint16), {}),
    ("levels", lambda a: a[:-1], {}),
    ("levels", lambda a: a * np.float16(np.nan), {}),
    ("levels", lambda a: a[:, :-1], {}),
    (None, None, {"points": 2**53}),
    (None, None, {"points": 0}),
    (None, None, {"points": 16.5}),
    (None, None, {"step": 1e308}),
    (None, None, {"storage": "uint8"}),
    (None, None, {"storage": "uint8", "scale": [1e308, 0]}),
    (None, None, {"storage": "float32"}),
    (None, None, {"matcher": "none\n"}),
]


def test_lies(sanitized, small):
    """Each is refused."""
    content, lying = small.read_bytes(), []
    for name, value, metadata in MORE_LIES:
        small.write_bytes(content)
        change(small, name, value, **metadata)
        lying.append(small.read_bytes())
    found = refusals(sanitized, small.parent, lying)
    assert [lie for lie, line in zip(MORE_LIES, found, strict=True) if line is None] == []


def test_lies_of_floats_and_of_large_maps(sanitized, tmp_path, monkeypatch):
    monkeypatch.setattr(signs, "FEW", 3)
    path, lying = tmp_path / "place.hlm", []
    make(path, storage="float32", images=18, points=16)
    content = path.read_bytes()
    for name, value in (
        ("descriptors", lambda a: a * np.float32(np.nan)),
        ("descriptors", lambda a: a * np.float32(2)),
        ("descriptors", lambda a: a * np.float32(1e30)),
        ("coarse", lambda a: a[:, 1:]),
        ("coarse", lambda a: np.concatenate([a, a])),
        ("coarse", lambda a: a.ravel()),
    ):
        path.write_bytes(content)
        change(path, name, value)
        lying.append(path.read_bytes())
    assert None not in refusals(sanitized, tmp_path, lying)
    assert refusals(sanitized, tmp_path, [content]) == [None]


def test_what_cannot_be_read_is_named(print_map, tmp_path):
    older = Path(__file__).with_name("version2_deltas.hlm")
    path = tmp_path / "place.hlm"
    make(path)
    lines = run(print_map, "", tmp_path, [older, path, tmp_path, "none.hlm"])
    assert lines[0].startswith("its version is 2. Renew it by python -m pipelines.localize --map")
    assert (
        lines[1:]
        == [f"it needs the file of its projection, {FEATURE}.safetensors"]
        + ["the file cannot be read"] * 2
    )
    missing = tmp_path / PROJECTION.name
    assert run(print_map, missing, tmp_path, [path]) == [f"{missing}: the file cannot be read"]
    make(path, matcher="lightglue")
    other = WEIGHTS / "colmap_sift_sv64.safetensors"
    assert run(print_map, other, tmp_path, [path]) == lines[1:2]
    assert run(print_map, PROJECTION, tmp_path, [path]) == [
        "its matcher, lightglue, is not in this reader"
    ]


def test_the_example(tmp_path):
    """It is built by CMake, or else by the compiler, and prints the matches."""
    if shutil.which("cmake"):
        for options in (["-S", EXAMPLE, "-B", tmp_path], ["--build", tmp_path]):
            subprocess.run(["cmake", *options], check=True, capture_output=True)
        program = tmp_path / "hlm_match"
    else:
        program = compiled(tmp_path, EXAMPLE / "hlm_match.cpp")
    path = tmp_path / "place.hlm"
    local, of_photo = make(path)
    command = [program, path, tmp_path / "photo.bin", PROJECTION]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    similar, matches = done.stdout.split("keypoint point x y z\n")
    expected = CompactMap(path)
    rows = expected.retrieve(of_photo, 50)[0]
    names = [expected.names[row] for row in rows if expected.num_keypoints(expected.names[row])]
    assert [line.split(maxsplit=1)[1] for line in similar.splitlines()] == names
    found = np.array([line.split() for line in matches.splitlines()], float)
    keypoints, points, xyz = matched(path, local, names)
    np.testing.assert_array_equal(found[:, :2], np.stack([keypoints, points], axis=1))
    np.testing.assert_allclose(found[:, 2:], xyz, rtol=1e-8)
    failed = subprocess.run(command[:3], capture_output=True, text=True)
    assert failed.returncode == 1 and failed.stderr.startswith(f"{path}: it needs")
