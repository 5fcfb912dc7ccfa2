"""What tests of compact maps share: files are read as documented, used, changed or damaged."""

import json
import struct

import numpy as np
from hostile import fuzzed, overwrite, refuses_or_reads
from hypothesis import given
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from hloc_reduce.hlm.images import ROW
from hloc_reduce.maps import contents

TYPES = {"U8": "u1", "U32": "<u4", "F16": "<f2", "F32": "<f4", "F64": "<f8"}


def read(path):
    """Return the metadata and the arrays."""
    content = path.read_bytes()
    end = 8 + struct.unpack("<Q", content[:8])[0]
    header, arrays = json.loads(content[8:end]), {}
    metadata = json.loads(header.pop("__metadata__")["map"])
    for name, entry in header.items():
        first, last = entry["data_offsets"]
        flat = np.frombuffer(content[end + first : end + last], TYPES[entry["dtype"]])
        arrays[name] = flat.reshape(entry["shape"])
    return metadata, arrays


def unpacked(packed, number):
    """Return bits (..., number), the lowest one of a byte first."""
    return np.unpackbits(packed, axis=-1, bitorder="little")[..., :number].astype(np.int64)


def read_coordinates(metadata, arrays):
    """Return the coordinates (P, 3)."""
    sizes, number = metadata["bits"], metadata["points"]
    rows = unpacked(arrays["coordinates"], number * sum(sizes)).reshape(number, -1)
    axes = np.split(rows, np.cumsum(sizes)[:2], axis=1)
    whole = np.stack([axis @ (1 << np.arange(axis.shape[1])) for axis in axes], axis=1)
    return metadata["least"] + metadata["step"] * whole


def use(path):
    """Open a map, and use all that it has."""
    found = contents.read(path)
    of_map, names = found.reference, list(found.names)
    for name in names:
        of_map.pose(name)
        of_map.camera(name)
        of_map.lift(name, np.arange(min(3, of_map.num_keypoints(name))))
    of_map.points.all()
    of_map.views()
    of_map.descriptors(np.arange(len(of_map.points)))
    of_map.global_descriptors()
    of_map.check_names()
    size = of_map.global_descriptors().shape[1]
    assert set(found.retrieve(np.ones(size, np.float32), 3)) <= set(names)
    found.steps[0].match({"descriptors": np.eye(found.dim, 5, dtype=np.float32)}, names[:3])
    return found


def change(file, name, value=None, **metadata):
    """Write a file with a changed array, or metadata."""
    arrays = load_file(file)
    with safe_open(file, "np") as opened:
        known = json.loads(opened.metadata()["map"])
    if name:
        arrays[name] = value(arrays[name].copy())
    save_file(arrays, file, {"map": json.dumps(known | metadata)})


def check_flipped_bits(file):
    """A file with flipped bits is refused by an InputError, or can be used; some of each are."""
    content, outcomes = file.read_bytes(), set()

    @fuzzed
    @given(st.lists(st.integers(0, 8 * len(content) - 1), min_size=1, max_size=8))
    def flipped(bits):
        damaged = bytearray(content)
        for bit in bits:
            damaged[bit // 8] ^= 1 << bit % 8
        overwrite(file, damaged)
        outcomes.add(refuses_or_reads(use, file) is None)

    flipped()
    assert outcomes == {True, False}


def field(name, value):
    """Return what changes a field of the table of images."""

    def changed(table):
        table.view(ROW)[name] = value(len(table)) if callable(value) else value
        return table

    return changed


# that any reader refuses: an array, what it becomes, and metadata
LIES = [
    ("images", lambda a: a[:-1], {}),
    ("images", lambda a: a[:0], {}),
    ("images", lambda a: a[:, :-1], {}),
    ("images", field("camera", 99), {}),
    ("images", field("end", 2**32 - 1), {}),
    ("images", field("end", lambda number: np.arange(number, 0, -1)[:, None]), {}),
    ("cameras", lambda a: a[:0], {}),
    ("cameras", lambda a: a[:, :5], {}),
    ("cameras", lambda a: np.full_like(a, 255), {}),
    ("coordinates", lambda a: a[:-5], {}),
    ("descriptors", lambda a: a[:, :-1], {}),
    ("descriptors", lambda a: a[:-1], {}),
    ("descriptors", lambda a: a.astype(np.int64), {}),
    ("visible", lambda a: a[:-1], {}),
    ("visible", lambda a: np.full_like(a, 255), {}),
    ("visible", lambda a: np.full_like(a, 127), {}),
    ("visible", np.zeros_like, {}),
    ("retrieval", lambda a: a[:, :1], {}),
    ("retrieval", lambda a: a[1:], {}),
    ("names", lambda a: a[:3], {}),
    ("names", lambda a: a[:-1], {}),
    ("names", lambda a: np.full_like(a, 255), {}),
    (None, None, {"points": 10**12}),
    (None, None, {"points": -1}),
    (None, None, {"points": "many"}),
    (None, None, {"bits": [10**6] * 3}),
    (None, None, {"bits": [0, 8, 8]}),
    (None, None, {"bits": [8, 8]}),
    (None, None, {"bits": 8}),
    (None, None, {"step": "wide"}),
    (None, None, {"least": [0, 0]}),
    (None, None, {"center_step": float("nan")}),
    (None, None, {"center_step": [1]}),
    (None, None, {"storage": "uint3"}),
    (None, None, {"version": 99}),
]
