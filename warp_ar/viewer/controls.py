"""State shared by the page's threads: the source, the wanted scene, its edits, and their lock.

A scene may name a capture device of this machine. If the device is absent, the page shows a notice until a viewer uses
the camera of a browser. Pictures of a browser's camera are received here.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools
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
from warp_ar.sources.source import Frame, QueueSource, Source
from warp_ar.sources.sources import MOST_INDEX, open_scene_source, source_of
from warp_ar.viewer import protocol
from warp_ar.viewer.edits import Wanted, wanted_record
from warp_ar.viewer.protocol import Notify

Image = npt.NDArray[np.uint8]

MOST_EDITS: Final = 100
"""Edits that can be undone."""
TOGETHER_SECONDS: Final = 1.0
"""Longest time between two changes of one value that count as one edit (a dragged slider), seconds."""


REMEDY: Final = "press “My camera”, which opens the camera of the machine that shows this page"


class NoCamera(Source):
    """Source that stands in for an absent camera: it repeats one grey picture while the page shows the remedy."""

    live, length, fps = True, None, 2.0

    def __init__(self, size: tuple[int, int], error: SourceError) -> None:
        """Create the source.

        Args:
            size: (width, height) of the picture, pixels.
            error: Error of the capture device, shown on the page.
        """
        self.size, self.description, self.error = size, "no camera", error
        self.finding = Finding("source.absent", str(error).partition(";")[0], REMEDY)
        """Error of the capture device and its remedy, as shown on the page."""
        self._closed = threading.Event()

    def __iter__(self) -> Iterator[Frame]:
        """Yield the picture, twice a second, until the source is closed."""
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


@dataclasses.dataclass(frozen=True, eq=False)
class Feed:
    """Source of frames, with the state that changes together with the source."""

    source: Source
    camera: Camera | None = None
    """Camera that replaces the scene's; None keeps the scene's."""
    wanted: Wanted | None = None
    """State to show once this feed is in use; None keeps the present state."""
    owner: object = None
    """Viewer whose camera is the source; None for other sources."""
    estimated: bool = False
    """True once the camera's focal length has been estimated from frames."""

    @property
    def is_browser(self) -> bool:
        """True if a browser pushes the frames."""
        return isinstance(self.source, QueueSource)

    def camera_for(self, wanted: Wanted) -> Camera:
        """Return the camera of the frames: calibrated on the page, else the feed's own, else the scene's."""
        return wanted.camera_of(self.source.size) or self.camera or wanted.scene.camera


def open_feed(scene: Scene, given: str | int | Path | None, wanted: Wanted | None = None) -> Feed:
    """Open the given source, or without one the scene's own; an absent capture device gives a ``NoCamera``.

    Args:
        scene: Scene of the frames.
        given: Source to open instead of the scene's.
        wanted: State of the new feed.

    Raises:
        WarpArError: The source cannot be opened, or no source is given and the scene names none.
    """
    try:
        return Feed(open_scene_source(scene, given, loop=True), wanted=wanted)
    except SourceError as error:
        if not _is_device(source_of(scene, given)):
            raise
        return Feed(NoCamera((scene.camera.width, scene.camera.height), error), wanted=wanted)


def _is_device(source: str | int | Path | None) -> bool:
    """Return True if the source is a plausible index of a capture device."""
    if isinstance(source, str) and source.isdecimal() and len(source) <= 4 and not Path(source).exists():
        source = int(source)
    return isinstance(source, int) and 0 <= source <= MOST_INDEX


