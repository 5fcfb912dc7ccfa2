"""What a broken compact map is refused by, when the broken part is read."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..utils.cli import InputError

ERRORS = (
    OSError,
    KeyError,
    ValueError,
    TypeError,
    IndexError,
    RecursionError,
    OverflowError,
    AttributeError,
    RuntimeError,
)


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Have errors in the content of a compact map refuse it.

    Raises:
        InputError: then.
    """
    try:
        yield
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"There is no map {path}.") from None
    except ERRORS as error:
        said = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise InputError(f"{path} is not a compact map, or broken ({said}).") from None
