"""What all command lines share: how a user's mistake ends a program."""

import argparse
import difflib
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from threading import Timer

from . import logger

NEAREST = 8  # names shown in place of an unknown one
INTERRUPTED = "Interrupted. The same command, but for any --overwrite, goes on from here."
STOPS = (signal.SIGINT, signal.SIGTERM)
REPEATED = 2.0  # seconds: `timeout` for one sends a signal twice


class InputError(ValueError):
    """Something the user gave is wrong; the message says what and how to mend it."""


def run(main: Callable[[], None]) -> None:
    """Run a command line: an error that a user can mend is one logged line and exit code 2.

    Ctrl-C, and a SIGTERM as of Slurm, end it as an error would, so that what is done is written.
    """
    try:
        for number in STOPS:
            signal.signal(number, _stop)
        sys.unraisablehook = _unraisable
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)
        # argparse would call a module by its file
        if spec := sys.modules["__main__"].__spec__:
            sys.argv[0] = f"python -m {spec.name.removesuffix('.__main__')}"
        main()
    except (InputError, OSError) as error:
        logger.error(error)
        sys.exit(2)
    except KeyboardInterrupt as interrupt:
        for number in STOPS:
            signal.signal(number, signal.SIG_IGN)
        logger.error(INTERRUPTED)
        sys.exit(128 + (interrupt.args[0] if interrupt.args else signal.SIGINT))


_stopped = -REPEATED  # the time of the last signal


def _stop(number: int, _) -> None:
    """Interrupt the main thread, but not while it writes what is done because of the same."""
    global _stopped
    if time.monotonic() - _stopped > REPEATED:
        _stopped = time.monotonic()
        raise KeyboardInterrupt(number)


def _unraisable(unraisable: "sys.UnraisableHookArgs") -> None:
    """Interrupt once more where Python has ignored it, as in a destructor."""
    global _stopped
    if isinstance(unraisable.exc_value, KeyboardInterrupt):
        _stopped = -REPEATED
        Timer(0.1, os.kill, (os.getpid(), *unraisable.exc_value.args)).start()  # not in here
    else:
        sys.__unraisablehook__(unraisable)


def while_importing() -> None:
    """Have Ctrl-C end `python -m` without a traceback in the seconds before `run` is called.

    A SIGTERM, which pycolmap would answer with a trace of its stack, waits for that.
    """
    # so it is while python looks for the module
    name = sys.orig_argv[-len(sys.argv)] if sys.argv[:1] == ["-m"] else ""
    if name.startswith(("hloc_reduce.", "pipelines.")):
        signal.signal(signal.SIGINT, _quit)
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})


def _quit(number: int, _) -> None:
    logger.error(INTERRUPTED)
    os._exit(128 + number)  # an exception would be any import's to handle


def choose(kind: str, name: str, names: Iterable[str]) -> str:
    """Return `name` if it is one of `names`, else raise an InputError with the nearest names."""
    names = list(names)
    if name not in names:
        by_lower = {known.lower(): known for known in names}
        near = difflib.get_close_matches(str(name).lower(), by_lower, n=NEAREST, cutoff=0)
        shown = ", ".join(by_lower[lower] for lower in near) or "none"
        there_are = "There are" if len(names) <= NEAREST else f"The nearest of {len(names)}"
        raise InputError(f"Unknown {kind} '{name}'. {there_are}: {shown}.")
    return name


def check_positive(args: argparse.Namespace, *names: str) -> None:
    """Raise an InputError if an option is not above 0."""
    for name in names:
        if not getattr(args, name) > 0:
            raise InputError(f"--{name} {getattr(args, name)}: at least 1.")


def check_folder(path: Path) -> None:
    """Raise an InputError if a folder for results cannot be made, as a file has its name."""
    for part in (path, *path.parents):
        if part.exists() and not part.is_dir():
            raise InputError(f"{part} is a file: choose a folder for the results.")


def check_file(path: Path, what: str) -> None:
    """Raise an InputError if a file cannot be written, as a folder has its name."""
    if path.is_dir():
        raise InputError(f"{path} is a folder: name {what} in it.")
    check_folder(path.parent)


def some(names: Iterable[str], number: int = 5) -> str:
    """Name the first few of many."""
    names = list(names)
    return ", ".join(names[:number]) + (", ..." if len(names) > number else "")


class HelpFormatter(argparse.ArgumentDefaultsHelpFormatter):
    """Shows defaults, except of options that have none, and keeps an example on its line."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if text.startswith("example: "):
            return text
        return super()._fill_text(text, width, indent)

    def _get_help_string(self, action: argparse.Action) -> str:
        if action.default is None or action.default is False or action.default == []:
            return action.help
        return super()._get_help_string(action)
