"""What the page and the server may say to each other.

From the page come text messages, JSON objects with a ``type``, and binary messages, pictures of the browser's camera.
Nothing that comes in is trusted: a message that is not exactly one of those below raises ``ProtocolError``, whose text
is the reason with which its sender is dropped.

From the server come text messages, and binary ones: four bytes, the length of a JSON header (little endian), the
header, then the pictures that it names, one after another.
"""

from __future__ import annotations

import dataclasses
import json
import math
import struct
from collections.abc import Callable, Mapping
from typing import Any, Final, TypeAlias

from warp_ar.errors import WarpArError
from warp_ar.pictures import jpeg_segments

SCHEMA: Final = 3
"""Number of what both sides may say, told in ``hello``; it grows when keys change."""
MAX_TEXT: Final = 4096
"""Longest text message from a page in bytes: an edit takes under 200."""
MAX_PICTURE: Final = 1 << 20
"""Largest binary message from a page in bytes: a JPEG of 1920x1080 at quality 0.85 takes half of that."""
SMALLEST_CAMERA: Final = (64, 48)
LARGEST_CAMERA: Final = (1920, 1080)

EFFECTS: Final = ("objects", "lights", "environment", "receiver", "exposure", "relief", "environment_shadow")
"""What the page can switch off."""
PARTS: Final = ("object", "light", "proxy", "probe", "exposure", "marker")
"""What of a scene the page can edit."""
ANIMATED: Final = ("animation", "speed", "loop", "paused")
"""What of an object's animation the page can change."""
KINDS: Final = {
    "object": ("sphere", "box", "torus"),
    "light": ("point", "spot", "directional"),
    "proxy": ("plane", "box"),
}
"""What the page can add. Meshes are files, and the page names no file."""
_ALL_KINDS: Final = tuple(dict.fromkeys(kind for kinds in KINDS.values() for kind in kinds))
OUTLINES: Final = ("plane", "wall", "box")
"""What of the desk can be pointed out by four points of the picture."""
SETUP_STEPS: Final = ("check", "ball", "response")
"""What of a set-up the page can have looked at."""


class ProtocolError(WarpArError, ValueError):
    """A message that no page of ours sends."""


@dataclasses.dataclass(frozen=True)
class Ack:
    """Frame ``id`` is on the screen."""

    id: int


@dataclasses.dataclass(frozen=True)
class Ping:
    """Asks for the server's clock; ``sent`` comes back."""

    sent: float


@dataclasses.dataclass(frozen=True)
class Set:
    """Give a key of a scene's part a value, as the scene file would."""

    part: str
    index: int
    key: str
    value: Any


@dataclasses.dataclass(frozen=True)
class Animate:
    """Change how an object plays an animation of its file; a flag is 0 or 1."""

    index: int
    key: str
    value: float


@dataclasses.dataclass(frozen=True)
class Add:
    """Put something new into the scene."""

    part: str
    kind: str


@dataclasses.dataclass(frozen=True)
class Remove:
    """Take something away."""

    part: str
    index: int


@dataclasses.dataclass(frozen=True)
class Show:
    """Show or hide one object or light."""

    part: str
    index: int
    on: bool


@dataclasses.dataclass(frozen=True)
class Effect:
    """Switch an effect."""

    name: str
    on: bool


@dataclasses.dataclass(frozen=True)
class SetQuality:
    """Choose a preset."""

    name: str


@dataclasses.dataclass(frozen=True)
class Method:
    """Choose the method of one stage; an empty name goes back to the preset's."""

    stage: str
    method: str


@dataclasses.dataclass(frozen=True)
class Budget:
    """Milliseconds per frame that the preset may cost; None leaves the preset alone."""

    ms: float | None


@dataclasses.dataclass(frozen=True)
class Compare:
    """Show ``other`` beside the picture: nothing, the camera's frame or another preset."""

    other: str


@dataclasses.dataclass(frozen=True)
class Play:
    """Let frames flow, or hold the one in hand."""

    on: bool


@dataclasses.dataclass(frozen=True)
class OpenScene:
    """Show a bundled scene."""

    name: str


