"""Frozen projections of descriptors."""

from typing import TYPE_CHECKING

from .files import checksum, find, levels, names, split_prefix

if TYPE_CHECKING:
    from pathlib import Path

    from .network import Projection

__all__ = ["checksum", "find", "levels", "load", "names", "split_prefix"]


def load(projection: "str | Path") -> "Projection":
    """Load a shipped projection by its name, or another one by the path of its file.

    Returns:
        The projection, frozen and folded, float32, on the CPU.

    Raises:
        InputError: when the file is missing or is not a projection.
    """
    from . import network

    return network.load(projection)
