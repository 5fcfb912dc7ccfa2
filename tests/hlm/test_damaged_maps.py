"""Compact maps with damaged bytes are refused by an InputError, or can be used."""

import json
import re
import tracemalloc

import numpy as np
import pytest
from compact_files import check_flipped_bits, use
from hostile import HARMFUL, fuzzed, overwrite, refuses_or_reads
from hypothesis import given
from hypothesis import strategies as st

from hloc_reduce import compact
from hloc_reduce.hlm import signs, visible
from pipelines import localize

PIPELINE = localize
NUMBERS = rb"-?\d[\d.e+-]*"
NOT_FINITE = np.nan, np.inf, -np.inf
FLOATS = {"F16": "<f2", "F32": "<f4", "F64": "<f8"}


def with_header(content, header):
    """Replace the header (bytes) of a file's content."""
    end = 8 + int.from_bytes(content[:8], "little")
    padded = header + b" " * (-len(header) % 8)
    return len(padded).to_bytes(8, "little") + padded + content[end:]


@pytest.fixture(params=["uint4 bitmaps", "float16 differences", "uint4 coarse"])
def file(request, build_map, tmp_path, monkeypatch):
    """A small map, and the content of its file."""
    built = build_map("--feature", "colmap_sift_sv32")
    storage, kind = request.param.split()
    if kind == "differences":  # which are shorter only in large maps
        monkeypatch.setattr(visible, "is_shorter", lambda *_: True)
    if kind == "coarse":
        monkeypatch.setattr(signs, "FEW", 3)
    path = tmp_path / "place.hlm"
    compact.main(path, built, storage=storage, max_mb=0.015)
    content = path.read_bytes()
    assert (b"coarse" in content) == (kind == "coarse")
    assert use(path).names
    return path, content


def test_damaged_bytes(file):
    path, content = file
    check_flipped_bits(path)
    end = 8 + int.from_bytes(content[:8], "little")
    header, outcomes = content[8:end], set()

    def check(damaged):
        overwrite(path, damaged)
        outcomes.add(refuses_or_reads(use, path) is None)

    @fuzzed
    @given(st.lists(st.tuples(st.integers(0, end - 1), st.integers(0, 255)), min_size=1))
    def overwritten(bytes_of_header):
        damaged = bytearray(content)
        for place, value in bytes_of_header:
            damaged[place] = value
        check(damaged)

    @fuzzed
    @given(st.integers(0, len(content) - 1))
    def truncated(size):
        check(content[:size])
        assert refuses_or_reads(use, path) is None

    numbers = [found.span() for found in re.finditer(NUMBERS, header)]

    @fuzzed
    @given(st.sampled_from(numbers), st.integers().map(str) | st.sampled_from(HARMFUL))
    def renumbered(place, value):
        first, last = place
        check(with_header(content, header[:first] + value.encode() + header[last:]))

    floats = [entry for entry in json.loads(header).values() if entry.get("dtype") in FLOATS]

    @fuzzed
    @given(st.data(), st.sampled_from(floats), st.sampled_from(NOT_FINITE))
    def not_finite(data, entry, value):
        kind = np.dtype(FLOATS[entry["dtype"]])
        first, last = entry["data_offsets"]
        number = data.draw(st.integers(0, (last - first) // kind.itemsize - 1))
        place = end + first + number * kind.itemsize
        damaged = kind.type(value).tobytes()
        check(content[:place] + damaged + content[place + kind.itemsize :])
        assert refuses_or_reads(use, path) is None

    for damage in (overwritten, truncated, renumbered, not_finite):
        damage()
    assert outcomes == {True, False}  # some are refused, others are read


def test_absurd_numbers_take_no_memory(file):
    """Whatever number of the header is absurd."""
    path, content = file
    header = content[8 : 8 + int.from_bytes(content[:8], "little")]
    tracemalloc.start()
    try:
        for found in re.finditer(NUMBERS, header):
            for value in (b"999999999", b"4611686018427387904"):
                changed = header[: found.start()] + value + header[found.end() :]
                overwrite(path, with_header(content, changed))
                refuses_or_reads(use, path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 64 * len(content) + 5e6
