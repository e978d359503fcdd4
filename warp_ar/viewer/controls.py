"""State shared by the page's threads: the source, the wanted scene, its edits, and their lock.

A user's own scene names a capture device of this machine. If it is absent, the page says so until a browser's camera is
used instead; its pictures are received here.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools
import math
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.checks.finding import Finding
from warp_ar.errors import SourceError, UsageError
from warp_ar.pictures import decode_picture
from warp_ar.scene import Camera, Scene
from warp_ar.sources.source import Frame, Source
from warp_ar.sources.sources import MOST_INDEX, QueueSource, open_scene_source, source_of
from warp_ar.stages.quality import PRESETS
from warp_ar.viewer import protocol
from warp_ar.viewer.edits import Wanted, wanted_record
from warp_ar.viewer.protocol import Notify

Image = npt.NDArray[np.uint8]

MOST_EDITS: Final = 100
"""Edits that can be undone."""
TOGETHER_SECONDS: Final = 1.0
"""Seconds within which successive changes of one value count as one edit, such as dragging a slider."""


class History:
    """Undo history: edits in order, each with a label and the state before or after it. The owner holds a lock."""

    def __init__(self) -> None:
        self.done: list[tuple[str, Wanted]] = []
        self.undone: list[tuple[str, Wanted]] = []
        self._last = -TOGETHER_SECONDS

    def note(self, label: str, before: Wanted, now: float) -> None:
        """Note an edit.

        Args:
            label: Its words; successive edits with the same words may become one.
            before: State before it.
            now: Seconds on a clock that does not jump.
        """
        self.undone.clear()
        same = bool(self.done) and self.done[-1][0] == label and now - self._last < TOGETHER_SECONDS
        self._last = now
        if not same:
            self.done = [*self.done, (label, before)][-MOST_EDITS:]

    def move(self, wanted: Wanted, *, back: bool) -> Wanted | None:
        """Undo the last edit, or with ``back`` False redo the last undone one; return None without one."""
        source, target = (self.done, self.undone) if back else (self.undone, self.done)
        if not source:
            return None
        label, other = source.pop()
        target.append((label, wanted))
        self._last = -TOGETHER_SECONDS
        # The quality is no edit: a budget chooses it too.
        return dataclasses.replace(other, quality=wanted.quality)

    def drop(self, before: Wanted) -> None:
        """Forget the last edit if ``before`` is the state before it: it could not be made."""
        if self.done and dataclasses.replace(self.done[-1][1], quality=before.quality) == before:
            self.done.pop()

    def clear(self) -> None:
        """Forget all."""
        self.done.clear()
        self.undone.clear()


REMEDY: Final = "press “My camera”, which opens the camera of the machine that shows this page"


class NoCamera(Source):
    """Source that repeats one grey picture, while pipelines are built and the page explains what to do."""

    live, length, fps = True, None, 2.0

    def __init__(self, size: tuple[int, int], error: SourceError) -> None:
        """Keep the fault.

        Args:
            size: (width, height) of the picture, pixels.
            error: Error of the capture device.
        """
        self.size, self.description, self.error = size, "no camera", error
        self.finding = Finding("source.absent", str(error).partition(";")[0], REMEDY)
        """Fault, and its remedy on the page."""
        self._closed = threading.Event()

    def __iter__(self) -> Iterator[Frame]:
        """The picture, until the source is closed."""
        image, self.start = np.full((self.size[1], self.size[0], 3), 64, np.uint8), time.monotonic()
        for index in itertools.count():
            yield Frame(index, time.monotonic() - self.start, image)
            if self._closed.wait(1.0 / self.fps):
                return

    def close(self) -> None:
        """Stop the source."""
        self._closed.set()


CAMERA: Final = "camera"
"""Name of a comparison with the camera's picture."""
TRACED: Final = "traced"
DIFFERENCE: Final = "difference"
CONVERGING: Final = (TRACED, DIFFERENCE)
"""Comparisons of a held picture: with the reference, or with the difference to it in colours."""


@dataclasses.dataclass(frozen=True, eq=False)
class Feed:
    """Source of frames, with the state that changes together with the source."""

    source: Source
    camera: Camera | None = None
    """Another camera than the scene's."""
    wanted: Wanted | None = None
    """State to show from then on."""
    owner: object = None
    """The viewer whose camera it is."""
    estimated: bool = False
    """True once the camera's focal length has been estimated from frames."""

    @property
    def is_browser(self) -> bool:
        """True if a browser pushes the frames."""
        return isinstance(self.source, QueueSource)


def open_feed(scene: Scene, given: str | int | Path | None, wanted: Wanted | None = None) -> Feed:
    """Open a scene's own source, or the one that was given; of a capture device that is not there a ``NoCamera``.

    Raises:
        WarpArError: It cannot be opened, or the scene names none.
    """
    try:
        return Feed(open_scene_source(scene, given, loop=True), wanted=wanted)
    except SourceError as error:
        if not _is_device(source_of(scene, given)):
            raise
        return Feed(NoCamera((scene.camera.width, scene.camera.height), error), wanted=wanted)


