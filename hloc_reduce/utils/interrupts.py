"""How Ctrl-C and SIGTERM end a command: as an error does, so that what is done is written."""

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
INTERRUPTED = "Interrupted. The same command, but for any --overwrite, goes on from here."
STOPS = (signal.SIGINT, signal.SIGTERM)
COMMANDS = ("hloc_reduce.", "pipelines.")  # how their modules' names begin
REPEATED = 2.0  # seconds: `timeout` for one sends a signal twice
logger = logging.getLogger("hloc_reduce")

_stopped = -REPEATED  # the time of the last signal
_calls: list[Thread] = []  # of `interruptible`


def while_importing() -> None:
    """Have Ctrl-C end `python -m` without a traceback in the seconds before `hear` is called.

    A SIGTERM, which pycolmap would answer with a trace of its stack, waits for that.
    """
    # so it is while python looks for the module
    name = sys.orig_argv[-len(sys.argv)] if sys.argv[:1] == ["-m"] else ""
    if name.startswith(COMMANDS):
        signal.signal(signal.SIGINT, _quit)
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})


def _quit(number: int, _: object) -> NoReturn:
    logger.error(INTERRUPTED)
    os._exit(128 + number)  # an exception would be any import's to handle


def hear() -> None:
    """Have both signals raise a KeyboardInterrupt with their number in the main thread."""
    for number in STOPS:
        signal.signal(number, _stop)
    sys.unraisablehook = _unraisable
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)


def ignore() -> None:
    """Have both signals do nothing any more: all is done."""
    for number in STOPS:
        signal.signal(number, signal.SIG_IGN)


def end(interrupt: KeyboardInterrupt) -> NoReturn:
    """Say how to go on, and end the process with the code of the signal."""
    ignore()
    logger.error(INTERRUPTED)
    code = 128 + (interrupt.args[0] if interrupt.args else signal.SIGINT)
    if any(thread.is_alive() for thread in _calls):  # which cannot be stopped otherwise
        sys.stdout.flush()
        os._exit(code)
    sys.exit(code)


def interruptible(function: Callable[..., Result], *arguments: object, **options: object) -> Result:
    """Call a function that takes minutes outside of Python, where no signal would be heard."""
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
    """Have both signals wait for the end of a block; their handlers are then as they were."""
    came: list[int] = []
    handlers: dict[int, object] = {}
    if threading.current_thread() is threading.main_thread():
        for number in STOPS:
            if signal.getsignal(number) is not None:
                handlers[number] = signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number in came[:1]:
            signal.raise_signal(number)


def _stop(number: int, _: object) -> None:
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
