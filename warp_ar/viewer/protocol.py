"""Messages between the page and the server, with notices and failures for viewers.

From the page come text messages, JSON objects with a ``type``, and binary messages, pictures of the browser's camera.
Nothing that comes in is trusted: a message that is not exactly one of ``_MESSAGES`` raises ``ProtocolError``, whose
text is the reason with which its sender is dropped.

From the server come text messages, and binary ones: four bytes, the length of a JSON header (little endian), the
header, then the pictures that it names, one after another.
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

SCHEMA: Final = 3
"""Version of the messages, told in ``hello``; it grows when keys change."""
MAX_TEXT: Final = 4096
"""Longest text message from a page in bytes: an edit takes under 200."""
MAX_PICTURE: Final = 1 << 20
"""Largest binary message from a page in bytes: a JPEG of 1920x1080 at quality 0.85 takes half of that."""
MOST_BYTES: Final = 1 << 26
"""Largest dropped file, bytes: 64 MB."""
SMALLEST_CAMERA: Final = (64, 48)
LARGEST_CAMERA: Final = (1920, 1080)

EFFECTS: Final = ("objects", "lights", "environment", "receiver", "exposure", "relief", "environment_shadow")
"""Effects that the page can switch off."""
PARTS: Final = ("object", "light", "proxy", "probe", "exposure", "marker")
"""Parts of a scene that the page can edit."""
ANIMATED: Final = ("animation", "speed", "loop", "paused")
"""Values of an object's animation that the page can change."""
KINDS: Final = {
    "object": ("sphere", "box", "torus"),
    "light": ("point", "spot", "directional"),
    "proxy": ("plane", "box"),
}
"""Kinds of each part that the page can add. Meshes are files, and the page names no file."""
OUTLINES: Final = ("plane", "wall", "box")
"""Shapes of the desk that can be pointed out by four points of the picture."""
SETUP_STEPS: Final = ("check", "ball", "light", "response")
"""Steps of a set-up: ``check`` all of it, measure the ``ball`` or the camera's ``response``, or take
the ``light`` from the card."""


class ProtocolError(WarpArError, ValueError):
    """Message that the page never sends."""


@dataclasses.dataclass(frozen=True)
class Command:
    """Text message of a page, checked."""

    type: str
    """One of ``_MESSAGES``."""
    fields: Mapping[str, Any]
    """Its other keys."""


@dataclasses.dataclass(frozen=True)
class Picture:
    """Picture of a browser's camera."""

    id: int
    taken: float
    """Milliseconds on the browser's own clock."""
    jpeg: bytes


Check = Callable[[Any], Any]
"""Function that converts a value of a message, or raises a ProtocolError."""


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


def _integer(low: int, high: int) -> Check:
    return _number(low, high, int)


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


def _optional(check: Check) -> Check:
    return lambda value: None if value is None else check(value)


def _points(value: Any) -> tuple[tuple[float, float], ...]:
    """Return four points of a picture, pixels."""
    _expect(isinstance(value, list) and len(value) == 4, "four points")
    _expect(all(isinstance(point, list) and len(point) == 2 for point in value), "points of two numbers")
    check = _number(-1e5, 1e5)
    return tuple((check(x), check(y)) for x, y in value)


_INDEX = _integer(0, 63)
_NAME = {"name": _name}
_ON = {"on": _flag}

_MESSAGES: Final[Mapping[str, Mapping[str, Check]]] = {
    # The frame of this number is on the screen.
    "ack": {"id": _integer(0, 1 << 53)},
    # Asks for the server's clock; ``sent`` comes back.
    "ping": {"sent": _number(0.0, 1e15)},
    # Asks for the object that is seen at a pixel, or nearest to it within a reach, pixels; all comes back.
    "pick": {"x": _number(-1e5, 1e5), "y": _number(-1e5, 1e5), "reach": _number(0.0, 64.0)},
    # Gives a key of a scene's part a value, as the scene file would.
    "set": {"part": _choice(*PARTS), "index": _INDEX, "key": _name, "value": _value},
    # Changes how an object plays an animation of its file; a flag is 0 or 1.
    "animate": {"index": _INDEX, "key": _choice(*ANIMATED), "value": _number(-1.0, 1e3)},
    "add": {"part": _choice(*KINDS), "kind": _name},
    # Adds another object, light or proxy that is as one of the scene's, beside it.
    "duplicate": {"part": _choice(*KINDS), "index": _INDEX},
    # Puts an object's lowest point on the desk.
    "snap": {"index": _INDEX},
    "remove": {"part": _choice(*KINDS), "index": _INDEX},
    "show": {"part": _choice(*KINDS), "index": _INDEX, **_ON},
    "effect": {"name": _choice(*EFFECTS), **_ON},
    "quality": _NAME,
    # Chooses the method of one stage; an empty name goes back to the preset's.
    "method": {"stage": _name, "method": _name},
    # Milliseconds per frame that the preset may cost; null leaves the preset alone.
    "budget": {"ms": _optional(_number(1.0, 10000.0))},
    # Shows something beside the picture: nothing, the camera's frame, a preset, the reference.
    "compare": {"other": _name},
    # Lets frames flow, or holds the one in hand.
    "play": _ON,
    "scene": _NAME,
    # Models a part of the desk that four points of the picture outline, in pixels.
    "outline": {"kind": _choice(*OUTLINES), "points": _points},
    # Makes the printed card the marker: the ball's radius and what its rulers of 100 mm measure, metres.
    "card": {"radius": _number(0.0, 10.0), "ruler": _number(0.0, 10.0)},
    "setup": {"step": _choice(*SETUP_STEPS)},
    "undo": {},
    "redo": {},
    "reset": {},
    # Makes the page's camera the source; its pictures follow.
    "camera": {
        "width": _integer(SMALLEST_CAMERA[0], LARGEST_CAMERA[0]),
        "height": _integer(SMALLEST_CAMERA[1], LARGEST_CAMERA[0]),
    },
    "no_camera": {},
    # Looks out for the printed board, leaves it at that, or uses what was seen.
    "calibrate": {"step": _choice("start", "stop", "finish")},
}