@dataclasses.dataclass(frozen=True)
class Outline:
    """Model a part of the desk that four points of the picture outline, in pixels."""

    kind: str
    points: tuple[tuple[float, float], ...]


@dataclasses.dataclass(frozen=True)
class UseCard:
    """The printed card is the marker, and a mirror ball stands on its cross."""

    radius: float
    """Of the ball, metres."""
    ruler: float
    """What the print's rulers of 100 mm measure, metres."""


@dataclasses.dataclass(frozen=True)
class Setup:
    """Look at the set-up: ``check`` all of it, or measure the ``ball`` or the camera's ``response``."""

    step: str


@dataclasses.dataclass(frozen=True)
class Undo:
    """Take the last edit back."""


@dataclasses.dataclass(frozen=True)
class Redo:
    """Make the edit again that was taken back last."""


@dataclasses.dataclass(frozen=True)
class Reset:
    """Undo every edit."""


@dataclasses.dataclass(frozen=True)
class UseCamera:
    """The page's camera becomes the source; its pictures follow."""

    width: int
    height: int


@dataclasses.dataclass(frozen=True)
class LeaveCamera:
    """Back to the scene's own source."""


@dataclasses.dataclass(frozen=True)
class Calibrate:
    """Look out for the printed board (``start``), leave it at that (``stop``), or use what was seen (``finish``)."""

    step: str


@dataclasses.dataclass(frozen=True)
class Record:
    """Start or stop recording."""

    on: bool


@dataclasses.dataclass(frozen=True)
class Picture:
    """One picture of the browser's camera."""

    id: int
    taken: float
    """Milliseconds on the browser's own clock."""
    jpeg: bytes


Command: TypeAlias = (
    Ack
    | Ping
    | Set
    | Animate
    | Add
    | Remove
    | Show
    | Effect
    | SetQuality
    | Method
    | Budget
    | Compare
    | Play
    | OpenScene
    | Outline
    | UseCard
    | Setup
    | Undo
    | Redo
    | Reset
    | UseCamera
    | LeaveCamera
    | Calibrate
    | Record
)


