"""What all command lines share: how a user's mistake ends a program."""

import argparse
import difflib
import sys
from collections.abc import Callable, Iterable

from . import logger


class InputError(ValueError):
    """Something the user gave is wrong; the message says what and how to mend it."""


def run(main: Callable[[], None]) -> None:
    """Run a command line: an error that a user can mend is one logged line and exit code 2."""
    try:
        main()
    except (InputError, OSError) as error:
        logger.error(error)
        sys.exit(2)
    except KeyboardInterrupt:
        logger.error("Interrupted. Run it again, without --overwrite, to go on from here.")
        sys.exit(130)


def choose(kind: str, name: str, names: Iterable[str]) -> str:
    """Return `name` if it is one of `names`, else raise an InputError, nearest names first."""
    names = list(names)
    if name not in names:
        near = difflib.get_close_matches(str(name), names, n=len(names) or 1, cutoff=0)
        raise InputError(f"Unknown {kind} '{name}'. There are: {', '.join(near) or 'none'}.")
    return name


class HelpFormatter(argparse.ArgumentDefaultsHelpFormatter):
    """Shows defaults, except of options that have none, and keeps an example on its line."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if text.startswith("example: "):
            return text
        return super()._fill_text(text, width, indent)

    def _get_help_string(self, action: argparse.Action) -> str:
        if action.default in (None, False):
            return action.help
        return super()._get_help_string(action)
