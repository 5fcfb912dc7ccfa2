"""The file around the arrays of a compact map, as safetensors has it: read by mmap, or streamed."""

import json
import math
import mmap
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

TYPES = {"U8": "<u1", "U16": "<u2", "U32": "<u4", "I32": "<i4"}
TYPES |= {"F16": "<f2", "F32": "<f4", "F64": "<f8"}
NAMES = {np.dtype(kind): name for name, kind in TYPES.items()}
MAX_HEADER = 10**8  # bytes, as in safetensors
MAX_DIMENSIONS = 8


class Blocks(NamedTuple):
    """An array that is written block by block.

    Args:
        dtype: its type.
        shape: its shape.
        blocks: its parts, one after the other, of this type.
    """

    dtype: np.dtype
    shape: tuple[int, ...]
    blocks: Iterable[np.ndarray]

    @property
    def nbytes(self) -> int:
        """Its size."""
        return self.dtype.itemsize * math.prod(self.shape)


def read(path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """Open a file: only its header is read.

    Returns:
        The metadata, and the arrays, in which bytes are read from the file when they are used.

    Raises:
        OSError, ValueError, TypeError, KeyError, AttributeError or RecursionError: when it is
            missing or not such a file.
    """
    with path.open("rb") as file:
        content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    size = int.from_bytes(content[:8], "little")
    begin = 8 + size
    if not 0 < size <= min(MAX_HEADER, len(content) - 8):
        raise ValueError(f"a header of {size} bytes")
    header = json.loads(content[8:begin].decode())
    metadata, arrays = header.pop("__metadata__", {}), {}
    for name, entry in header.items():
        kind, shape = np.dtype(TYPES[entry["dtype"]]), [*entry["shape"]]
        first, last = entry["data_offsets"]
        if not all(type(number) is int and number >= 0 for number in (first, last, *shape)):
            raise ValueError(f"{name} of shape {shape} at {first}")
        number = math.prod(shape[:MAX_DIMENSIONS])
        fits = number * kind.itemsize == last - first and len(shape) <= MAX_DIMENSIONS
        if not fits or last > len(content) - begin:
            raise ValueError(f"{name} of shape {shape} from {first} to {last}")
        arrays[name] = np.frombuffer(content, kind, number, begin + first).reshape(shape)
    return metadata, arrays


def read_by_pages(array: np.ndarray) -> None:
    """Have the system read only those pages of an array from its file that are used."""
    content: object = array
    while isinstance(content, np.ndarray):
        content = content.base
    if isinstance(content, memoryview):
        content = content.obj
    if isinstance(content, mmap.mmap) and hasattr(mmap, "MADV_RANDOM"):
        begin = array.ctypes.data - np.frombuffer(content, np.uint8).ctypes.data
        inside = begin % mmap.PAGESIZE
        content.madvise(mmap.MADV_RANDOM, begin - inside, array.nbytes + inside)


def write(
    file: BinaryIO, metadata: Mapping[str, str], arrays: Mapping[str, np.ndarray | Blocks]
) -> int:
    """Write a file; return the number of bytes of its header.

    Args:
        file: where to.
        metadata: of the header.
        arrays: the longest types first, so that all are aligned.
    """
    header: dict[str, object] = {"__metadata__": dict(metadata)}
    end = 0
    for name, array in arrays.items():
        begin, end = end, end + array.nbytes
        header[name] = {
            "dtype": NAMES[array.dtype],
            "shape": [*array.shape],
            "data_offsets": [begin, end],
        }
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    file.write(len(text).to_bytes(8, "little") + text)
    for name, array in arrays.items():
        written = 0
        for block in array.blocks if isinstance(array, Blocks) else [array]:
            written += file.write(np.ascontiguousarray(block, array.dtype).data)
        if written != array.nbytes:
            raise ValueError(f"{written} bytes of {name} were written, not {array.nbytes}")
    return 8 + len(text)