def _is_device(source: str | int | Path | None) -> bool:
    """Return True for a capture device that there may be."""
    if isinstance(source, str) and source.isdecimal() and len(source) <= 4 and not Path(source).exists():
        source = int(source)
    return isinstance(source, int) and 0 <= source <= MOST_INDEX


class Controls:
    """State of the page: source, scene, comparison, playing or held.

    Methods may be called from any thread; whoever waits holds ``changed``.
    """

    def __init__(self, feed: Feed, wanted: Wanted, notify: Notify) -> None:
        self._notify = notify
        self.changed = threading.Condition()
        """Guards all of this; notified at every change."""
        self.wanted = wanted
        """State that viewers see now, or will once it is built."""
        self.compare = ""
        """Second picture: nothing, ``CAMERA``, one of ``CONVERGING`` or a preset."""
        self.playing = True
        self.watchers = 0
        """Viewers; without any, no frame is lit."""
        self.edits = 0
        """Grows with every change of what is shown."""
        self.stopped = False
        self.feed = feed
        self._next: Feed | None = None
        self._history = History()

    @property
    def newest_feed(self) -> Feed:
        """The feed that was asked for last; the frames may still come from the one before."""
        return self._next or self.feed

    @property
    def leaving(self) -> bool:
        """True if the present source shall be left."""
        return self.stopped or self._next is not None

    def wait(self, seconds: float | None = None) -> None:
        """Wait so long, or without an end, until the present source shall be left."""
        with self.changed:
            self.changed.wait_for(lambda: self.leaving, timeout=seconds)

    def _adopt(self, wanted: Wanted | None) -> None:
        """Want something else, or with None the same, and tell viewers; to be called with the lock held.

        So the last that they hear is the state that is.
        """
        if wanted is not None:
            self.wanted = wanted
            self._touch()
        self._notify(self.scene_message())

    def change(self, make: Callable[[Wanted], Wanted], label: str | None = None) -> None:
        """Make the wanted state anew from the one before.

        Args:
            make: Function from the wanted state to the next.
            label: Words of the edit; None is no edit, and cannot be undone.
        """
        with self.changed:
            before, wanted = self.wanted, make(self.wanted)
            if label is not None and wanted != before:
                self._history.note(label, before, time.monotonic())
            self._adopt(wanted)

    def undo(self) -> None:
        """Take the last edit back; without one nothing happens."""
        with self.changed:
            self._adopt(self._history.move(self.wanted, back=True))

    def redo(self) -> None:
        """Make the edit again that was taken back last; without one nothing happens."""
        with self.changed:
            self._adopt(self._history.move(self.wanted, back=False))

    def give_back(self, good: Wanted, refused: Wanted) -> None:
        """Want again the state before an edit that could not be built, unless something else is wanted by now."""
        with self.changed:
            if self.wanted is refused:
                self._history.drop(good)
                self._adopt(good)

    def start_anew(self, wanted: Wanted) -> None:
        """Want another scene; edits of the one before are forgotten."""
        with self.changed:
            self._history.clear()
            self._adopt(wanted)

    def scene_message(self) -> dict[str, Any]:
        """Return the message of the scene as it is edited, with the edits that can be undone."""
        with self.changed:
            undo, redo = (edits[-1][0] if edits else None for edits in (self._history.done, self._history.undone))
            return {"type": "scene", "scene": wanted_record(self.wanted), "undo": undo, "redo": redo}

    def camera_of(self, feed: Feed, wanted: Wanted | None = None) -> Camera:
        """Return the camera that took a feed's frames, as far as it is known."""
        wanted = wanted or self.wanted
        return wanted.camera_of(feed.source.size) or feed.camera or wanted.scene.camera

    def _touch(self) -> None:
        self.edits += 1
        self.changed.notify_all()

    def set_compare(self, other: str) -> None:
        """Choose what stands beside the picture.

        Raises:
            UsageError: There is no such choice.
        """
        if other not in ("", CAMERA, *CONVERGING, *PRESETS):
            known = ", ".join((CAMERA, *CONVERGING))
            raise UsageError(f"compare with {other!r}; expected {known} or a preset: {', '.join(PRESETS)}")
        with self.changed:
            self.compare = other
            self._touch()

    def play(self, on: bool) -> None:
        """Let frames flow, or hold the one in hand."""
        with self.changed:
            self.playing = on
            self.changed.notify_all()

    def watch(self, change: int) -> None:
        """One viewer more (1) or less (-1)."""
        with self.changed:
            self.watchers += change
            self.edits += change > 0
            self.changed.notify_all()

    def stop(self) -> None:
        """End the frames."""
        with self.changed:
            self.stopped = True
            self.changed.notify_all()
        if self.feed.source.live:
            self.feed.source.close()

    def switch(self, feed: Feed) -> None:
        """Go on with another source after the frame in hand."""
        with self.changed:
            left, self._next = self._next, feed
            current = self.feed.source
            self.changed.notify_all()
        if left is not None:
            left.source.close()
        if current.live:
            current.close()

    def adopt(self) -> bool:
        """Take the feed that was asked for last; return True if there was one."""
        with self.changed:
            if self._next is None:
                return False
            self.feed, self._next = self._next, None
            if self.feed.wanted is not None:
                self._history.clear()
            self._adopt(self.feed.wanted or self.wanted)
        return True

    def use_estimate(self, camera: Camera, feed: Feed) -> bool:
        """Use the camera estimated from a feed's frames; return False if the feed has been left."""
        with self.changed:
            if self._next is not None or self.feed is not feed:
                return False
            self.feed = dataclasses.replace(feed, camera=camera, estimated=True)
            self._touch()
        return True

    def close(self) -> None:
        """Let the sources go."""
        self.stopped = True
        for feed in (self.feed, self._next):
            if feed is not None:
                feed.source.close()


