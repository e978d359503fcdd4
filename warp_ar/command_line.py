"""Common parts of all commands: options, exit codes, signals, and errors printed in one printable line."""

from __future__ import annotations

import _thread
import argparse
import contextlib
import difflib
import errno
import io
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, NoReturn

from warp_ar.begin import EXIT_INTERRUPTED, EXIT_TERMINATED, end_at_once, handling
from warp_ar.errors import SinkError, UsageError, WarpArError, causes, reason, say
from warp_ar.output.sink import close_open_sinks
from warp_ar.scene import Scene, bundled_scenes
from warp_ar.scene.description import LATLONG_AXES

EXIT_DONE = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_PIPE = 141
"""Exit code if the reader of the printed output has closed its end of the pipe."""

LARGEST: Final = 2**31 - 1
"""Largest integer that an option accepts; such options count frames, samples, pixels or ports."""


def number(low: float, high: float, words: str, kind: Callable[[str], Any] = float) -> Callable[[str], Any]:
    """Return a parser for a numeric argument from ``low`` to ``high``; ``words`` are the message's expected value."""

    def read(text: str) -> Any:
        with contextlib.suppress(ValueError, ZeroDivisionError):
            if low <= (value := kind(text)) <= high:
                return value
        raise argparse.ArgumentTypeError(f"{text}: expected {words}")

    return read


def ending(*suffixes: str) -> Callable[[str], Path]:
    """Return a parser for a file argument that has one of these suffixes."""

    def read(text: str) -> Path:
        if (path := Path(text)).suffix.lower() not in suffixes:
            raise argparse.ArgumentTypeError(f"{text}: expected a name that ends in {', '.join(suffixes)}")
        return path

    return read


LEAST: Final = 1e-9
"""Least value of arguments that must be above 0."""
count = number(1, LARGEST, f"1 or more, {LARGEST:,} at most", int)
"""Number of frames, samples or the like."""
FROM_0 = number(0, LARGEST, f"0 or more, {LARGEST:,} at most", int)
"""Number that may be 0."""
pixel = number(-1e9, 1e9, "pixels")
"""Column or row of a picture."""
seconds = number(LEAST, 1e9, "a time in seconds, such as 0.02 or 1/50", lambda text: float(Fraction(text)))
"""Exposure time."""


_COMMON: Final[dict[str, dict[str, Any]]] = {
    "scene": {
        "nargs": "?",
        "default": "desk",
        "metavar": "SCENE",
        "help": "scene file, its folder, or a bundled scene's name (default: desk)",
    },
    "--source": {
        "metavar": "PATH|INDEX",
        "help": "folder, picture, video, capture device or stream (rtsp://, http://)",
    },
    "--calibration": {"metavar": "FILE|exif", "help": "OpenCV calibration file; exif: from the first picture"},
    "--light": {
        "metavar": "FILE|card",
        "help": "captured .exr or .hdr instead of the ball; card: estimate by the card (live)",
    },
    "--light-axes": {
        "choices": LATLONG_AXES,
        "help": "axes of the light file (default: as it states, else y-up for .exr, blender for .hdr)",
    },
    "--device": {"default": "auto", "metavar": "auto|cpu|cuda:0", "help": "where the kernels run (default: auto)"},
    "--frames": {"type": count, "metavar": "N", "help": "stop after N frames"},
    "--shrink": {"type": count, "default": 1, "metavar": "N", "help": "divide width and height of frames (default: 1)"},
    "--overwrite": {"action": "store_true", "help": "also replace files that this program did not write"},
    "--rectangle-size": {"type": float, "nargs": 2, "metavar": ("W", "H"), "help": "the rectangle's sides in metres"},
    "--focal-35mm": {
        "type": number(1.0, 10_000.0, "millimetres from 1 to 10000, such as 26"),
        "metavar": "MM",
        "help": "35 mm equivalent focal length, if EXIF has none",
    },
}
"""Options that have the same meaning in several commands."""


def file_to_amend(scene: Scene, given: object) -> Path:
    """Return the file of a scene that ``--write`` changes.

    Args:
        scene: The scene, read from a file.
        given: The scene as the options name it.

    Raises:
        UsageError: The scene is a bundled one.
    """
    if scene.path is None or scene.path in bundled_scenes().values():
        raise UsageError(f"--write: {given} is a bundled scene, which is not changed; copy it first")
    return scene.path


class _BriefHelp(argparse.HelpFormatter):
    """Formatter of help without the options that few runs need."""

    def add_argument(self, action: argparse.Action) -> None:
        if not getattr(action, "rare", False):
            super().add_argument(action)


