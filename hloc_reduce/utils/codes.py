"""Stored descriptors: floats, numbers rounded to steps, or codes of a few bits for each number.

A code is the index of a level. The levels of each dimension belong to the projection, so that the
codes of all images and maps compare.
"""

from collections.abc import Mapping
from typing import Annotated

import numpy as np

from .options import Option

FLOATS = ("float16", "float32")  # hloc has these, as `as_half`
CODED = {"uint4": 4, "uint2": 2, "uint1": 1}  # bits of a number
STORAGES = (*FLOATS, "uint8", *CODED)
QUANTIZED = {storage: f"descriptors_{storage}" for storage in STORAGES if storage not in FLOATS}
STORAGE = Option(
    "storage",
    STORAGES,
    "uint8 keeps a number in a byte; uint4, uint2 and uint1 keep it in 4, 2 and 1 bits and need a "
    "projection with levels, see hloc_reduce.training.levels; hloc reads floats only",
)
Storage = Annotated[str, STORAGE]
STEPS = 255
# The integer that stands for 1, and the least mean norm of what codes stand for. Products of
# restored vectors are at most (INTEGER_SCALE / MIN_MEAN_NORM)**2 < 2**30, which `best_two` needs.
# At least 99.9 % of the matches of real descriptors stay the same, with a ratio test or without.
INTEGER_SCALE, MIN_MEAN_NORM = 20_000, 0.75


