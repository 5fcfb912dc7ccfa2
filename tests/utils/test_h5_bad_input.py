"""Damaged h5 files."""

import h5py
import numpy as np
import pytest
from hostile import overwrite, refuses_or_reads

from hloc_reduce.runtime import group_writer
from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import store
from hloc_reduce.utils.feature_files import get_descriptors, get_image_size, get_keypoints
from hloc_reduce.utils.h5 import file_provenance, list_h5_names, open_h5
from hloc_reduce.utils.match_files import get_matches, names_to_pair


def test_damaged_data_are_named(scene):
    """A file whose structure is whole but some numbers of which cannot be read."""
    with h5py.File(scene.features, "r+") as file:
        group = file["db/0.jpg"]
        for key in ("keypoints", "descriptors"):
            numbers = group[key][()]
            del group[key]
            group.create_dataset(key, data=numbers, chunks=numbers.shape, compression="gzip")
        offsets = [group[key].id.get_chunk_info(0) for key in ("keypoints", "descriptors")]
    with scene.features.open("r+b") as file:
        for chunk in offsets:
            file.seek(chunk.byte_offset)
            file.write(bytes(chunk.size))
    with open_h5(scene.features) as file:
        for read in (get_keypoints, get_descriptors):
            with pytest.raises(InputError, match="features.h5: .*db/0.jpg cannot be read"):
                read(file, "db/0.jpg")


def write_features(path):
    """Write a feature file: floats, bytes and an image that could not be read."""
    generator = np.random.default_rng(0)
    with GroupWriter(path, {}) as writer:
        for name, kind in (("db/0.jpg", "float16"), ("db/1.jpg", "uint8"), ("db/2.jpg", "float32")):
            features = {
                "keypoints": generator.uniform(0, 99, (20, 2)).astype(np.float32),
                "descriptors": generator.standard_normal((8, 20)).astype(np.float32),
                "image_size": np.array([100, 100]),
            }
            arrays, attrs = store(features, kind)
            attrs["keypoints"] = {"uncertainty": 1.0}
            failed = {"": {group_writer.FAILURE: "no image"}} if kind == "float32" else {}
            writer.add(name, arrays, attrs | failed)


def read_features(path):
    group_writer.failures(path)
    with open_h5(path) as file:
        file_provenance(file)
        for name in list_h5_names(path):
            get_keypoints(file, name)
            get_image_size(file, name)
            get_descriptors(file, name)


def write_matches(path):
    generator = np.random.default_rng(0)
    with GroupWriter(path, {}, compression="gzip") as writer:
        for name in ("db/0.jpg", "db/1.jpg"):
            arrays = {
                "matches0": generator.integers(-1, 20, 20).astype(np.int32),
                "matching_scores0": generator.random(20).astype(np.float16),
            }
            writer.add(names_to_pair("q.jpg", name), arrays)


def read_matches(path):
    GroupWriter(path, {})
    with open_h5(path) as file:
        for name in ("db/0.jpg", "db/1.jpg"):
            get_matches(file, "q.jpg", name, (20, 20))


@pytest.mark.parametrize("old_format", [False, True])  # h5py's default, which hloc's files have
@pytest.mark.parametrize(
    "write, read", [(write_features, read_features), (write_matches, read_matches)]
)
def test_damaged_h5_files_are_read_or_refused(write, read, old_format, tmp_path):
    path = tmp_path / "damaged.h5"
    write(path)
    if old_format:
        with h5py.File(path) as file, h5py.File(tmp_path / "old.h5", "w") as old:
            for name in file:
                file.copy(name, old)
        path = tmp_path / "old.h5"
    content, generator = path.read_bytes(), np.random.default_rng(0)
    read(path)
    for _ in range(300):
        damaged = np.frombuffer(content, np.uint8).copy()
        start, number = generator.integers(len(content)), generator.choice([1, 4, 64, 512])
        match generator.integers(4):
            case 0:
                damaged[start] ^= 1 << generator.integers(8)
            case 1:
                damaged[start : start + number] = 0
            case 2:
                damaged[start : start + number] = 255
            case 3:
                damaged = damaged[:start]
        overwrite(path, damaged.tobytes())
        refuses_or_reads(read, path)


def test_a_damaged_h5_file_is_not_blamed_for_a_bug(scene):
    with pytest.raises(KeyError, match="no_such"), open_h5(scene.features) as file:
        file["no_such"]
    with pytest.raises(ZeroDivisionError), open_h5(scene.features):
        1 / 0  # noqa: B018
