"""A reader of compact maps, written from docs/map-format.md; its numbers are CompactMap's."""

import struct

import numpy as np
import pytest
from compact_files import read, read_coordinates, unpacked
from safetensors.numpy import load_file

from hloc_reduce import compact
from hloc_reduce.hlm import visible
from hloc_reduce.hlm.reader import CompactMap
from hloc_reduce.maps import contents
from hloc_reduce.projections.files import WEIGHTS
from pipelines import localize

PIPELINE = localize
MODELS = {0: ("SIMPLE_PINHOLE", 3)}  # COLMAP's number of a camera model, and of its parameters


def read_names(arrays):
    packed, number = arrays["names"].tobytes(), len(arrays["images"])
    blocks = -(-number // 16)
    begins, text = struct.unpack(f"<{blocks}I", packed[: 4 * blocks]), packed[4 * blocks :]
    names, at, before = [], 0, b""
    while at < len(text):
        if len(names) % 16 == 0:
            assert at == begins[len(names) // 16] and text[at] == 0
        end = text.index(b"\n", at + 1)
        before = before[: text[at]] + text[at + 1 : end]
        names.append(before.decode())
        at = end + 1
    assert len(names) == number
    return names


def read_images(metadata, arrays):
    """Yield the pose, rotation (3, 3) and translation, and the camera of each image."""
    for row in arrays["images"]:
        *numbers, camera, _ = struct.unpack("<6i2I", row.tobytes())
        x, y, z = (number / (2**31 - 1) for number in numbers[:3])
        square = x * x + y * y + z * z
        x, y, z, w = (part / (1 + square) for part in (2 * x, 2 * y, 2 * z, 1 - square))
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        center = np.add(metadata["least"], metadata["center_step"] * np.array(numbers[3:]))
        model, *size = struct.unpack("<3I", arrays["cameras"][camera, :12].tobytes())
        name, number = MODELS[model]
        parameters = np.frombuffer(arrays["cameras"][camera, 12:].tobytes(), "<f4")[:number]
        yield rotation, -rotation @ center, (name, *size, *parameters)


def read_numbers(packed):
    """Yield numbers in base 128, and the bytes behind each one."""
    value = shift = 0
    for i, byte in enumerate(packed):
        value += (byte & 127) << shift
        shift += 7
        if byte < 128:
            yield value, packed[i + 1 :]
            value = shift = 0


def read_visible(arrays):
    """Yield the points of each image."""
    begin = 0
    for row in arrays["images"]:
        (end,) = struct.unpack("<I", row[28:].tobytes())
        part, begin = arrays["visible"][begin:end].tolist(), end
        if not part:
            yield np.zeros(0, int)
            continue
        first, rest = next(read_numbers(part))
        point = first // 2
        if first % 2:
            flags = unpacked(np.array(rest, np.uint8), None)
            yield np.array([point, *(point + 1 + np.flatnonzero(flags))])
        else:
            yield np.cumsum([point, *(number for number, _ in read_numbers(rest))])


def read_descriptors(metadata, arrays):
    """Return the descriptors (P, D), and the norms of what codes stand for."""
    stored, storage = arrays["descriptors"], metadata["storage"]
    if storage.startswith("float"):
        return stored.astype(np.float32), None
    if storage == "uint8":
        scale, offset = metadata["scale"]
        found = stored * np.float32(scale) + np.float32(offset)
    else:
        assert "levels" not in arrays  # they ship with the projection
        levels = load_file(WEIGHTS / "colmap_sift_sv32.safetensors")[f"levels.{storage}"]
        levels, size = levels.astype(np.float16).astype(float), int(storage.removeprefix("uint"))
        bit = size * np.arange(len(levels))
        codes = stored[:, bit // 8] >> bit % 8 & 2**size - 1
        found = np.take_along_axis(levels, codes.T, axis=1).T.astype(np.float32)
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


def similarity(arrays, descriptor):
    size = 1 << (len(descriptor) - 1).bit_length()
    padded = np.pad(descriptor, (0, size - len(descriptor)))
    number = min(1024, size)
    return (2 * unpacked(arrays["retrieval"], number) - 1) @ transform(padded)[:number]


def match(shown, query, ratio):
    """Return the rows of mutual nearest descriptors, (M, 2)."""
    integers = [np.rint(part * 20_000).astype(np.int64) for part in (query, shown)]
    distances = 2 - 2 * (integers[0] @ integers[1].T / 20_000**2)
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
        metadata, arrays = read(path)
        expected = CompactMap(path)
        names = read_names(arrays)
        assert names == list(expected.names) and metadata["points"] > 100
        size = -(-metadata["points"] * sum(metadata["bits"]) // 8)
        assert len(arrays["coordinates"]) == size + 8
        xyz = read_coordinates(metadata, arrays)
        np.testing.assert_allclose(xyz, expected.points.all(), atol=1e-12)
        assert np.median(np.abs(xyz[:, 2])) < 0.01  # the photos show the plane z = 0
        shown = dict(zip(names, read_visible(arrays), strict=True))
        found = read_images(metadata, arrays)
        for name, (rotation, translation, camera) in zip(names, found, strict=True):
            np.testing.assert_array_equal(shown[name], expected.visible(name))
            pose = expected.pose(name)
            np.testing.assert_allclose(pose.rotation.matrix(), rotation, atol=1e-9)
            np.testing.assert_allclose(pose.translation, translation, atol=1e-9)
            model, width, height, *parameters = camera
            assert (model, width, height) == ("SIMPLE_PINHOLE", 360, 270)
            np.testing.assert_array_equal(parameters, expected.camera(name).params)
        described, norms = read_descriptors(metadata, arrays)
        every = np.arange(len(described))
        np.testing.assert_allclose(described, expected.descriptors(every), atol=1e-6)

        local = described[shown[names[0]]]
        descriptor = vlad(local, arrays["vocabulary"].astype(float)).astype(np.float16)
        ranked = similarity(arrays, descriptor.astype(float))
        rows, its = expected.retrieve(descriptor.astype(np.float32), len(names))
        ranked, its = (part / np.linalg.norm(part) for part in (ranked[rows], its))
        np.testing.assert_allclose(ranked, its, atol=1e-6)
        check_matches(path, described, norms, shown)


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


@pytest.mark.parametrize("points", [[0, 5, 70_000], [], [127, 128, 300], [9], range(50, 90, 2)])
def test_visible_points_are_read_as_documented(points):
    packed = np.frombuffer(visible.pack(np.array(points, int)), np.uint8)
    table = np.zeros((1, 32), np.uint8)
    table[0, 28:] = np.frombuffer(struct.pack("<I", len(packed)), np.uint8)
    [found] = read_visible({"images": table, "visible": packed})
    assert found.tolist() == list(points)
