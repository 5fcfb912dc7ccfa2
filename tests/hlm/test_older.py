"""Compact maps of earlier versions; a reader as their format was documented tells what is in them.

The files were written by the version before, of the map of the plane.
"""

import shutil
from pathlib import Path

import numpy as np
import pytest
from compact_files import change, check_flipped_bits, read, read_coordinates, unpacked, use

from hloc_reduce import Localizer, maps
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.hlm.reader import CompactMap
from hloc_reduce.utils.cli import InputError
from pipelines import localize

PIPELINE = localize
FILES = [Path(__file__).parent / f"version2_{kind}.hlm" for kind in ("bitmaps", "deltas")]


def read_visible(metadata, tensors):
    """Yield the points of each image."""
    counts, packed = tensors["num_visible"], tensors["visible"]
    if metadata["visible"] == "bitmaps":
        for row in unpacked(packed.reshape(len(counts), -1), metadata["points"]):
            yield np.flatnonzero(row)
        return
    values = iter(packed.tolist())
    for count in counts:
        found, point = [], -1
        for _ in range(count):
            value, shift = 128, 0
            while value >= 128:
                value = next(values)
                point += (value & 127) << shift
                shift += 7
            found.append(point)
        yield np.array(found, int)


def read_descriptors(metadata, tensors):
    """Return the descriptors (P, D), and the norms of what codes stand for."""
    stored, storage = tensors["descriptors"], metadata["storage"]
    if storage.startswith("float"):
        return stored.T.astype(np.float32), None
    if storage == "uint8":
        scale, offset = metadata["scale"]
        found = stored.T * np.float32(scale) + np.float32(offset)
    else:
        levels, size = tensors["levels"].astype(np.float32), int(storage.removeprefix("uint"))
        bit = size * np.arange(len(levels))
        codes = stored[bit // 8] >> (bit % 8)[:, None] & 2**size - 1
        found = np.take_along_axis(levels, codes, axis=1).T
    norms = np.linalg.norm(found, axis=1, keepdims=True)
    return found / norms, None if storage == "uint8" else norms


@pytest.fixture(params=FILES, ids=lambda path: path.stem)
def file(request, tmp_path):
    """A file that may be changed."""
    return Path(shutil.copy(request.param, tmp_path))


def test_what_is_in_them(file):
    metadata, tensors = read(file)
    found = use(file).reference
    names = tensors["names"].tobytes().decode().split("\n")
    assert list(found.names) == names and metadata["version"] == 2
    np.testing.assert_allclose(read_coordinates(metadata, tensors), found.points.all(), atol=1e-12)
    for row, (name, points) in enumerate(zip(names, read_visible(metadata, tensors), strict=True)):
        np.testing.assert_array_equal(found.visible(name), points)
        pose, quaternion = found.pose(name), tensors["rotations"][row].astype(float)
        quaternion /= np.linalg.norm(quaternion)
        assert abs(pose.rotation.quat @ quaternion) == pytest.approx(1, abs=1e-12)
        np.testing.assert_allclose(pose.translation, tensors["translations"][row], atol=1e-7)
        model, width, height, *params = metadata["cameras"][tensors["camera_of_image"][row]]
        camera = found.camera(name)
        assert (camera.model.name, camera.width, camera.height) == (model, width, height)
        np.testing.assert_allclose(camera.params, params, rtol=1e-7)
    described = found.descriptors(np.arange(metadata["points"]))
    np.testing.assert_allclose(described, read_descriptors(metadata, tensors)[0], atol=1e-6)
    signs = unpacked(tensors["retrieval"], metadata["signs"])
    for row in range(len(names)):
        descriptor = found.global_descriptors()[row]
        assert found.retrieve(descriptor, 1)[0] == [row] and signs[row].any()


def test_they_localize(file, place, build_map):
    """Where the map that they were made from does."""
    photo = place[1] / "query/day/a.png"
    expected, _ = Localizer(build_map("--feature", "colmap_sift_sv32")).localize(photo)
    pose, info = Localizer(file).localize(photo)
    assert info["reason"] is None and max(pose_error(pose, expected)) < 0.1
    assert Localizer(file).cameras == maps.unpack(file, file.parent / "map").cameras


def test_files_of_the_first_version(file):
    """All their coordinates have the same number of bits."""
    expected, bits = CompactMap(file).points.all(), 12
    step = float(np.ptp(expected, axis=0).max()) / (2**bits - 1)
    least = expected.min(axis=0)
    whole = np.rint((expected - least) / step).astype(int)
    packed = np.packbits(whole[..., None] >> np.arange(bits) & 1, bitorder="little")
    changed = {"version": 1, "bits": bits, "step": step, "least": least.tolist()}
    change(file, "coordinates", lambda array: packed, **changed)
    np.testing.assert_allclose(CompactMap(file).points.all(), expected, atol=0.51 * step)


def nan(array):
    array[0] = np.nan
    return array


@pytest.mark.parametrize(
    "name, value, metadata",
    [
        ("translations", nan, {}),
        ("rotations", lambda a: a[:-1], {}),
        ("rotations", lambda a: 0 * a, {}),
        ("rotations", lambda a: a + np.float32(np.inf), {}),
        ("coordinates", lambda a: a[:-5], {}),
        ("descriptors", lambda a: a[:, :-1], {}),
        ("descriptors", lambda a: a[:-1], {}),
        ("descriptors", lambda a: a.astype(np.int64), {}),
        ("levels", lambda a: -a, {}),
        ("visible", lambda a: a[:-1], {}),
        ("visible", lambda a: np.full_like(a, 255), {}),
        ("num_visible", lambda a: a + 2**31, {}),
        ("camera_of_image", lambda a: a + 9, {}),
        ("retrieval", lambda a: a[:, :1], {}),
        ("vocabulary", lambda a: a * np.float16(np.nan), {}),
        ("vocabulary", lambda a: a[:, :-1], {}),
        ("names", lambda a: a[:3], {}),
        ("names", lambda a: np.frombuffer(b"a\na/b\nc\nd", np.uint8), {}),
        ("names", lambda a: np.frombuffer(b"a\na\nc\nd", np.uint8), {}),
        ("names", lambda a: np.frombuffer(b"/a\nb\nc\nd", np.uint8), {}),
        (None, None, {"points": 10**12}),
        (None, None, {"points": -1}),
        (None, None, {"bits": 8}),
        (None, None, {"visible": 7}),
        (None, None, {"cameras": [["NONE", 1, 1]]}),
        (None, None, {"known": {"a": ["PINHOLE", 9, 9, 1]}}),
        (None, None, {"projection_sha256": "0"}),
        (None, None, {"vocabulary_sha256": 5, "version": 3}),
    ],
)
def test_hostile_files(file, name, value, metadata):
    change(file, name, value, **metadata)
    if "vocabulary_sha256" in metadata:
        change(file, "vocabulary", lambda a: a[:0])
    with pytest.raises(InputError) as error:
        use(file)
    assert str(error.value).count("\n") < 2


def test_damaged_bytes(file):
    check_flipped_bits(file)