def _refuse_constant(name: str) -> Any:
    raise ProtocolError(f"{name} is no number")


def parse_text(text: str) -> Command:
    """Return the command of a text message.

    Raises:
        ProtocolError: It is none.
    """
    if len(text) > MAX_TEXT:
        raise ProtocolError(f"text message of {len(text)} characters; {MAX_TEXT} at most")
    try:
        message = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        if isinstance(error, ProtocolError):
            raise
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
    if kind == "add" and fields["kind"] not in KINDS[fields["part"]]:
        raise ProtocolError(f"add: kind: expected one of {', '.join(KINDS[fields['part']])}")
    return Command(kind, fields)


_PICTURE_HEADER: Final = struct.Struct("<dI")


def parse_picture(data: bytes, size: tuple[int, int]) -> Picture:
    """Return the picture of a binary message: time (float64), number (uint32), then a JPEG of ``size``.

    Raises:
        ProtocolError: It is none.
    """
    if len(data) > MAX_PICTURE:
        raise ProtocolError(f"picture of {len(data)} bytes; {MAX_PICTURE} at most")
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
    """Return a binary message of the server; ``sizes`` in its header are those of the pictures."""
    text = json.dumps({**header, "sizes": [len(picture) for picture in pictures]}, separators=(",", ":")).encode()
    return b"".join((struct.pack("<I", len(text)), text, *pictures))


class Bucket:
    """Bound on a rate: holds ``burst`` tokens, ``rate`` more per second come back."""

    def __init__(self, rate: float, burst: float) -> None:
        self._rate, self._burst, self._left, self._last = rate, burst, burst, 0.0

    def take(self, amount: float, now: float) -> bool:
        """Return True if ``amount`` may pass at ``now`` (seconds), and take it."""
        self._left = min(self._burst, self._left + max(now - self._last, 0.0) * self._rate)
        self._last = now
        if self._left < amount:
            return False
        self._left -= amount
        return True


Notify = Callable[[dict[str, Any]], None]
"""Receiver of a message for all viewers, called on any thread."""

_LONGEST: Final = 400
"""Characters of a notice about a fault: an exception's text may be a whole file."""
_FOLDERS: Final = re.compile(r"(?<![\w:/.])(?:[A-Za-z]:\\|/)(?:[^\s/\\:;,'\"()]+[/\\])+")
"""Folders of an absolute path: those of this machine are not for viewers; the file's name stays."""


def notice(text: str, *, bad: bool = False) -> dict[str, Any]:
    """Return a notice; ``bad`` marks a refusal or a failure."""
    return {"type": "notice", "text": text, "bad": bad}


def failure(error: BaseException, then: str = "the frames go on") -> dict[str, Any]:
    """Return the notice for an exception; every exception of a frame or of work beside the frames comes here.

    An error of the program's own says what is wrong as it stands. Any other is a fault of the program: its traceback
    goes to the terminal, and viewers are told its type, its text and what happens next.

    Args:
        error: The exception.
        then: Words for the next step, where the error is a fault.
    """
    if isinstance(error, WarpArError):
        return notice(_FOLDERS.sub("", str(error)), bad=True)
    with contextlib.suppress(OSError, ValueError):  # nobody may read it any more
        traceback.print_exception(error, file=sys.stderr)
    words = _FOLDERS.sub("", reason(error)[:_LONGEST])
    return notice(f"this failed: {type(error).__name__}: {words}; {then}", bad=True)


def begin(helper: Executor, notify: Notify, work: Callable[..., None], *arguments: Any) -> Future[None]:
    """Run work beside the frames; an error that it does not catch itself becomes a notice.

    Args:
        helper: Executor that runs it.
        notify: Receiver of the notice, called on the helper's thread.
        work: Function to run.
        *arguments: Arguments of ``work``.
    """

    def tell(future: Future[None]) -> None:
        if not future.cancelled() and (error := future.exception()) is not None:
            notify(failure(error))

    future = helper.submit(work, *arguments)
    future.add_done_callback(tell)
    return future