class Controls:
    """State of the page: source, scene, comparison, playing or held.

    Methods may be called from any thread. A caller that waits for a change must hold ``changed``.
    """

    def __init__(self, feed: Feed, wanted: Wanted, notify: Notify) -> None:
        self._notify = notify
        self.changed = threading.Condition()
        """Lock of this object's state, notified at every change."""
        self.wanted = wanted
        """State that viewers see, at the latest once its pipeline is built."""
        self.compare = ""
        """Picture to compare with: empty for none, ``CAMERA``, one of ``protocol.CONVERGING``, or a preset."""
        self.playing = True
        self.watchers = 0
        """Number of viewers; frames are lit only while there is one."""
        self.edits = 0
        """Counter of changes that need a new picture."""
        self.stopped = False
        self.feed = feed
        self._next: Feed | None = None
        self._done: list[tuple[str, Wanted]] = []
        """Labels of edits, each with the state before it; the newest last."""
        self._undone: list[tuple[str, Wanted]] = []
        """Labels of undone edits, each with the state after it."""
        self._edited = -TOGETHER_SECONDS

    @property
    def newest_feed(self) -> Feed:
        """Feed that was requested last. Frames may still come from the previous feed."""
        return self._next or self.feed

    @property
    def leaving(self) -> bool:
        """True if frames of the present source shall end."""
        return self.stopped or self._next is not None

    def wait(self, seconds: float | None = None) -> None:
        """Wait until the present source shall be left, for at most so many seconds; None sets no limit."""
        with self.changed:
            self.changed.wait_for(lambda: self.leaving, timeout=seconds)

    def _adopt(self, wanted: Wanted) -> None:
        """Set the wanted state and send it to the viewers.

        The caller holds the lock, so that the last message always describes the final state.
        """
        self.wanted = wanted
        self._touch()
        self._notify(self.scene_message())

    def change(self, make: Callable[[Wanted], Wanted], label: str | None = None) -> None:
        """Replace the wanted state by a function of it.

        Args:
            make: Function from the present wanted state to the next.
            label: Description of the edit; None records no edit, so that the change cannot be undone.
        """
        with self.changed:
            before, wanted = self.wanted, make(self.wanted)
            if label is not None and wanted != before:
                now, merged = time.monotonic(), bool(self._done) and self._done[-1][0] == label
                if not merged or now - self._edited >= TOGETHER_SECONDS:
                    self._done.append((label, before))
                    del self._done[:-MOST_EDITS]
                self._undone.clear()
                self._edited = now
            self._adopt(wanted)

    def undo(self) -> None:
        """Undo the last edit, if there is one."""
        self._move(self._done, self._undone)

    def redo(self) -> None:
        """Redo the edit that was undone last, if there is one."""
        self._move(self._undone, self._done)

    def _move(self, source: list[tuple[str, Wanted]], target: list[tuple[str, Wanted]]) -> None:
        with self.changed:
            if source:
                label, wanted = source.pop()
                target.append((label, self.wanted))
                self._edited = -TOGETHER_SECONDS
                # Quality is not part of the history, as a budget changes it too.
                self._adopt(dataclasses.replace(wanted, quality=self.wanted.quality))

    def give_back(self, good: Wanted, refused: Wanted) -> None:
        """Restore the last good state if the refused state, whose pipeline could not be built, is still wanted."""
        with self.changed:
            if self.wanted is refused:
                if self._done and dataclasses.replace(self._done[-1][1], quality=good.quality) == good:
                    self._done.pop()
                self._adopt(good)

    def start_anew(self, wanted: Wanted) -> None:
        """Show another scene and forget the edits of the previous one."""
        with self.changed:
            self._forget_edits()
            self._adopt(wanted)

    def _forget_edits(self) -> None:
        self._done.clear()
        self._undone.clear()

    def scene_message(self) -> dict[str, Any]:
        """Return the message of the edited scene, with the labels of the edits that undo and redo would affect."""
        with self.changed:
            undo, redo = (edits[-1][0] if edits else None for edits in (self._done, self._undone))
            return {"type": "scene", "scene": wanted_record(self.wanted), "undo": undo, "redo": redo}

    def _touch(self) -> None:
        self.edits += 1
        self.changed.notify_all()

    def set_compare(self, other: str) -> None:
        """Choose the picture to compare with."""
        with self.changed:
            self.compare = other
            self._touch()

    def play(self, on: bool) -> None:
        """Play frames (True), or hold the present frame (False)."""
        with self.changed:
            self.playing = on
            self.changed.notify_all()

    def watch(self, change: int) -> None:
        """Count one viewer more (1) or less (-1)."""
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
        """Use another feed after the present frame."""
        with self.changed:
            left, self._next = self._next, feed
            current = self.feed.source
            self.changed.notify_all()
        if left is not None:
            left.source.close()
        if current.live:
            current.close()

    def adopt(self) -> None:
        """Start to use the feed that was requested last, if one was."""
        with self.changed:
            if self._next is not None:
                self.feed, self._next = self._next, None
                if self.feed.wanted is not None:
                    self._forget_edits()
                self._adopt(self.feed.wanted or self.wanted)

    def use_estimate(self, camera: Camera, feed: Feed) -> bool:
        """Use the camera estimated from a feed's frames; return False if that feed is no longer in use."""
        with self.changed:
            if self._next is not None or self.feed is not feed:
                return False
            self.feed = dataclasses.replace(feed, camera=camera, estimated=True)
            self._touch()
        return True

    def close(self) -> None:
        """Close all sources."""
        self.stopped = True
        for feed in (self.feed, self._next):
            if feed is not None:
                feed.source.close()


