"""What all command lines share: how errors that a user can mend end a program."""

import argparse
import difflib
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .. import logger
from . import interrupts

# packages that an installation for a robot leaves out
LEFT_OUT = ("kornia", "sklearn", "torch")
# an unknown name is answered by all that are known, or by the nearest ones of many
MAX_LISTED_NAMES, NEAREST_NAMES = 30, 8


class InputError(ValueError):
    """A user's input is wrong; the message says what is wrong and how to mend it."""


def run(main: Callable[[], None]) -> None:
    """Run a command line: an error that a user can mend is one logged line and exit code 2.

    So is a package that is missing where the project was installed without all of its dependencies.

    Ctrl-C and SIGTERM (as from Slurm) end it like an error, so that finished work is written.
    """
    try:
        interrupts.hear()
        # argparse would name a module by its file
        spec = sys.modules["__main__"].__spec__
        module = spec and f"-m {spec.name.removesuffix('.__main__')}"
        sys.argv[0] = f"python {module or sys.argv[0]}"
        main()
        if spec and spec.name.startswith(interrupts.COMMAND_PREFIXES):
            interrupts.ignore()
    except BrokenPipeError:  # a pager or `head` has read enough
        sys.stdout = None
        sys.exit(1)
    except InputError as error:
        logger.error(error)
        sys.exit(2)
    except ModuleNotFoundError as error:
        if error.name not in LEFT_OUT:
            raise
        logger.error(f"This needs {error.name}, which is not installed: pip install {error.name}.")
        sys.exit(2)
    except OSError as error:
        file = error.filename2 or error.filename
        logger.error(f"{file}: {error.strerror}." if file and error.strerror else error)
        sys.exit(2)
    except KeyboardInterrupt as interrupt:
        interrupts.end(interrupt)


def choose(kind: str, name: str, names: Iterable[str]) -> str:
    """Return `name` if it is one of `names`, else raise an InputError.

    The message lists the names, the nearest first: all of up to `MAX_LISTED_NAMES`, else
    `NEAREST_NAMES`.
    """
    names = list(names)
    if name not in names:
        by_lower = {known.lower(): known for known in names}
        number = NEAREST_NAMES if len(names) > MAX_LISTED_NAMES else max(1, len(names))
        near = difflib.get_close_matches(str(name).lower(), by_lower, n=number, cutoff=0)
        shown = ", ".join(by_lower[lower] for lower in near) or "none"
        there_are = f"The nearest of {len(names)}" if len(names) > MAX_LISTED_NAMES else "There are"
        raise InputError(f"Unknown {kind} '{name}'. {there_are}: {shown}.")
    return name


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Have each InputError name a file."""
    try:
        yield
    except InputError as error:
        raise error if str(path) in str(error) else InputError(f"{path}: {error}") from None


def check_positive(args: argparse.Namespace, *names: str) -> None:
    """Raise an InputError if an option is not above 0."""
    for name in names:
        if not getattr(args, name) > 0:
            raise InputError(f"--{name} {getattr(args, name)}: at least 1.")


def no_folder(path: Path) -> InputError:
    """Return the error for a missing folder."""
    return InputError(
        f"{path} is a file, not a folder." if path.exists() else f"There is no folder {path}."
    )


def check_folder(path: Path) -> None:
    """Raise an InputError if a file prevents a folder for results from being created."""
    for part in (path, *path.parents):
        if part.exists() and not part.is_dir():
            raise InputError(f"{part} is a file: choose a folder for the results.")


def make_folder(path: Path) -> None:
    """Create a folder for results, and its parents, unless it exists.

    Raises:
        InputError: if there is a file in its place.
    """
    check_folder(path)
    path.mkdir(parents=True, exist_ok=True)


def check_file(path: Path, what: str = "a file") -> None:
    """Raise an InputError if a folder prevents a file from being written."""
    if path.is_dir():
        raise InputError(f"{path} is a folder: name {what} in it.")
    check_folder(path.parent)


def some(names: Iterable[str], number: int = 5) -> str:
    """Join the first few of many names."""
    names = list(names)
    return ", ".join(names[:number]) + (", ..." if len(names) > number else "")


class Parser(argparse.ArgumentParser):
    """A command line. Its options must be spelled out, and its help ends with an example.

    Args:
        description: what the command does, such as the docstring of its module.
        example: arguments to show.
        settings: further arguments of argparse's parser.
    """

    def __init__(self, description: str | None, example: str = "", **settings: Any):
        super().__init__(
            description=description,
            epilog=f"example: %(prog)s {example}" if example else None,
            formatter_class=HelpFormatter,
            allow_abbrev=False,
            **{"prog": sys.argv[0], **settings},
        )


class HelpFormatter(argparse.ArgumentDefaultsHelpFormatter):
    """Shows the defaults of options that have one, and keeps an example on one line."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if text.startswith("example: "):
            return text
        return super()._fill_text(text, width, indent)

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if action.default is None or action.default is False or action.default == []:
            return action.help
        return super()._get_help_string(action)
