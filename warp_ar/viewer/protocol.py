"""Messages between the page and the server, with notices and failures for viewers.

The page sends text messages (JSON objects with a ``type``) and binary messages (pictures of the browser's camera).
Messages are not trusted: any that does not match an entry of ``_MESSAGES`` raises ``ProtocolError``. The server then
closes the connection, with the error's text as the reason.

The server sends text messages and binary messages. A binary message holds four bytes with the length of a JSON header
(little endian), the header, and the pictures that it lists, one after another.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import re
import struct
import sys
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future
from typing import Any, Final

from warp_ar.errors import WarpArError, reason
from warp_ar.pictures import picture_size
from warp_ar.stages.quality import PRESETS

MAX_MESSAGE: Final = (1 << 20) + 64
"""Largest message from a page in bytes: a JPEG of 1920x1080 at quality 0.85 takes half of it."""
MOST_BYTES: Final = 1 << 26
"""Largest dropped file, bytes: 64 MB."""

EFFECTS: Final = ("objects", "lights", "environment", "receiver", "exposure", "relief", "environment_shadow")
"""Effects that the page can switch off."""
CONVERGING: Final = ("traced", "difference")
"""Comparisons of a held frame: with the reference, or with the difference to the reference in false colours."""
PARTS: Final = ("object", "light", "proxy", "exposure", "marker")
"""Parts of a scene that the page can edit."""


class ProtocolError(WarpArError, ValueError):
    """Error of a message that a page never sends."""


@dataclasses.dataclass(frozen=True)
class Command:
    """Checked text message of a page."""

    type: str
    """One of ``_MESSAGES``."""
    fields: Mapping[str, Any]
    """Other keys of the message."""


@dataclasses.dataclass(frozen=True)
class Picture:
    """Picture of a browser's camera."""

    id: int
    taken: float
    """Time of capture, milliseconds on the browser's own clock."""
    jpeg: bytes


Check = Callable[[Any], Any]
"""Function that checks and converts a value of a message, or raises a ProtocolError."""


def _expect(fits: bool, words: str) -> None:
    if not fits:
        raise ProtocolError(f"expected {words}")


def _number(low: float, high: float, kind: type = float) -> Check:
    words = f"a {'whole ' if kind is int else ''}number from {low:g} to {high:g}"

    def check(value: Any) -> Any:
        known = isinstance(value, kind | int) and not isinstance(value, bool)
        _expect(known and low <= value <= high, words)
        return kind(value)

    return check


def _choice(*options: str) -> Check:
    def check(value: Any) -> str:
        _expect(isinstance(value, str) and value in options, f"one of {', '.join(options)}")
        return str(value)

    return check


def _name(value: Any) -> str:
    _expect(isinstance(value, str) and len(value) <= 64, "a short name")
    return str(value)


def _flag(value: Any) -> bool:
    _expect(isinstance(value, bool), "true or false")
    return bool(value)


def _value(value: Any) -> Any:
    """Return a scene key's value: a finite number, two or three of them, or a short word."""
    if isinstance(value, str):
        return _name(value)
    for number in value if isinstance(value, list) and 2 <= len(value) <= 3 else [value]:
        known = isinstance(number, int | float) and not isinstance(number, bool)
        _expect(known and abs(number) <= 1e9, "a number, two or three of them, or a word")
    return tuple(map(float, value)) if isinstance(value, list) else value


def _budget(value: Any) -> float | None:
    return None if value is None else _number(1.0, 10000.0)(value)


def _points(value: Any) -> tuple[tuple[float, float], ...]:
    """Return four points of a picture, pixels."""
    _expect(isinstance(value, list) and len(value) == 4, "four points")
    _expect(all(isinstance(point, list) and len(point) == 2 for point in value), "points of two numbers")
    check = _number(-1e5, 1e5)
    return tuple((check(x), check(y)) for x, y in value)