DEFAULT_FIELD_OF_VIEW: Final = 60.0
"""Horizontal, degrees: between a phone's main camera (65 to 70) and a laptop's (50 to 60)."""


def guessed_camera(width: int, height: int, transfer: Any = "srgb", focal: float | None = None) -> Camera:
    """Return a camera with square pixels, a central principal point, no distortion, and the default field of view."""
    focal = focal or 0.5 * width / math.tan(0.5 * math.radians(DEFAULT_FIELD_OF_VIEW))
    return Camera(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), transfer=transfer)


_LEAD_MS: Final = 40.0
"""Typical time for a picture of a browser's camera to be packed, sent and unpacked."""


@dataclasses.dataclass(frozen=True, eq=False)
class Pushed:
    """A picture of a browser's camera on its way to being lit."""

    image: Image
    id: int
    taken: float
    """Time at which it came, seconds of ``time.monotonic``."""
    stamp: float
    """Time at which it was taken, milliseconds of the browser's own clock."""


class BrowserCamera:
    """Takes pictures that a viewer pushes. Methods may be called from any thread."""

    def __init__(self, controls: Controls, notify: Notify) -> None:
        self._controls, self._notify = controls, notify
        self._choosing = threading.Lock()
        """Held by who makes a camera the source: of two viewers who ask at once one is refused."""
        self._pushed: collections.deque[Pushed] = collections.deque(maxlen=4)

    def use(self, width: int, height: int, owner: object) -> None:
        """Make ``owner``'s camera the source.

        Raises:
            UsageError: Another viewer's camera is.
        """
        controls = self._controls
        with self._choosing:
            feed = controls.newest_feed
            if feed.is_browser and feed.owner is not owner:
                raise UsageError("another viewer's camera is the source; it must be switched off there first")
            source = QueueSource((width, height), description="the browser's camera")
            controls.switch(Feed(source, guessed_camera(width, height), owner=owner))

    def is_of(self, owner: object) -> bool:
        """Return True if ``owner``'s camera is the source."""
        feed = self._controls.newest_feed
        return feed.is_browser and feed.owner is owner

    def size(self, owner: object) -> tuple[int, int] | None:
        """Return the size of the pictures that ``owner`` may push now; None if it is not the source."""
        return self._controls.newest_feed.source.size if self.is_of(owner) else None

    def push(self, taken: protocol.Picture, owner: object) -> None:
        """Take a picture; blocks while it is decoded.

        The page hears of it again, as ``taken``, when it is its turn to be lit: sooner, another would only take its
        place.

        Raises:
            ProtocolError: It cannot be decoded.
        """
        picture = decode_picture(taken.jpeg, cv2.IMREAD_COLOR_RGB, protocol.ProtocolError, "picture")
        feed = self._controls.newest_feed
        if feed.owner is not owner or feed.source.size != (picture.shape[1], picture.shape[0]):
            return  # switched off meanwhile
        assert isinstance(feed.source, QueueSource)
        now = time.monotonic()
        self._pushed.append(Pushed(picture, taken.id, now, taken.taken))
        feed.source.push(picture, now)

    def begin(self, image: Image, busy_ms: float) -> Pushed | None:
        """Say that a frame is about to be lit; return its record if it was pushed.

        Args:
            image: The frame.
            busy_ms: Time that lighting a frame takes.
        """
        pushed = next((item for item in tuple(self._pushed) if item.image is image), None)
        if pushed is not None:
            # The next one shall come when this one is done, not sooner, and not have waited by then.
            wait = max(busy_ms - _LEAD_MS, 0.0)
            self._notify({"type": "taken", "id": pushed.id, "wait": round(wait, 1)})
        return pushed