def descriptor_bytes(dim: int, storage: str) -> int:
    """Return the bytes that a storage takes for a descriptor of `dim` numbers."""
    if storage in CODED:
        return -(-dim * CODED[storage] // 8)
    return dim * np.dtype(storage).itemsize


def store(
    features: dict[str, np.ndarray], storage: str, levels: np.ndarray | None = None
) -> tuple[dict[str, np.ndarray], dict[str, dict]]:
    """Convert the features of an image to what a file stores.

    Args:
        features: arrays of floats or integers, with `descriptors` (D, N).
        storage: one of `STORAGES`. Keypoints stay float32; other floats that are not descriptors
            become float16 unless it is float32.
        levels: (D, 2**bits) of a storage in `CODED`, ascending.

    Returns:
        The arrays, with `descriptors_<storage>` instead of `descriptors` unless they are floats,
        and the attributes of each array: `scale` and `offset` of uint8, `levels` of codes.
    """
    floats = np.float32 if storage == "float32" else np.float16
    stored = {
        key: array.astype(floats) if key != "keypoints" and array.dtype.kind == "f" else array
        for key, array in features.items()
    }
    if storage in FLOATS:
        return stored, {}
    del stored["descriptors"]
    key, descriptors = QUANTIZED[storage], features["descriptors"]
    if storage in CODED:
        assert levels is not None
        packed = pack(encode(descriptors, levels), CODED[storage])
        return stored | {key: packed}, {key: {"levels": levels.astype(np.float16)}}
    quantized, scale, offset = quantize(descriptors)
    return stored | {key: quantized}, {key: {"scale": scale, "offset": offset}}


def restore(
    stored: Mapping[str, np.ndarray], attrs: Mapping[str, Mapping], unbiased: bool = False
) -> np.ndarray:
    """Return descriptors (N, D) float32 from what `store` returned; those not floats normalized.

    What codes stand for is shorter than the descriptors that were coded, and its direction is
    another. So the cosines of matches come out too small, and a ratio test refuses too many.

    Args:
        stored: the arrays.
        attrs: their attributes.
        unbiased: give codes norms above 1 instead, so that their products estimate the cosines of
            the descriptors that were coded.

    Raises:
        KeyError, TypeError, ValueError: for missing or wrong attributes.
    """
    storage = storage_of(stored)
    if storage in FLOATS:
        return np.ascontiguousarray(stored["descriptors"].T, np.float32)
    key = QUANTIZED[storage]
    if storage in CODED:
        levels = check_levels(attrs[key]["levels"], storage, len(stored[key]))
        descriptors = decode(stored[key], levels)
    else:
        scale, offset = (np.float32(attrs[key][name]) for name in ("scale", "offset"))
        descriptors = stored[key].T.astype(np.float32) * scale + offset
    norm = np.linalg.norm(descriptors, axis=1, keepdims=True)
    descriptors /= np.maximum(norm, np.finfo(np.float32).tiny)
    if unbiased and storage in CODED and len(norm):
        descriptors /= norm.mean().clip(MIN_MEAN_NORM, 1)
    return np.ascontiguousarray(descriptors)


def to_integers(descriptors: np.ndarray) -> np.ndarray:
    """Round descriptors to multiples of 1 / `INTEGER_SCALE`, for fast matching.

    Args:
        descriptors: (N, D) float32 from `restore`.

    Returns:
        (N, D) int16.
    """
    scaled = descriptors * np.float32(INTEGER_SCALE)
    return np.rint(scaled, out=scaled).astype(np.int16)


def storage_of(stored: Mapping[str, np.ndarray]) -> str:
    """Return how a group stores descriptors: float16 for all floats but float32."""
    for storage, key in QUANTIZED.items():
        if key in stored:
            return storage
    return "float32" if stored["descriptors"].dtype == np.float32 else "float16"


def quantize(
    descriptors: np.ndarray, limits: tuple[float, float] | None = None
) -> tuple[np.ndarray, float, float]:
    """Round descriptors to 256 steps between limits; default: their minimum and maximum.

    Returns:
        Steps (uint8, same shape), scale and offset: descriptors are offset + scale * step.
    """
    if limits is None and not descriptors.size:
        return descriptors.astype(np.uint8), 1.0, 0.0
    offset, largest = map(float, limits or (descriptors.min(), descriptors.max()))
    scale = (largest - offset) / STEPS or 1.0
    steps = np.round((descriptors.astype(np.float32) - offset) / scale)
    return steps.clip(0, STEPS).astype(np.uint8), scale, offset


def encode(descriptors: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Return the index of the nearest level of each number.

    Args:
        descriptors: (D, N) floats.
        levels: (D, L) ascending levels of each dimension.

    Returns:
        (D, N) uint8, below L.
    """
    codes = np.zeros(descriptors.shape, np.uint8)
    levels = levels.astype(np.float32)
    for middle in ((levels[:, 1:] + levels[:, :-1]) / 2).T:
        codes += descriptors > middle[:, None]
    return codes


def decode(packed: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Return the numbers that packed codes stand for.

    Args:
        packed: (B, N) uint8 from `pack`.
        levels: (D, 2**bits) float32.

    Returns:
        (N, D) float32.
    """
    dim, bits, number = len(levels), levels.shape[1].bit_length() - 1, packed.shape[1]
    each = 8 // bits
    every = unpack(np.arange(256, dtype=np.uint8)[None], each, bits)  # the codes of each byte
    padded = np.zeros((len(packed) * each, 2**bits), np.float32)
    padded[:dim] = levels
    tables = np.take_along_axis(padded.reshape(-1, each, 2**bits), every[None].astype(np.intp), 2)
    # all numbers of a byte are copied at once
    block = np.dtype(f"V{4 * each}")
    tables = np.ascontiguousarray(tables.transpose(0, 2, 1)).view(block)[:, :, 0]
    numbers = np.empty((number, len(packed) * each), np.float32)
    blocks = numbers.view(block)
    for i, row in enumerate(packed):
        blocks[:, i] = tables[i].take(row)
    return numbers[:, :dim]


def pack(codes: np.ndarray, bits: int) -> np.ndarray:
    """Pack codes of 1, 2, 4 or 8 bits into bytes.

    Args:
        codes: (D, N) uint8, below 2**bits.
        bits: of a code.

    Returns:
        (ceil(D * bits / 8), N) uint8; the first codes are the low bits of the first byte, and
        missing ones are 0.
    """
    each, (dim, number) = 8 // bits, codes.shape
    width = -(-dim // each)
    padded = np.zeros((width * each, number), np.uint8)
    padded[:dim] = codes
    shifts = np.arange(0, 8, bits, dtype=np.uint8)[:, None]
    return np.bitwise_or.reduce(padded.reshape(width, each, number) << shifts, axis=1)


def unpack(packed: np.ndarray, dim: int, bits: int) -> np.ndarray:
    """Unpack codes.

    Args:
        packed: (ceil(dim * bits / 8), N) uint8 from `pack`.
        dim: number of codes of a descriptor.
        bits: of a code.

    Returns:
        Codes (dim, N) uint8.
    """
    shifts = np.arange(0, 8, bits, dtype=np.uint8)[:, None]
    codes = packed[:, None] >> shifts & (2**bits - 1)
    return codes.reshape(codes.shape[0] * codes.shape[1], codes.shape[2])[:dim]


def check_levels(levels: np.ndarray, storage: str, width: int | None = None) -> np.ndarray:
    """Return levels (D, L) float32 of a storage in `CODED`.

    Args:
        levels: of any type and shape.
        storage: that they are for.
        width: bytes of a descriptor that is stored with them, if there is one.

    Raises:
        ValueError: unless they are finite, ascending and of the right shape.
    """
    bits, levels = CODED[storage], np.asarray(levels, np.float32)
    if levels.ndim != 2 or levels.shape[1] != 2**bits:
        raise ValueError(f"levels of shape {levels.shape}, not (D, {2**bits})")
    if not np.isfinite(levels).all() or (np.diff(levels, axis=1) < 0).any():
        raise ValueError("levels that are not finite or not ascending")
    if width is not None and width != -(-len(levels) * bits // 8):
        raise ValueError(f"{width} bytes a descriptor, but levels of {len(levels)} dimensions")
    return levels
