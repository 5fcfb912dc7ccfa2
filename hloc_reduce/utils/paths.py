"""Strings instead of paths, as in hloc."""

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import ParamSpec, TypeVar

from .options import kind_of

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def strings_as_paths(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Let a function take strings for paths.

    A string is converted if the annotation has `Path` but not `str`, such as `Path | None`. With
    `Path | str` the function itself distinguishes them.
    """
    signature = inspect.signature(function)
    kinds = {name: kind_of(given.annotation)[0] for name, given in signature.parameters.items()}
    paths = [name for name, kind in kinds.items() if kind is Path]

    @wraps(function)
    def convert(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        given = signature.bind(*args, **kwargs)
        for name in paths:
            if isinstance(given.arguments.get(name), str):
                given.arguments[name] = Path(given.arguments[name])
        return function(*given.args, **given.kwargs)

    return convert