_INDEX = _number(0, 63, int)
_ITEM = {"part": _choice("object", "light", "proxy"), "index": _INDEX}
_NAME = {"name": _name}
_ON = {"on": _flag}

_MESSAGES: Final[Mapping[str, Mapping[str, Check]]] = {
    # Acknowledges that the frame of this number is on the screen.
    "ack": {"id": _number(0, 1 << 53, int)},
    # Requests the server's clock; the answer repeats ``sent``.
    "ping": {"sent": _number(0.0, 1e15)},
    # Requests the object at a pixel, or nearest to it within ``reach`` pixels; the answer repeats the arguments.
    "pick": {"x": _number(-1e5, 1e5), "y": _number(-1e5, 1e5), "reach": _number(0.0, 64.0)},
    # Sets a key of a part of the scene, as in a scene file.
    "set": {"part": _choice(*PARTS), "index": _INDEX, "key": _name, "value": _value},
    # Changes the playback of an object's animation; a flag is 0 or 1.
    "animate": {
        "index": _INDEX,
        "key": _choice("animation", "speed", "loop", "paused"),
        "value": _number(-1.0, 1e3),
    },
    "add": {"part": _choice("object", "light"), "kind": _name},
    # Adds a copy of an object, light or proxy near the original.
    "duplicate": _ITEM,
    # Moves an object vertically until its lowest point is on the desk.
    "snap": {"index": _INDEX},
    "remove": _ITEM,
    "show": {**_ITEM, **_ON},
    "effect": {"name": _choice(*EFFECTS), **_ON},
    "quality": _NAME,
    # Chooses the method of one stage; an empty name restores the preset's method.
    "method": {"stage": _name, "method": _name},
    # Sets the budget, milliseconds per frame; null returns to a preset.
    "budget": {"ms": _budget},
    # Chooses the picture to compare with: none, the camera's frame, a preset, or the reference.
    "compare": {"other": _choice("", "camera", *CONVERGING, *PRESETS)},
    # Plays frames, or holds the present one.
    "play": _ON,
    "scene": _NAME,
    # Adds a proxy for the part of the desk that four points of the picture outline, pixels.
    "outline": {"kind": _choice("plane", "wall", "box"), "points": _points},
    # Makes the printed card the marker. Both are in metres: radius of the ball, measured length of the 100 mm rulers.
    "card": {"radius": _number(0.0, 10.0), "ruler": _number(0.0, 10.0)},
    # Checks everything, measures the ball or the camera's response, or estimates the light from the printed card.
    "setup": {"step": _choice("check", "ball", "light", "response")},
    "undo": {},
    "redo": {},
    "reset": {},
    # Makes the camera of the page's browser the source; binary messages with its pictures follow.
    "camera": {"width": _number(64, 1920, int), "height": _number(48, 1920, int)},
    "no_camera": {},
    # Starts to collect views of the printed board, stops without a result, or computes the camera from the views.
    "calibrate": {"step": _choice("start", "stop", "finish")},
}


def parse_text(text: str) -> Command:
    """Return the command of a text message.

    Raises:
        ProtocolError: The message is not a valid command.
    """
    try:
        message = json.loads(text)  # NaN and infinities are in no range of the checks
    except (ValueError, RecursionError) as error:
        raise ProtocolError("text message is no JSON") from error
    kind = message.get("type") if isinstance(message, dict) else None
    if not isinstance(kind, str) or kind not in _MESSAGES:
        raise ProtocolError("text message has no known type")
    checks = _MESSAGES[kind]
    if message.keys() != {"type", *checks}:
        raise ProtocolError(f"{kind} takes {', '.join(checks) or 'nothing'}")
    fields = {}
    for key, check in checks.items():
        try:
            fields[key] = check(message[key])
        except ProtocolError as error:
            raise ProtocolError(f"{kind}: {key}: {error}") from error
    return Command(kind, fields)


_PICTURE_HEADER: Final = struct.Struct("<dI")


