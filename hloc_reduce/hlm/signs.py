"""Global descriptors as signs: the retrieval of compact maps."""

import numpy as np

SIGNS = 1024  # bits of a descriptor, at most
# of more images than this, a query is compared with the first signs of all, `COARSE` bytes of each,
# and with all signs of the most similar ones: LEAST, or CANDIDATES for each image that is wanted
FEW, COARSE, LEAST, CANDIDATES = 100_000, 60, 500, 10
BYTES = np.arange(256, dtype=np.uint8)[:, None]


def hadamard(rows: np.ndarray, number: int) -> np.ndarray:
    """Return the Walsh-Hadamard transform of rows, which is its own inverse but for a factor.

    Args:
        rows: (N, G) float32.
        number: the least length of the transform, which is a power of two.

    Returns:
        (N, H) float32, where H is the next power of two from `number` on.
    """
    size = 1 << max(number - 1, 0).bit_length()
    values = np.zeros((len(rows), size), np.float32)
    values[:, : rows.shape[1]] = rows
    half = 1
    while half < size:
        parts = values.reshape(len(rows), -1, 2, half)
        values = np.stack([parts[:, :, 0] + parts[:, :, 1], parts[:, :, 0] - parts[:, :, 1]], 2)
        half *= 2
    return values.reshape(len(rows), size)


def count(number: int) -> int:
    """Return how many signs descriptors of a number of dimensions have."""
    return min(SIGNS, 1 << max(number - 1, 0).bit_length())


def pack(descriptors: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the signs of descriptors (I, G), packed (I, B) uint8, and their number."""
    number = descriptors.shape[1]
    positive = hadamard(descriptors, number)[:, : count(number)] > 0
    return np.packbits(positive, axis=1, bitorder="little"), positive.shape[1]


def columns(packed: np.ndarray) -> np.ndarray:
    """Return packed signs (I, B) byte by byte (B, I), as `Signs` takes them."""
    return np.ascontiguousarray(packed.T)


class Signs:
    """Packed signs of global descriptors.

    Args:
        columns: (B, I) uint8 from `columns`, or the first ones of these.
        number: dimensions of the descriptors.
    """

    def __init__(self, columns: np.ndarray, number: int):
        self._columns = columns
        self._number, self._count = number, min(count(number), 8 * len(columns))

    def descriptors(self) -> np.ndarray:
        """Return the descriptors (I, G) float32 of unit norm that the signs tell."""
        found = hadamard(unpack(self._columns.T, self._count), self._number)
        return found[:, : self._number] * self._scale(found.shape[1])

    def similarity(self, descriptor: np.ndarray) -> np.ndarray:
        """Return the products (I,) of a descriptor (G,) with `descriptors`, without these.

        A table has the sums of the eight products that a byte may stand for.
        """
        transformed = hadamard(descriptor[None], self._number)[0]
        parts = np.zeros(8 * len(self._columns), np.float32)
        parts[: self._count] = transformed[: self._count]
        tables = parts.reshape(-1, 8) @ unpack(BYTES, 8).T
        found = np.zeros(self._columns.shape[1], np.float32)
        for table, column in zip(tables, self._columns, strict=True):
            found += table.take(column)
        return found * self._scale(len(transformed))

    def _scale(self, size: int) -> np.float32:
        """Return what undoes the change of norms by a transform of a size: by its square root."""
        return np.float32(1 / np.sqrt(self._count * size))


def unpack(packed: np.ndarray, number: int | None = None) -> np.ndarray:
    """Unpack signs (N, B): (N, S) float32, -1 and 1; by default, all eight of each byte."""
    bits = np.unpackbits(packed, axis=1, count=number, bitorder="little")
    return 2 * bits.astype(np.float32) - 1
