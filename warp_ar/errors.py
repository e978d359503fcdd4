"""Errors that a user can cause; each message is one line that names the fault and the remedy."""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import sys
import warnings
from collections.abc import Iterator
from typing import Any


class WarpArError(Exception):
    """Base of all errors that this package raises on purpose. The message is one printable line."""


class SceneError(WarpArError, ValueError):
    """Error of a scene file or of a file that it names. The message names the file, the key and the value."""


class SourceError(WarpArError, RuntimeError):
    """Error of a frame source that cannot be opened or has failed."""


class SinkError(WarpArError, RuntimeError):
    """Error of a frame sink or an output file that cannot be opened or written."""


class UsageError(WarpArError, ValueError):
    """Error of an option of a command, or of an argument of a call, whose value cannot be used."""


class UpdateError(UsageError):
    """Error of a scene that differs from a running pipeline's in more than numbers. The message names the part."""


def check_process(what: str, process: int) -> None:
    """Check that this process made an object with threads or a device; ``what`` names it, ``process`` is its process.

    Raises:
        UsageError: This process is a fork of the one with the id ``process``.
    """
    if os.getpid() != process:
        raise UsageError(
            f"{what} in process {process}, of which this one is a fork without its threads and its device; start "
            "processes by spawn"
        )


def warn_renamed(old: str, new: str, category: type[Warning] = DeprecationWarning) -> None:
    """Warn the caller's caller of a former name, which works until the next minor version."""
    warnings.warn(f"{old} is now {new}; the old name ends with the next minor version", category, stacklevel=3)


def import_extra(extra: str, need: str, *modules: str, error: type[WarpArError] = UsageError) -> Any:
    """Import modules of a package that an extra installs, and return the first.

    Args:
        extra: Name of the extra.
        need: Beginning of the message: the thing that needs the package.
        modules: Full names of the modules.
        error: Type of the error.

    Raises:
        WarpArError: As ``error``: the package is not installed.
    """
    try:
        first, *_ = map(importlib.import_module, modules)
    except ImportError as problem:
        raise error(f'{need}; install it with pip install "warp-ar[{extra}]"') from problem
    return first


def causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error, its cause, the cause of that, and so on."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def counted(number: int, what: str) -> str:
    """Return a count with its noun: "1 frame", "2 frames"."""
    return f"{number} {what}{'s' * (number != 1)}"


def reason(error: BaseException) -> str:
    """Return the reason of an error on one line, without the path, which the surrounding message names."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(str(text).split())


# Terminal control characters, characters that change the direction of text, and unpaired surrogates (not encodable).
_UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufeff]")


def printable(text: object) -> str:
    r"""Return a text on one line with control characters escaped as ``\x1b`` and the like."""
    return _UNPRINTABLE.sub(lambda match: match[0].encode("unicode_escape").decode(), str(text))


_LONGEST = 1000
"""Largest number of characters of a message that are printed: a path may have thousands."""


def say(text: object) -> None:
    """Print a text to stderr as one line without terminal control characters."""
    shown = printable(text)
    if len(shown) > _LONGEST:
        shown = f"{shown[: _LONGEST * 2 // 3]}... ({len(shown)} characters) ...{shown[-_LONGEST // 4 :]}"
    with contextlib.suppress(OSError, ValueError):  # stderr may be closed; the program goes on
        print(f"warp_ar: {shown}", file=sys.stderr, flush=True)
