"""Ctrl-C and SIGTERM end a command like an error, so that finished work is written."""

import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from threading import Thread, Timer
from typing import NoReturn, TypeVar

Result = TypeVar("Result")
INTERRUPTED = "Interrupted. Run the same command again, without --overwrite, to resume."
STOPS = (signal.SIGINT, signal.SIGTERM)
COMMAND_PREFIXES = ("hloc_reduce.", "pipelines.")  # of modules
REPEATED = 2.0  # seconds within which a second signal is ignored: `timeout` sends two
logger = logging.getLogger("hloc_reduce")

_stopped = -REPEATED  # the time of the last signal
_calls: list[Thread] = []  # running calls of `interruptible`


def while_importing() -> None:
    """Let Ctrl-C end `python -m` without a traceback before `hear` is called.

    SIGTERM, for which pycolmap would print a stack trace, waits until then.
    """
    # while Python looks for the module, argv still begins with -m
    name = sys.orig_argv[-len(sys.argv)] if sys.argv[:1] == ["-m"] else ""
    if name.startswith(COMMAND_PREFIXES):
        signal.signal(signal.SIGINT, _quit)
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})


def _quit(number: int, _: object) -> NoReturn:
    logger.error(INTERRUPTED)
    os._exit(128 + number)  # an import might handle an exception


def hear() -> None:
    """Make both signals raise a KeyboardInterrupt with their number in the main thread."""
    for number in STOPS:
        signal.signal(number, _stop)
    sys.unraisablehook = _unraisable
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)


def ignore() -> None:
    """Make both signals do nothing: the command is done."""
    for number in STOPS:
        signal.signal(number, signal.SIG_IGN)


def end(interrupt: KeyboardInterrupt) -> NoReturn:
    """Say how to resume, and end the process with the signal's exit code."""
    ignore()
    logger.error(INTERRUPTED)
    code = 128 + (interrupt.args[0] if interrupt.args else signal.SIGINT)
    if any(thread.is_alive() for thread in _calls):  # nothing else stops them
        sys.stdout.flush()
        os._exit(code)
    # a KeyboardInterrupt that left code in a string, as dataclasses and torch execute, would make
    # `python -m` end by SIGINT whatever its exit code; Python forgets it at the next such code
    exec("")
    sys.exit(code)


def interruptible(function: Callable[..., Result], *arguments: object, **options: object) -> Result:
    """Call a function that spends minutes outside of Python, where signals would not be heard."""
    result: Future[Result] = Future()

    def call() -> None:
        try:
            result.set_result(function(*arguments, **options))
        except BaseException as error:
            result.set_exception(error)

    thread = Thread(target=call, daemon=True)
    _calls.append(thread)
    thread.start()
    try:
        return result.result()
    finally:
        if result.done():
            _calls.remove(thread)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Make both signals wait for the end of a block; then restore their handlers."""
    came: list[int] = []
    in_main_thread = threading.current_thread() is threading.main_thread()
    handlers = {
        stop: signal.signal(stop, lambda number, _: came.append(number))
        for stop in STOPS
        if in_main_thread and signal.getsignal(stop) is not None
    }
    try:
        yield
    finally:
        for stop, handler in reversed(handlers.items()):  # Ctrl-C last: until then it waits
            signal.signal(stop, handler)
        for number in came[:1]:
            signal.raise_signal(number)


def _stop(number: int, _: object) -> None:
    """Interrupt the main thread, but not again while it writes finished work."""
    global _stopped
    if time.monotonic() - _stopped > REPEATED:
        _stopped = time.monotonic()
        raise KeyboardInterrupt(number)


def _unraisable(unraisable: "sys.UnraisableHookArgs") -> None:
    """Repeat an interrupt that Python has ignored, as in a destructor."""
    global _stopped
    if isinstance(unraisable.exc_value, KeyboardInterrupt):
        _stopped = -REPEATED
        Timer(0.1, os.kill, (os.getpid(), *unraisable.exc_value.args)).start()  # not in here
    else:
        sys.__unraisablehook__(unraisable)
