"""Start of ``python -m warp_ar.COMMAND``: handles signals before the slow imports.

The file of a command begins with a guard that calls this module. Python loads the file as ``__main__`` and runs it no
further than the guard; the file is then imported under its own name. This module imports only modules that Python has
loaded already or that load at once.
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
"""Seconds of importing after which a line says that libraries are being loaded."""


def begin(name: str) -> NoReturn:
    """Import the module of a command, run its ``main``, and end the process with the exit code that it returns."""
    # NumPy's BLAS starts a thread for each core, which does not pay for the small products here.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if sys.stderr is None:
        # The parent closed stderr (2>&-). The next file that is opened would get its number, and the error messages.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        sys.stderr = os.fdopen(2, "w")
    faulthandler.enable()  # a crash of native code then prints the Python stack
    # These handlers stay: when the command is done, nothing is left that an exception would have to clean up.
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
    """Run the installed program ``warp-ar``, which is the command ``python -m warp_ar.live``."""
    begin("warp_ar.live")


@contextlib.contextmanager
def importing() -> Iterator[None]:
    """Context of slow imports while nothing is open: a signal ends the process, and a slow import prints a line.

    A signal handler that raises would not do: native code that is being loaded turns the exception into another error,
    or drops it.
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
    """Return the names of the signals that end this process; signals that the parent set to be ignored are left out."""
    names = [name for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    return [name for name in names if signal.getsignal(getattr(signal, name)) is not signal.SIG_IGN]


def end_at_once(number: int, _: object) -> NoReturn:
    """Handle a signal by ending the process at once: nothing has to be closed or removed."""
    os._exit(EXIT_INTERRUPTED if number == signal.SIGINT else EXIT_TERMINATED)


@contextlib.contextmanager
def handling(handler: Any, *names: str) -> Iterator[None]:
    """Handle the named signals, where the system has them, within this context; outside the main thread do nothing."""
    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in (getattr(signal, name) for name in names if hasattr(signal, name)):
            # A process that was started to outlive its terminal (nohup) goes on ignoring SIGHUP.
            if signal.getsignal(number) is not signal.SIG_IGN or number == signal.SIGINT:
                before[number] = signal.signal(number, handler)
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


def leave(code: int) -> NoReturn:
    """End the process of a command without Python's last garbage collection, which takes half a second."""
    gc.freeze()
    sys.exit(code)
