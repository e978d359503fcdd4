"""What all commands share: exit codes, errors in one line that a terminal cannot mistake, and how signals end them."""

from __future__ import annotations

import _thread
import argparse
import contextlib
import difflib
import errno
import gc
import io
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any, NoReturn

from warp_ar.begin import EXIT_INTERRUPTED, EXIT_TERMINATED, end_at_once, handling
from warp_ar.errors import SinkError, UsageError, WarpArError, reason, say
from warp_ar.output.sink import close_open_sinks

EXIT_DONE = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_PIPE = 141
"""Nobody reads what is printed any more."""

_LARGEST = 2**31 - 1
"""Largest whole number of an argument: they count frames, samples, pixels, ports."""


class Parser(argparse.ArgumentParser):
    """Argument parser whose errors are one line, as all errors here are."""

    def error(self, message: str) -> NoReturn:
        """Tell what is wrong with an argument.

        Raises:
            UsageError: Always, with the message in one line.
        """
        unknown = re.match(r"unrecognized arguments: (--[^\s=]+)", message)
        known = [option for option in _options(self) if unknown is None or option != unknown[1]]
        meant = difflib.get_close_matches(unknown[1], known, n=1, cutoff=0.75) if unknown else []
        hint = f"; did you mean {meant[0]}?" if meant else ""
        raise UsageError(f"{message}{hint}; see {self.prog} --help")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse does it, but nothing empty (a path of no name is the current folder) and no endless number.

        Raises:
            UsageError: An argument is empty, or a number has too many digits.
        """
        given = list(sys.argv[1:] if args is None else args)
        for place, word in enumerate(given):
            if word == "" or (word is not None and re.fullmatch(r"--[a-z0-9-]+=", word)):
                before = given[place - 1] if place and str(given[place - 1]).startswith("-") else "an argument"
                raise UsageError(f"{word.rstrip('=') or before} is empty; give it a value, or leave it out")
        found, rest = super().parse_known_args(given, namespace)
        for action in self._actions:
            value = getattr(found, action.dest, None)
            if isinstance(value, int) and abs(value) > _LARGEST:
                name = action.option_strings[-1] if action.option_strings else action.dest
                digits = len(str(abs(value)))
                raise UsageError(f"{name}: a number of {digits} digits; expected {_LARGEST:,} at most")
        return found, rest


def _options(parser: argparse.ArgumentParser) -> list[str]:
    """All options of a parser and of its commands."""
    found = list(parser._option_string_actions)
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                found += _options(command)
    return found


class Terminated(KeyboardInterrupt):
    """The process was asked to end by SIGTERM or SIGHUP; it does so as after Ctrl-C."""


def run_command(command: Callable[[], int], failures: type[WarpArError] | tuple[type[WarpArError], ...] = ()) -> int:
    """Run a command; what a user can cause is one line, and a signal ends it in order.

    Args:
        command: Returns the exit code.
        failures: Errors that mean a failure while running, not wrong usage.

    Returns:
        The exit code.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal that cannot show a letter gets its number
            stream.reconfigure(errors="backslashreplace")
    try:
        with ended_by_signals():
            code = command()
            if sys.stdout is not None:
                sys.stdout.flush()
            return code
    except failures as error:
        say(error)
        return EXIT_FAILED
    except WarpArError as error:
        say(error)
        return EXIT_USAGE
    except Terminated:
        return EXIT_TERMINATED
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except MemoryError as error:
        say(f"there is not enough memory: {reason(error)}")
        return EXIT_FAILED
    except OSError as error:
        if _folder_is_gone():
            say("the current folder is gone; run this in another one")
            return EXIT_USAGE
        if error.filename is not None or error.errno not in (errno.EPIPE, errno.ENOSPC):
            raise
        _drop_output()
        if error.errno == errno.EPIPE:
            return EXIT_PIPE
        say(f"what this command prints cannot be written: {reason(error)}")
        return EXIT_FAILED


