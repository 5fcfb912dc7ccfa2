"""Which points an image of a compact map shows, in few bytes.

The first point is a number in base 128 (LEB128): seven bits a byte, the low ones first, the high
bit set in all bytes but the last. It is twice the index, plus 1 if a bitmap of the following points
comes next, cut behind the last one; otherwise the differences of successive indices come next, each
in base 128.
"""

import numpy as np

MAX_DIGITS = 5  # of a number


def pack(points: np.ndarray) -> bytes:
    """Pack indices of points (M,), ascending, in the shorter of both ways."""
    if not len(points):
        return b""
    first, differences = int(points[0]), np.diff(points.astype(np.int64))
    listed = _pack_numbers(differences)
    width = -(-int(points[-1] - points[0]) // 8)
    if is_shorter(listed, width):
        return _pack_numbers(np.array([2 * first])) + listed
    flags = np.zeros(8 * width, bool)
    flags[np.cumsum(differences) - 1] = True
    bitmap = np.packbits(flags, bitorder="little").tobytes()
    return _pack_numbers(np.array([2 * first + 1])) + bitmap


def is_shorter(listed: bytes, width: int) -> bool:
    """Tell whether differences are at most as long as a bitmap of a number of bytes."""
    return len(listed) <= width


def unpack(packed: np.ndarray, number: int) -> np.ndarray:
    """Return the indices (M,) int64 in bytes (N,) uint8.

    Args:
        packed: from `pack`.
        number: of points of the map.

    Raises:
        ValueError: for bytes that are not from `pack`, or of points that do not exist.
    """
    if not len(packed):
        return np.zeros(0, np.int64)
    digits = int((packed[:MAX_DIGITS] >= 128).argmin()) + 1
    first, rest = int(numbers(packed[:digits])[0]), packed[digits:]
    if first % 2:
        steps = np.flatnonzero(np.unpackbits(rest, bitorder="little")) + 1
    else:
        differences = numbers(rest)
        if differences.min(initial=1) < 1:
            raise ValueError("points that are not ascending")
        steps = np.cumsum(differences)
    found = np.concatenate([[0], steps]) + first // 2
    if found[-1] >= number:
        raise ValueError("visible points that do not exist")
    return found


def _pack_numbers(values: np.ndarray) -> bytes:
    """Pack numbers (N,) int64, at least 0, in base 128."""
    if values.max(initial=0) < 128:
        return values.astype(np.uint8).tobytes()
    shifts = 7 * np.arange(MAX_DIGITS)
    digits = values[:, None] >> shifts
    more = digits[:, 1:] > 0
    packed = (digits & 127).astype(np.uint8)
    packed[:, :-1] |= more.astype(np.uint8) << 7
    used = np.hstack([np.ones((len(values), 1), bool), more])
    return packed[used].tobytes()


def numbers(packed: np.ndarray) -> np.ndarray:
    """Return the numbers (M,) int64 in bytes of `_pack_numbers`."""
    last = np.flatnonzero(packed < 128)
    if len(last) == len(packed):
        return packed.astype(np.int64)
    if not len(last) or last[-1] != len(packed) - 1:
        raise ValueError("a number without its last digit")
    starts = np.concatenate([[0], last[:-1] + 1])
    lengths = last - starts + 1
    if lengths.max() > MAX_DIGITS:
        raise ValueError(f"a number of more than {MAX_DIGITS} bytes")
    found = packed[starts].astype(np.int64) & 127
    for i in range(1, int(lengths.max())):
        has = np.flatnonzero(lengths > i)
        found[has] |= (packed[starts[has] + i].astype(np.int64) & 127) << 7 * i
    return found
