"""Errors that a user can cause, each with a one-line message that says what is wrong and what would be right."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Iterator


class WarpArError(Exception):
    """Base of every error that this package raises on purpose; its message is one line, fit to print as it is."""


class SceneError(WarpArError, ValueError):
    """A scene file, or a file it names, cannot be used: names the file, the key and the value."""


class SourceError(WarpArError, RuntimeError):
    """A frame source cannot be opened or has failed."""


class SinkError(WarpArError, RuntimeError):
    """A frame sink cannot be opened or has failed."""


class UsageError(WarpArError, ValueError):
    """An option or argument, on the command line or in a call, has a value that cannot be used."""


class UpdateError(UsageError):
    """A scene differs from that of a running pipeline in more than numbers: names the part."""


def causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and what it came from, in turn."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def counted(number: int, what: str) -> str:
    """Return a number of things in words: 1 frame, 2 frames."""
    return f"{number} {what}{'s' * (number != 1)}"


def reason(error: BaseException) -> str:
    """Return the reason of an error on one line, without the path that the message around it names already."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(str(text).split())


# What a terminal takes for a command, and what turns the direction of text around; halves of a pair cannot be encoded.
_UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufeff]")


def printable(text: object) -> str:
    r"""Return a text on one line that a terminal shows as it is: control characters become ``\x1b`` and the like."""
    return _UNPRINTABLE.sub(lambda match: match[0].encode("unicode_escape").decode(), str(text))


_LONGEST = 1000
"""Characters of a message that are shown: a path may have thousands."""


def say(text: object) -> None:
    """Print a line to stderr: on one line, and with nothing in it that a terminal would obey."""
    shown = printable(text)
    if len(shown) > _LONGEST:
        shown = f"{shown[: _LONGEST * 2 // 3]}... ({len(shown)} characters) ...{shown[-_LONGEST // 4 :]}"
    with contextlib.suppress(OSError, ValueError):  # nobody may listen any more: what runs goes on
        print(f"warp_ar: {shown}", file=sys.stderr, flush=True)
