"""Global descriptors as signs: the retrieval of compact maps."""

import numpy as np

SIGNS = 1024  # bits of a descriptor, at most
DESCRIPTORS_PER_BLOCK = 1024  # that are unpacked at once


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


class Signs:
    """Packed signs of global descriptors, unpacked when they are needed.

    Args:
        packed: (I, B) uint8 from `pack`.
        number: dimensions of the descriptors.
    """

    def __init__(self, packed: np.ndarray, number: int):
        self._packed, self._number, self._count = packed, number, count(number)

    def descriptors(self) -> np.ndarray:
        """Return the descriptors (I, G) float32 of unit norm that the signs tell."""
        found = hadamard(self._unpacked(slice(None)), self._number)
        return found[:, : self._number] * self._scale(found.shape[1])

    def similarity(self, descriptor: np.ndarray) -> np.ndarray:
        """Return the products (I,) of a descriptor (G,) with `descriptors`, without these."""
        transformed = hadamard(descriptor[None], self._number)[0]
        parts = [
            self._unpacked(slice(start, start + DESCRIPTORS_PER_BLOCK)) @ transformed[: self._count]
            for start in range(0, len(self._packed), DESCRIPTORS_PER_BLOCK)
        ]
        return np.concatenate(parts) * self._scale(len(transformed))

    def _scale(self, size: int) -> np.float32:
        """Return what undoes the change of norms by a transform of a size: by its square root."""
        return np.float32(1 / np.sqrt(self._count * size))

    def _unpacked(self, rows: slice) -> np.ndarray:
        """Return some signs (N, S) float32, -1 and 1."""
        bits = np.unpackbits(self._packed[rows], axis=1, count=self._count, bitorder="little")
        return 2 * bits.astype(np.float32) - 1