def _number(low: float, high: float) -> Callable[[Any], float]:
    def check(value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise ProtocolError(f"expected a number from {low:g} to {high:g}")
        return float(value)

    return check


def _integer(low: int, high: int) -> Callable[[Any], int]:
    def check(value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise ProtocolError(f"expected a whole number from {low} to {high}")
        return value

    return check


def _choice(*options: str) -> Callable[[Any], str]:
    def check(value: Any) -> str:
        if not isinstance(value, str) or value not in options:
            raise ProtocolError(f"expected one of {', '.join(options)}")
        return value

    return check


def _name(value: Any) -> str:
    if not isinstance(value, str) or len(value) > 64:
        raise ProtocolError("expected a short name")
    return value


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ProtocolError("expected true or false")
    return value


def _value(value: Any) -> Any:
    """What a key of a scene may be given: a finite number, two or three of them, or a short word."""
    if isinstance(value, str):
        return _name(value)
    numbers = value if isinstance(value, list) and 2 <= len(value) <= 3 else [value]
    for number in numbers:
        if isinstance(number, bool) or not isinstance(number, int | float) or not abs(number) <= 1e9:
            raise ProtocolError("expected a number, two or three of them, or a word")
    return tuple(map(float, value)) if isinstance(value, list) else value


def _optional(check: Callable[[Any], float]) -> Callable[[Any], float | None]:
    return lambda value: None if value is None else check(value)


def _points(value: Any) -> tuple[tuple[float, float], ...]:
    """Four points of a picture."""
    if not isinstance(value, list) or len(value) != 4:
        raise ProtocolError("expected four points")
    check = _number(-1e5, 1e5)
    if not all(isinstance(point, list) and len(point) == 2 for point in value):
        raise ProtocolError("expected points of two numbers")
    return tuple((check(x), check(y)) for x, y in value)


_INDEX = _integer(0, 63)
_ID = _integer(0, 1 << 53)

_MESSAGES: Final[Mapping[str, tuple[Callable[..., Command], Mapping[str, Callable[[Any], Any]]]]] = {
    "ack": (Ack, {"id": _ID}),
    "ping": (Ping, {"sent": _number(0.0, 1e15)}),
    "set": (Set, {"part": _choice(*PARTS), "index": _INDEX, "key": _name, "value": _value}),
    "animate": (Animate, {"index": _INDEX, "key": _choice(*ANIMATED), "value": _number(-1.0, 1e3)}),
    "add": (Add, {"part": _choice(*KINDS), "kind": _choice(*_ALL_KINDS)}),
    "remove": (Remove, {"part": _choice(*KINDS), "index": _INDEX}),
    "show": (Show, {"part": _choice(*KINDS), "index": _INDEX, "on": _flag}),
    "effect": (Effect, {"name": _choice(*EFFECTS), "on": _flag}),
    "quality": (SetQuality, {"name": _name}),
    "method": (Method, {"stage": _name, "method": _name}),
    "budget": (Budget, {"ms": _optional(_number(1.0, 10000.0))}),
    "compare": (Compare, {"other": _name}),
    "play": (Play, {"on": _flag}),
    "scene": (OpenScene, {"name": _name}),
    "outline": (Outline, {"kind": _choice(*OUTLINES), "points": _points}),
    "card": (UseCard, {"radius": _number(0.0, 10.0), "ruler": _number(0.0, 10.0)}),
    "setup": (Setup, {"step": _choice(*SETUP_STEPS)}),
    "undo": (Undo, {}),
    "redo": (Redo, {}),
    "reset": (Reset, {}),
    "camera": (
        UseCamera,
        {
            "width": _integer(SMALLEST_CAMERA[0], LARGEST_CAMERA[0]),
            "height": _integer(SMALLEST_CAMERA[1], LARGEST_CAMERA[0]),
        },
    ),
    "no_camera": (LeaveCamera, {}),
    "calibrate": (Calibrate, {"step": _choice("start", "stop", "finish")}),
    "record": (Record, {"on": _flag}),
}


def _refuse_constant(name: str) -> Any:
    raise ProtocolError(f"{name} is no number")


def parse_text(text: str) -> Command:
    """The command of a text message.

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
    make, checks = _MESSAGES[kind]
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
    return make(**fields)


_PICTURE_HEADER: Final = struct.Struct("<dI")


def parse_picture(data: bytes, size: tuple[int, int]) -> Picture:
    """The picture of a binary message: when it was taken (float64), its number (uint32), then a JPEG of ``size``.

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
    if (found := jpeg_size(jpeg)) != size:
        got = "no JPEG" if found is None else f"{found[0]}x{found[1]}"
        raise ProtocolError(f"picture is {got}, not the {size[0]}x{size[1]} that was announced")
    return Picture(number, taken, jpeg)


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that a JPEG of three 8-bit components says it has, before decoding; None if it is none."""
    if data[:2] != b"\xff\xd8":
        return None
    for marker, at in jpeg_segments(data):
        # Start of frame: baseline, extended and progressive Huffman; the other kinds no browser writes.
        if marker in (0xC0, 0xC1, 0xC2):
            if at + 10 > len(data) or data[at + 4] != 8 or data[at + 9] != 3:
                return None
            height, width = struct.unpack_from(">HH", data, at + 5)
            return (width, height) if width and height else None
    return None


def pack(header: Mapping[str, Any], *pictures: bytes) -> bytes:
    """A binary message of the server; ``sizes`` in its header are those of the pictures."""
    text = json.dumps({**header, "sizes": [len(picture) for picture in pictures]}, separators=(",", ":")).encode()
    return b"".join((struct.pack("<I", len(text)), text, *pictures))


class Bucket:
    """A bound on a rate: holds ``burst`` tokens, ``rate`` more per second come back."""

    def __init__(self, rate: float, burst: float) -> None:
        self._rate, self._burst, self._left, self._last = rate, burst, burst, 0.0

    def take(self, amount: float, now: float) -> bool:
        """Whether ``amount`` may pass at ``now`` (seconds)."""
        self._left = min(self._burst, self._left + max(now - self._last, 0.0) * self._rate)
        self._last = now
        if self._left < amount:
            return False
        self._left -= amount
        return True