def parse_picture(data: bytes, size: tuple[int, int]) -> Picture:
    """Return the picture of a binary message: time (float64), number (uint32), then a JPEG of ``size``.

    Raises:
        ProtocolError: The message is not such a picture.
    """
    if len(data) <= _PICTURE_HEADER.size:
        raise ProtocolError("binary message holds no picture")
    taken, number = _PICTURE_HEADER.unpack_from(data)
    if not (math.isfinite(taken) and 0.0 <= taken <= 1e15):
        raise ProtocolError("picture has no sensible time")
    jpeg = data[_PICTURE_HEADER.size :]
    if (found := picture_size(jpeg) if jpeg.startswith(b"\xff\xd8") else None) != size:
        got = "no JPEG" if found is None else f"{found[0]}x{found[1]}"
        raise ProtocolError(f"picture is {got}, not the {size[0]}x{size[1]} that was announced")
    return Picture(number, taken, jpeg)


def pack(header: Mapping[str, Any], *pictures: bytes) -> bytes:
    """Return a binary message of the server; ``sizes`` in its header lists the pictures' lengths in bytes."""
    text = json.dumps({**header, "sizes": [len(picture) for picture in pictures]}, separators=(",", ":")).encode()
    return b"".join((struct.pack("<I", len(text)), text, *pictures))


class Bucket:
    """Token bucket that limits a rate: it holds up to ``burst`` tokens and gains ``rate`` tokens per second."""

    def __init__(self, rate: float, burst: float) -> None:
        self._rate, self._burst, self._left, self._last = rate, burst, burst, 0.0

    def take(self, amount: float, now: float) -> bool:
        """Take ``amount`` tokens at the time ``now``, seconds; return False if there are too few."""
        self._left = min(self._burst, self._left + max(now - self._last, 0.0) * self._rate)
        self._last = now
        if self._left < amount:
            return False
        self._left -= amount
        return True


Notify = Callable[[dict[str, Any]], None]
"""Receiver of a message for all viewers, called on any thread."""

_LONGEST: Final = 400
"""Largest number of characters of an exception's text in a notice; such a text may hold a whole file."""
_FOLDERS: Final = re.compile(r"(?<![\w:/.])(?:[A-Za-z]:\\|/)(?:[^\s/\\:;,'\"()]+[/\\])+")
"""Pattern of the folders in an absolute path, which are removed from notices; file names stay."""


def notice(text: str, *, bad: bool = False) -> dict[str, Any]:
    """Return a notice; ``bad`` marks a refusal or a failure."""
    return {"type": "notice", "text": text, "bad": bad}


def failure(error: BaseException, then: str = "the frames go on") -> dict[str, Any]:
    """Return the notice for an exception in a frame or in background work.

    A ``WarpArError`` has a message for users, which becomes the notice. Any other exception is a fault of the program:
    its traceback is printed on the terminal, and the notice holds its type, its text and ``then``.

    Args:
        error: The exception.
        then: Words on how the program continues after a fault.
    """
    if isinstance(error, WarpArError):
        return notice(_FOLDERS.sub("", str(error)), bad=True)
    with contextlib.suppress(OSError, ValueError):  # the terminal may have been closed
        traceback.print_exception(error, file=sys.stderr)
    words = _FOLDERS.sub("", reason(error)[:_LONGEST])
    return notice(f"this failed: {type(error).__name__}: {words}; {then}", bad=True)


def begin(helper: Executor, notify: Notify, work: Callable[..., None], *arguments: Any) -> Future[None]:
    """Start a function in the background; an exception that it raises becomes a notice.

    Args:
        helper: Executor that runs the function.
        notify: Receiver of the notice, called on the executor's thread.
        work: Function to run.
        *arguments: Arguments of ``work``.
    """

    def tell(future: Future[None]) -> None:
        if not future.cancelled() and (error := future.exception()) is not None:
            notify(failure(error))

    future = helper.submit(work, *arguments)
    future.add_done_callback(tell)
    return future
