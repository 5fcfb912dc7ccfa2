"""The best dot products of rows of integers, by compiled code where it was built.

The code is `best_two.cpp`, which an installation compiles if it finds a compiler.
"""

import ctypes
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any

import numpy as np


@cache
def _library() -> ctypes.CDLL | None:
    """Load the compiled code, if it was built for this machine."""
    for suffix in reversed(EXTENSION_SUFFIXES):  # what serves all versions of Python first
        path = Path(__file__).with_name(f"_best_two{suffix}")
        if path.exists():
            try:
                return _load(path)
            except OSError:  # built on another machine
                return None
    return None


def _load(path: Path) -> ctypes.CDLL:
    """Load a compiled best_two.cpp."""
    library = ctypes.CDLL(str(path))
    library.best_two_name.restype = ctypes.c_char_p
    matrix = np.ctypeslib.ndpointer(np.int16, ndim=2, flags="C_CONTIGUOUS")
    found = np.ctypeslib.ndpointer(np.int32, ndim=1, flags="C_CONTIGUOUS")
    size = ctypes.c_int64
    arguments: list[Any] = [ctypes.c_int, matrix, size, matrix, size, size]
    for search in (library.best_two, library.best_both):
        search.argtypes = [*arguments, found, found, found]
        search.restype = None
    return library


@cache
def _numbers() -> dict[str, int]:
    """Return the instruction sets of this processor that there is code for, fastest first."""
    library, numbers = _library(), {}
    if library is not None:
        for number in range(8):
            name = library.best_two_name(number)
            if name is None:
                break
            if name:
                numbers[name.decode()] = number
    return numbers


def instructions() -> list[str]:
    """Return the instruction sets that `best_two` can use here, fastest first.

    Empty if nothing was compiled.
    """
    return list(_numbers())


def best_two(
    rows0: np.ndarray, rows1: np.ndarray, instruction_set: str | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the best two of rows1 for every row of rows0, by their dot products.

    Args:
        rows0: (N, D) int16.
        rows1: (M, D) int16, M > 0; all products are between -2**30 and 2**30.
        instruction_set: one of `instructions`, which must not be empty; default: the fastest.

    Returns:
        The index of the row with the largest product (N,) int32, the first of equal ones; that
        product (N,) int32; and the second largest (N,) int32, the lowest int32 if M is 1.
    """
    return _search("best_two", rows0, rows1, instruction_set, (len(rows0),) * 3)


def best_both(
    rows0: np.ndarray, rows1: np.ndarray, instruction_set: str | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the best row of the other side for every row of both, by their dot products.

    Args:
        rows0: (N, D) int16, N > 0.
        rows1: (M, D) int16, M > 0, as for `best_two`.
        instruction_set: as for `best_two`.

    Returns:
        For every row of rows0 the index of the row of rows1 with the largest product (N,) int32,
        the first of equal ones, and that product (N,) int32; and for every row of rows1 the index
        of its row of rows0 (M,) int32.
    """
    return _search("best_both", rows0, rows1, instruction_set, (len(rows0), len(rows0), len(rows1)))


def _search(
    name: str,
    rows0: np.ndarray,
    rows1: np.ndarray,
    instruction_set: str | None,
    sizes: tuple[int, int, int],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Call a function of the library, which writes three arrays (sizes,) int32."""
    numbers, library = _numbers(), _library()
    number = numbers[instruction_set or next(iter(numbers))]
    assert library is not None and rows0.shape[1] == rows1.shape[1] and len(rows1)
    rows0, rows1 = np.ascontiguousarray(rows0), np.ascontiguousarray(rows1)
    (number0, dim), number1 = rows0.shape, len(rows1)
    first, second, third = (np.empty(size, np.int32) for size in sizes)
    getattr(library, name)(number, rows0, number0, rows1, number1, dim, first, second, third)
    return first, second, third
