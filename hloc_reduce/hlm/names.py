"""The names of images in a compact map: in few bytes, and found without reading all."""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from ..utils.parsers import check_names
from .broken import reading

BLOCK = 16  # names, of which only the first one is written in full
CACHED = 4096  # blocks, and rows of names, in memory


def pack(names: Sequence[str]) -> np.ndarray:
    """Pack names, sorted: (N,) uint8.

    Where each block of `BLOCK` names begins, uint32, then the blocks. Of each name, a byte says how
    many bytes it shares with the one before in its block; the others follow, and a line end.
    """
    text, begins, before = bytearray(), [], b""
    for i, name in enumerate(names):
        if i % BLOCK == 0:
            begins.append(len(text))
            before = b""
        content, shared = name.encode(), 0
        while shared < min(len(before), len(content), 255) and before[shared] == content[shared]:
            shared += 1
        text += bytes([shared]) + content[shared:] + b"\n"
        before = content
    return np.frombuffer(np.array(begins, "<u4").tobytes() + bytes(text), np.uint8)


class Names(Sequence[str]):
    """Names of images, sorted.

    Args:
        packed: from `pack`.
        number: of names.
        path: of the file, for messages.

    Raises:
        ValueError: if the bytes are too few for this number.
    """

    def __init__(self, packed: np.ndarray, number: int, path: Path):
        blocks = -(-number // BLOCK)
        if not 0 < 4 * blocks < len(packed):
            raise ValueError(f"{len(packed)} bytes of {number} names")
        self._begins, self._text = packed[: 4 * blocks].view("<u4"), packed[4 * blocks :]
        self._number, self._path = number, path
        self._names = lru_cache(CACHED)(self._decode)
        self.row = lru_cache(CACHED)(self._row)

    def __len__(self) -> int:
        return self._number

    def __getitem__(self, row):  # type: ignore[no-untyped-def]
        """Return the name of a row, or the names (list) of a slice.

        Raises:
            InputError: if the file is broken there.
        """
        if isinstance(row, slice):
            return [self[i] for i in range(*row.indices(self._number))]
        row = range(self._number)[row]
        return self._names(row // BLOCK)[row % BLOCK]

    def __iter__(self) -> Iterator[str]:
        for block in range(len(self._begins)):
            yield from self._decode(block)

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and self.row(name) is not None

    def _row(self, name: str) -> int | None:
        """Return the row of a name, None if it is not there."""
        wanted = name.encode(errors="surrogatepass")
        block = bisect_right(range(len(self._begins)), wanted, key=self._first) - 1
        names = self._names(block) if block >= 0 else []
        return BLOCK * block + names.index(name) if name in names else None

    def _first(self, block: int) -> bytes:
        """Return the first name of a block."""
        begin = int(self._begins[block]) + 1
        return self._text[begin : begin + 2**12].tobytes().partition(b"\n")[0]

    def _decode(self, block: int) -> list[str]:
        """Return the names of a block."""
        with reading(self._path):
            begin = int(self._begins[block])
            last = block + 1 == len(self._begins)
            end = len(self._text) if last else int(self._begins[block + 1])
            content = self._text[begin:end].tobytes()
            names: list[bytes] = []
            at, before = 0, b""
            while at < len(content):
                end = content.index(b"\n", at + 1)
                name = before[: content[at]] + content[at + 1 : end]
                if content[at] > len(before) or name <= before:
                    raise ValueError("names that are not sorted")
                names.append(name)
                at, before = end + 1, name
            if len(names) != min(BLOCK, self._number - BLOCK * block):
                raise ValueError(f"{len(names)} names in block {block}")
            return check_names([name.decode() for name in names], self._path)
