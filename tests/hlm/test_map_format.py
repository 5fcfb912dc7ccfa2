"""A reader of compact maps, written from docs/map-format.md; its numbers are CompactMap's."""

import json
import struct

import numpy as np
import pytest

from hloc_reduce import compact
from hloc_reduce.hlm import points
from hloc_reduce.hlm.reader import CompactMap
from hloc_reduce.maps import contents
from pipelines import localize

PIPELINE = localize
TYPES = {"U8": "u1", "U32": "<u4", "F16": "<f2", "F32": "<f4", "F64": "<f8"}


def read(path):
    """Return the metadata and the tensors."""
    content = path.read_bytes()
    end = 8 + struct.unpack("<Q", content[:8])[0]
    header, tensors = json.loads(content[8:end]), {}
    metadata = json.loads(header.pop("__metadata__")["map"])
    for name, entry in header.items():
        first, last = entry["data_offsets"]
        flat = np.frombuffer(content[end + first : end + last], TYPES[entry["dtype"]])
        tensors[name] = flat.reshape(entry["shape"])
    return metadata, tensors


def unpacked(packed, number):
    return np.unpackbits(packed, axis=-1, bitorder="little")[..., :number].astype(np.int64)


def read_coordinates(metadata, tensors):
    sizes, number = metadata["bits"], metadata["points"]
    rows = unpacked(tensors["coordinates"], number * sum(sizes)).reshape(number, -1)
    axes = np.split(rows, np.cumsum(sizes)[:2], axis=1)
    whole = np.stack([axis @ (1 << np.arange(axis.shape[1])) for axis in axes], axis=1)
    return metadata["least"] + metadata["step"] * whole


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


def transform(vector):
    if len(vector) == 1:
        return vector
    first, second = np.split(vector, 2)
    return np.concatenate([transform(first + second), transform(first - second)])


def vlad(local, words):
    nearest = ((local[:, None] - words) ** 2).sum(axis=2).argmin(axis=1)
    sums = np.stack([(local[nearest == i] - word).sum(axis=0) for i, word in enumerate(words)])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    return (sums / np.linalg.norm(sums)).ravel()


def similarity(metadata, tensors, descriptor):
    size, number = 1 << (len(descriptor) - 1).bit_length(), metadata["signs"]
    padded = np.pad(descriptor, (0, size - len(descriptor)))
    return (2 * unpacked(tensors["retrieval"], number) - 1) @ transform(padded)[:number]


def match(shown, query, ratio):
    """Return the rows of mutual nearest descriptors, (M, 2)."""
    integers = [np.rint(part * 3000).astype(np.int64) for part in (query, shown)]
    distances = 2 - 2 * (integers[0] @ integers[1].T / 3000**2)
    nearest, second = distances.argmin(axis=1), np.sort(distances, axis=1)[:, 1]
    backward, other = distances.argmin(axis=0), np.sort(distances, axis=0)[1]
    rows = np.arange(len(query))
    least = distances[rows, nearest]
    kept = backward[nearest] == rows
    kept &= (least <= ratio**2 * second) & (least <= ratio**2 * other[nearest])
    return np.stack([rows, nearest], axis=1)[kept]


@pytest.fixture
def built(build_map):
    return build_map("--feature", "colmap_sift_sv32")


def test_a_reader_of_the_documented_format(built, tmp_path):
    for storage in ("uint4", "uint2", "uint1", "uint8", "float16"):
        path = tmp_path / f"{storage}.hlm"
        compact.main(path, built, storage=storage)
        metadata, tensors = read(path)
        expected = CompactMap(path)
        names = tensors["names"].tobytes().decode().split("\n")
        assert names == expected.names and metadata["points"] > 100
        xyz = read_coordinates(metadata, tensors)
        np.testing.assert_allclose(xyz, expected.points.all(), atol=1e-12)
        assert np.median(np.abs(xyz[:, 2])) < 0.01  # the photos show the plane z = 0
        shown = dict(zip(names, read_visible(metadata, tensors), strict=True))
        for name, number in zip(names, tensors["camera_of_image"], strict=True):
            np.testing.assert_array_equal(shown[name], expected.visible(name))
            model, width, height, focal_length, x, y = metadata["cameras"][number]
            assert (model, width, height) == ("SIMPLE_PINHOLE", 360, 270)
            np.testing.assert_allclose([focal_length, x, y], expected.camera_of[name].params)
        check_poses(tensors, expected)
        described, norms = read_descriptors(metadata, tensors)
        every = np.arange(len(described))
        np.testing.assert_allclose(described, expected.descriptors(every), atol=1e-6)

        local = described[shown[names[0]]]
        descriptor = vlad(local, tensors["vocabulary"].astype(float)).astype(np.float16)
        ranked = similarity(metadata, tensors, descriptor.astype(float))
        its = expected.similarity(descriptor.astype(np.float32))
        ranked, its = (part / np.linalg.norm(part) for part in (ranked, its))
        np.testing.assert_allclose(ranked, its, rtol=1e-4)
        check_matches(path, described, norms, shown)


def check_poses(tensors, expected):
    """The translations belong to the rounded rotations."""
    for i, name in enumerate(expected.names):
        x, y, z, w = tensors["rotations"][i] / np.linalg.norm(tensors["rotations"][i].astype(float))
        rotation = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        pose = expected.pose(name)
        np.testing.assert_allclose(pose.rotation.matrix(), rotation, atol=1e-6)
        np.testing.assert_allclose(pose.translation, tensors["translations"][i])


def check_matches(path, described, norms, shown):
    """The map's matcher has a ratio of 0.9."""
    noise = np.random.default_rng(0).standard_normal((80, 32)) / 15
    query = described[::-1][:80] + noise
    query /= np.linalg.norm(query, axis=1, keepdims=True)
    query = query.astype(np.float16).astype(np.float32)
    names = list(shown)[:2]
    found = contents.read(path).steps[0].match({"descriptors": query.T}, names)
    if norms is not None:
        used = np.unique(np.concatenate([shown[name] for name in names]))
        described = described / norms[used].mean().clip(0.75, 1)
    number = 0
    for name in names:
        expected = match(described[shown[name]].astype(np.float32), query, 0.9)
        order = np.argsort(found[name][:, 0])
        np.testing.assert_array_equal(found[name][order], expected)
        number += len(expected)
    assert number > 20


def test_differences_are_read_as_documented():
    visible = [np.array([0, 5, 70_000]), np.zeros(0, int), np.array([127, 128, 300])]
    packed, kind = points.pack_visible(visible, 70_001)
    assert kind == "deltas"
    tensors = {"num_visible": np.array([3, 0, 3]), "visible": packed}
    found = read_visible({"visible": kind}, tensors)
    assert [part.tolist() for part in found] == [part.tolist() for part in visible]
