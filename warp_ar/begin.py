"""Start of ``python -m warp_ar.COMMAND``: signals are handled before anything is imported that takes its time.

A command's file begins with its guard, which comes here. What Python has loaded as ``__main__`` goes no further; the
file is imported under its own name. This module imports nothing but what Python itself has loaded, or loads at once.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import importlib
import os
import signal
import sys
import threading

TYPE_CHECKING = False  # see the package's
if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Any, Final, NoReturn

EXIT_INTERRUPTED: Final = 130
EXIT_TERMINATED: Final = 143

PATIENCE = 2.0
"""Seconds of importing after which it is said what takes so long."""


def begin(name: str) -> NoReturn:
    """Import the module of a command, run its ``main``, and end the process with the exit code that it returns."""
    # NumPy's BLAS: products here are small, and would otherwise be shared among a thread for each core.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if sys.stderr is None:
        # Closed by whoever started this (2>&-). The next file that is opened would take its place, and get its lines.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        sys.stderr = os.fdopen(2, "w")
    faulthandler.enable()  # should native code crash, the report says what it was at
    # For good: when the command is done there is nothing either that an exception would put in order.
    for signal_name in _heeded():
        signal.signal(getattr(signal, signal_name), end_at_once)
    try:
        with importing():
            module = importlib.import_module(name)
    except MemoryError:
        print("warp_ar: there is not enough memory to load the libraries", file=sys.stderr)
        sys.exit(1)
    leave(module.main())


def live() -> NoReturn:
    """``warp-ar``, the program that is installed: ``python -m warp_ar.live``."""
    begin("warp_ar.live")


@contextlib.contextmanager
def importing() -> Iterator[None]:
    """Context of slow imports while nothing is open: a signal ends the process, and a slow import prints a line.

    An exception would not do: native code, as it is loaded, turns it into another error, or drops it.
    """
    slow = None
    if sys.stderr is not None and sys.stderr.isatty():
        slow = threading.Timer(PATIENCE, print, ("warp_ar: loading libraries",), {"file": sys.stderr})
        slow.daemon = True
        slow.start()
    try:
        with handling(end_at_once, *_heeded()):
            yield
    finally:
        if slow is not None:
            slow.cancel()
            slow.join()


def _heeded() -> list[str]:
    """Signals that end a process, without those that its parent has it ignore, as a shell does in the background."""
    names = [name for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    return [name for name in names if signal.getsignal(getattr(signal, name)) is not signal.SIG_IGN]


def end_at_once(number: int, _: object) -> NoReturn:
    """Handler of a signal where there is nothing to close and nothing to remove."""
    os._exit(EXIT_INTERRUPTED if number == signal.SIGINT else EXIT_TERMINATED)


@contextlib.contextmanager
def handling(handler: Any, *names: str) -> Iterator[None]:
    """Handle the signals of these names where there are such; elsewhere than in the main thread nothing is changed."""
    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in (getattr(signal, name) for name in names if hasattr(signal, name)):
            # Who was started to outlive its terminal (nohup) goes on doing so.
            if signal.getsignal(number) is not signal.SIG_IGN or number == signal.SIGINT:
                before[number] = signal.signal(number, handler)
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


def leave(code: int) -> NoReturn:
    """End the process of a command: Python does not look for garbage in what goes anyway, for half a second."""
    gc.freeze()
    sys.exit(code)
