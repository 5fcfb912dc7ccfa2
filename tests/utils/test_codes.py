"""Codes of 4, 2 and 1 bits: packed, decoded, and refused when broken."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hloc_reduce.training.levels import fit
from hloc_reduce.utils.codes import (
    CODED,
    check_levels,
    decode,
    descriptor_bytes,
    encode,
    pack,
    restore,
    store,
    unpack,
)


def make_levels(dim, storage, seed=0):
    drawn = np.random.default_rng(seed).standard_normal((dim, 2 ** CODED[storage]))
    return np.sort(drawn, axis=1).astype(np.float32)


@given(st.integers(1, 70), st.integers(0, 9), st.sampled_from([1, 2, 4]), st.integers(0, 99))
@settings(max_examples=60, deadline=None)
def test_what_is_packed_is_unpacked(dim, number, bits, seed):
    codes = np.random.default_rng(seed).integers(0, 2**bits, (dim, number)).astype(np.uint8)
    packed = pack(codes, bits)
    assert packed.shape == (-(-dim * bits // 8), number) and packed.dtype == np.uint8
    np.testing.assert_array_equal(unpack(packed, dim, bits), codes)


def test_the_first_codes_are_the_low_bits():
    codes = np.array([[1], [2], [3], [0], [1]], np.uint8)
    assert pack(codes, 2).tolist() == [[0b00111001], [1]]
    assert pack(codes, 4).tolist() == [[0x21], [0x03], [0x01]]


@pytest.mark.parametrize("storage", CODED)
def test_a_number_becomes_its_nearest_level(storage):
    levels = make_levels(5, storage)
    numbers = np.random.default_rng(1).uniform(-3, 3, (5, 200)).astype(np.float32)
    decoded = decode(pack(encode(numbers, levels), CODED[storage]), levels).T
    distance = np.abs(numbers[:, :, None] - levels[:, None])
    np.testing.assert_allclose(np.abs(decoded - numbers), distance.min(axis=2), atol=1e-6)


@pytest.mark.parametrize("storage, size", [("uint4", 16), ("uint2", 8), ("uint1", 4)])
def test_32_numbers_take_16_8_and_4_bytes(storage, size):
    descriptors = np.random.default_rng(0).standard_normal((32, 50)).astype(np.float32)
    levels = make_levels(32, storage)
    arrays, attrs = store({"descriptors": descriptors}, storage, levels)
    assert [*arrays] == [f"descriptors_{storage}"]
    assert arrays[f"descriptors_{storage}"].shape == (size, 50)
    assert descriptor_bytes(32, storage) == size
    restored = restore(arrays, attrs)
    assert restored.shape == (50, 32) and restored.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(restored, axis=1), 1, atol=1e-6)
    again, _ = store({"descriptors": restored.T}, storage, levels)
    assert again[f"descriptors_{storage}"].shape == (size, 50)


@pytest.mark.parametrize("storage, biased", [("uint4", 0.99), ("uint2", 0.95), ("uint1", 0.8)])
def test_unbiased_codes_estimate_cosines(storage, biased):
    drawn = np.random.default_rng(0).standard_normal((2, 5000, 32)).astype(np.float32)
    first = drawn[0] / np.linalg.norm(drawn[0], axis=1, keepdims=True)
    second = first + 0.1 * drawn[1]
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    levels = fit(torch.from_numpy(first), CODED[storage]).numpy()
    arrays = store({"descriptors": first.T}, storage, levels)
    cosine = (first * second).sum(axis=1).mean()
    for unbiased, expected in ((False, biased * cosine), (True, cosine)):
        restored = restore(*arrays, unbiased=unbiased)
        assert (restored * second).sum(axis=1).mean() == pytest.approx(expected, rel=0.015)


def test_broken_levels_are_refused():
    for levels, said in (
        (np.zeros((32, 15)), r"not \(D, 16\)"),
        (np.zeros(16), r"not \(D, 16\)"),
        (np.full((32, 16), np.nan), "not finite"),
        (np.arange(16.0)[None, ::-1], "not ascending"),
    ):
        with pytest.raises(ValueError, match=said):
            check_levels(levels, "uint4")
    with pytest.raises(ValueError, match="8 bytes a descriptor, but levels of 32 dimensions"):
        check_levels(make_levels(32, "uint4"), "uint4", width=8)
