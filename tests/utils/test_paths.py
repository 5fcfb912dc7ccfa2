"""Strings are taken for paths, as by hloc."""

import inspect
from pathlib import Path

import pytest

from hloc_reduce.utils.paths import strings_as_paths


def test_strings_are_taken_where_paths_are_expected():
    @strings_as_paths
    def function(a: Path, b: Path | None = None, c: Path | str = "c", *, d: str = "d", e: int = 1):
        """Say what it was given."""
        return a, b, c, d, e

    assert function("a") == (Path("a"), None, "c", "d", 1)
    assert function("a", b="b", d="x", e=2) == (Path("a"), Path("b"), "c", "x", 2)
    assert function(Path("a"), None, Path("c")) == (Path("a"), None, Path("c"), "d", 1)
    assert inspect.signature(function).parameters["b"].annotation == Path | None
    assert function.__name__ == "function" and function.__doc__ == "Say what it was given."
    with pytest.raises(TypeError, match="missing a required argument: 'a'"):
        function(b="b")