class Parser(argparse.ArgumentParser):
    """Argument parser whose errors are one line, like all error messages of this package.

    ``--help`` leaves out options that are declared by ``add_rare``; ``--help-all`` lists them.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(formatter_class=_BriefHelp, **options)

    def add_rare(self, *flags: str, group: argparse._ActionsContainer, **options: Any) -> None:
        """Declare an option that few runs need; the arguments are those of ``add_argument``."""
        if not any(action.dest == "help_all" for action in self._actions):
            self.add_argument("--help-all", action=_HelpAll, nargs=0, help="list all options and stop")
        group.add_argument(*flags, **options).rare = True  # type: ignore[attr-defined]

    def add_common(self, *names: str, add: Callable[..., Any] | None = None) -> None:
        """Declare common options by name, or the argument ``scene``; ``add`` may add them to a group."""
        for name in names:
            (add or self.add_argument)(name, **_COMMON[name])

    def error(self, message: str) -> NoReturn:
        """Report an invalid argument.

        Raises:
            UsageError: Always, with the message in one line.
        """
        message = re.sub(r"^argument (\S+): (?=.*: expected )", r"\1 ", message)
        unknown = re.match(r"unrecognized arguments: (--[^\s=]+)", message)
        known = [option for option in _options(self) if unknown is None or option != unknown[1]]
        meant = difflib.get_close_matches(unknown[1], known, n=1, cutoff=0.75) if unknown else []
        hint = f"; did you mean {meant[0]}?" if meant else ""
        raise UsageError(f"{message}{hint}; see {self.prog} --help")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse as argparse does, but refuse empty arguments: an empty path would mean the current folder.

        Raises:
            UsageError: An argument is empty.
        """
        given = list(sys.argv[1:] if args is None else args)
        for place, word in enumerate(given):
            if word == "" or (word is not None and re.fullmatch(r"--[a-z0-9-]+=", word)):
                before = given[place - 1] if place and str(given[place - 1]).startswith("-") else "an argument"
                raise UsageError(f"{word.rstrip('=') or before} is empty; give it a value, or leave it out")
        return super().parse_known_args(given, namespace)


class _HelpAll(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        parser.formatter_class = argparse.HelpFormatter
        parser.print_help()
        parser.exit()


def _options(parser: argparse.ArgumentParser) -> list[str]:
    """Return all options of a parser and of its subcommands."""
    found = list(parser._option_string_actions)
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                found += _options(command)
    return found


class Terminated(KeyboardInterrupt):
    """Request to end the process by SIGTERM or SIGHUP; it unwinds the stack like Ctrl-C."""


def run_command(command: Callable[[], int], failures: type[WarpArError] | tuple[type[WarpArError], ...] = ()) -> int:
    """Run a command; print errors that a user can cause as one line, and clean up after a signal.

    Args:
        command: Function that runs the command and returns its exit code.
        failures: Errors of the running command, which have another exit code than wrong usage.

    Returns:
        The exit code.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal that cannot show a character gets its code point
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
    except Exception as error:
        if any(isinstance(cause, MemoryError) or _NO_MEMORY.search(str(cause)) for cause in causes(error)):
            say(f"there is not enough memory: {reason(error)}")
            return EXIT_FAILED
        if not isinstance(error, OSError):
            raise
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


_NO_MEMORY: Final = re.compile("(?i)failed to (allocate|map)|(insufficient|cannot allocate) memory|start new thread")
"""Messages about exhausted memory by Warp, OpenCV, the dynamic linker and Python's threads, which have no own error."""


def _folder_is_gone() -> bool:
    """Return True if the working folder of this process was deleted."""
    try:
        os.getcwd()
    except FileNotFoundError:
        return True
    return False


def _drop_output() -> None:
    """Discard unprinted output: at exit Python would try to print it again, and fail with a message."""
    with contextlib.suppress(AttributeError, OSError, ValueError), open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), sys.stdout.fileno())


_GRACE: Final = 20.0
"""Seconds after SIGTERM or SIGHUP after which the process is ended, if it has not unwound by then."""
_SOON: Final = 0.001
"""Seconds after which a signal is sent again if a callback swallowed its exception."""


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Have SIGTERM and SIGHUP unwind the stack as Ctrl-C does, so that files are closed and temporary folders removed.

    Only the first signal unwinds; later ones do not interrupt the clean-up. Python drops exceptions that are raised in
    finalisers and in callbacks from native code. A signal that arrives there, Ctrl-C included, is sent again. A signal
    that arrives while Python acquires a lock may leave the lock taken, and the clean-up may then wait for it forever:
    the process ends ``_GRACE`` seconds after the signal at the latest.
    """
    ending, hook = False, sys.unraisablehook
    last = signal.SIGTERM
    unwound = _thread.allocate_lock()

    def end(number: int, _: object) -> None:
        nonlocal ending, last
        if not ending:
            ending, last = True, signal.Signals(number)
            # Without the class `Thread`, which acquires locks: the signal may have interrupted any code.
            _thread.start_new_thread(_give_up, (unwound, number))
            raise Terminated

    def send_again(dropped: Any) -> None:
        nonlocal ending
        if not isinstance(dropped.exc_value, (Terminated, KeyboardInterrupt)):
            hook(dropped)
            return
        ending = False
        number = last if isinstance(dropped.exc_value, Terminated) else signal.SIGINT
        _thread.start_new_thread(_send, (number,))

    ctrl_c = ("SIGINT",) if signal.getsignal(signal.SIGINT) is end_at_once else ()
    unwound.acquire()
    with handling(end, "SIGTERM", "SIGHUP"), handling(signal.default_int_handler, *ctrl_c):
        sys.unraisablehook = send_again
        try:
            yield
        except BaseException:
            ending = True
            with contextlib.suppress(SinkError):  # the first error is reported
                close_open_sinks()
            raise
        finally:
            sys.unraisablehook = hook
            unwound.release()
        ending = True


def _give_up(unwound: Any, number: int) -> None:
    if not unwound.acquire(timeout=_GRACE):
        end_at_once(number, None)


def _send(number: int) -> None:
    """Send a signal to the main thread after a short delay, so that it can leave the callback."""
    time.sleep(_SOON)
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:
        signal.raise_signal(number)