def _folder_is_gone() -> bool:
    """Return True if the folder that this process runs in was deleted."""
    try:
        os.getcwd()
    except FileNotFoundError:
        return True
    return False


def _drop_output() -> None:
    """Let what is still to be printed go nowhere: Python would try again at its end, and complain."""
    with contextlib.suppress(AttributeError, OSError, ValueError), open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), sys.stdout.fileno())


@contextlib.contextmanager
def loading() -> Iterator[Callable[[], None]]:
    """Leave Python's garbage collector off until the function that is yielded is called, at the latest until the end.

    Next to nothing of what is imported and built once is garbage; looking through it again and again takes a sixth of
    the time to the first picture. From then on it is not looked through either.
    """
    was_on = gc.isenabled()
    gc.disable()

    def loaded() -> None:
        gc.freeze()
        if was_on:
            gc.enable()

    try:
        yield loaded
    finally:
        gc.unfreeze()
        if was_on:
            gc.enable()


_TAKES_A_LOCK = frozenset(
    getattr(threading.Condition, name).__code__
    for name in ("__enter__", "__exit__", "_is_owned", "_release_save", "_acquire_restore")
)
"""Functions of Python's own, of futures, events and queues, in which an exception leaves a lock taken that nobody gives
back: who waits for it afterwards waits for ever."""
_WAITS = threading.Condition.wait.__code__
_WAITING = "gotit"
"""The variable that is set in ``Condition.wait`` once it puts the lock back whatever comes."""
_SOON = 0.001
"""Seconds after which a signal that came in one of them is sent again."""


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Have SIGTERM and SIGHUP unwind the stack as Ctrl-C does, so that files are closed and folders removed.

    Once: who is ending already is not interrupted by the next of them. A signal that arrives where Python drops what is
    raised, in a finaliser or as native code calls back, or where Python is taking a lock, is sent again, Ctrl-C too.
    """
    ending, hook = False, sys.unraisablehook
    numbers: list[int] = []

    def end(number: int, frame: FrameType | None) -> None:
        nonlocal ending
        if ending:
            return
        if _takes_a_lock(frame):
            _send_soon(number)
            return
        ending = True
        numbers.append(number)
        raise Terminated

    def interrupt(number: int, frame: FrameType | None) -> None:
        if _takes_a_lock(frame):
            _send_soon(number)
            return
        raise KeyboardInterrupt

    def send_again(dropped: Any) -> None:
        nonlocal ending
        if not isinstance(dropped.exc_value, (Terminated, KeyboardInterrupt)):
            hook(dropped)
            return
        ending = False
        _send_soon(numbers[-1] if isinstance(dropped.exc_value, Terminated) else signal.SIGINT)

    ctrl_c = ("SIGINT",) if signal.getsignal(signal.SIGINT) in (signal.default_int_handler, end_at_once) else ()
    with handling(end, "SIGTERM", "SIGHUP"), handling(interrupt, *ctrl_c):
        sys.unraisablehook = send_again
        try:
            yield
        except BaseException:
            ending = True
            with contextlib.suppress(SinkError):  # what came first is told
                close_open_sinks()
            raise
        finally:
            sys.unraisablehook = hook
        ending = True


def _takes_a_lock(frame: FrameType | None) -> bool:
    """Whether what a signal interrupts is in the midst of taking a lock, or of giving it back."""
    while frame is not None:
        code = frame.f_code
        if code in _TAKES_A_LOCK:
            return True
        if code is _WAITS and _WAITING in code.co_varnames and _WAITING not in frame.f_locals:
            return True
        frame = frame.f_back
    return False


def _send_soon(number: int) -> None:
    """Send a signal to the main thread once it has gone on."""

    def send() -> None:
        time.sleep(_SOON)
        if hasattr(signal, "pthread_kill"):
            signal.pthread_kill(threading.main_thread().ident or 0, number)
        else:
            signal.raise_signal(number)

    # Not by the class `Thread`: that takes locks, and this runs wherever a signal has come.
    _thread.start_new_thread(send, ())