DEFAULT_FIELD_OF_VIEW: Final = 60.0
"""Horizontal field of view, degrees: between those of phones' main cameras (65 to 70) and of laptops (50 to 60)."""


def guessed_camera(width: int, height: int) -> Camera:
    """Return a camera for frames of a size, of the default field of view, by its numbers."""
    return dataclasses.replace(Camera.guessed(width, height, DEFAULT_FIELD_OF_VIEW), field_of_view=None)


_LEAD_MS: Final = 40.0
"""Typical time to encode, send and decode a picture of a browser's camera, milliseconds."""


@dataclasses.dataclass(frozen=True, eq=False)
class Pushed:
    """Picture of a browser's camera that waits to be lit."""

    image: Image
    id: int
    taken: float
    """Time of arrival, seconds of ``time.monotonic``."""
    stamp: float
    """Time of capture, milliseconds on the browser's own clock."""


class BrowserCamera:
    """Receiver of pictures from a viewer's camera. Methods may be called from any thread."""

    def __init__(self, controls: Controls, notify: Notify) -> None:
        self._controls, self._notify = controls, notify
        self._choosing = threading.Lock()
        """Lock of ``use``: of two viewers that offer their cameras at once, one is refused."""
        self._pushed: collections.deque[Pushed] = collections.deque(maxlen=4)

    def use(self, width: int, height: int, owner: object) -> None:
        """Make the camera of the viewer ``owner`` the source.

        Raises:
            UsageError: Another viewer's camera is the source.
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
        """Return the size of the pictures that ``owner`` may push; None if its camera is not the source."""
        return self._controls.newest_feed.source.size if self.is_of(owner) else None

    def push(self, taken: protocol.Picture, owner: object) -> None:
        """Decode a picture and queue it as a frame; blocks while decoding.

        When the frame is about to be lit, ``begin`` sends the page the message ``taken``, after which the page sends
        the next picture. A picture sent earlier would only replace the queued one.

        Raises:
            ProtocolError: The picture cannot be decoded.
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
        """Tell the page that a frame is about to be lit; return the frame's record, or None if no viewer pushed it.

        Args:
            image: The frame.
            busy_ms: Time that lighting a frame takes, milliseconds.
        """
        pushed = next((item for item in tuple(self._pushed) if item.image is image), None)
        if pushed is not None:
            # The next picture should arrive just when this frame is done: no earlier, or it would wait and age.
            wait = max(busy_ms - _LEAD_MS, 0.0)
            self._notify({"type": "taken", "id": pushed.id, "wait": round(wait, 1)})
        return pushed
