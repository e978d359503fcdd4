"""State that the page's threads share: the source, the wanted scene, its edits and the lock of all these.

A desk of one's own names the camera of its machine. Where there is none, a picture says so until a browser's camera
comes.
"""

from __future__ import annotations

import dataclasses
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
from warp_ar.scene import Camera, Scene, SourceSpec
from warp_ar.sources.source import Frame, Source
from warp_ar.sources.sources import MOST_INDEX, QueueSource, Source, open_source
from warp_ar.stages.quality import PRESETS
from warp_ar.viewer.edits import Wanted, wanted_record
from warp_ar.viewer.messages import Notify

MOST_EDITS: Final = 100
"""Edits that can be undone."""
TOGETHER_SECONDS: Final = 1.0
"""Changes of one value that follow each other so soon are one edit: a drag, a slider."""


@dataclasses.dataclass(frozen=True)
class _Edit:
    label: str
    """What was done, in words."""
    other: Wanted
    """What is wanted on the other side of the edit."""


class History:
    """Edits in order. Not locked: whoever owns it holds a lock."""

    def __init__(self) -> None:
        self._done: list[_Edit] = []
        self._undone: list[_Edit] = []
        self._last = -TOGETHER_SECONDS

    @property
    def undo_label(self) -> str | None:
        """What would be undone; None where nothing can be."""
        return self._done[-1].label if self._done else None

    @property
    def redo_label(self) -> str | None:
        """What would be done again; None where nothing can be."""
        return self._undone[-1].label if self._undone else None

    def note(self, label: str, before: Wanted, now: float) -> None:
        """Note an edit.

        Args:
            label: What it does, in words; successive edits with the same words may become one.
            before: What was wanted before it.
            now: Seconds on a clock that does not jump.
        """
        self._undone.clear()
        same = bool(self._done) and self._done[-1].label == label and now - self._last < TOGETHER_SECONDS
        self._last = now
        if not same:
            self._done = [*self._done, _Edit(label, before)][-MOST_EDITS:]

    def undo(self, wanted: Wanted) -> Wanted | None:
        """What was wanted before the last edit; None where there is none."""
        return self._move(wanted, self._done, self._undone)

    def redo(self, wanted: Wanted) -> Wanted | None:
        """What was wanted before the last undo; None where there is none."""
        return self._move(wanted, self._undone, self._done)

    def _move(self, wanted: Wanted, source: list[_Edit], target: list[_Edit]) -> Wanted | None:
        if not source:
            return None
        edit = source.pop()
        target.append(_Edit(edit.label, wanted))
        self._last = -TOGETHER_SECONDS
        # The quality is no edit: a budget chooses it too.
        return dataclasses.replace(edit.other, quality=wanted.quality)

    def drop(self, before: Wanted) -> None:
        """Forget the last edit if ``before`` is what was wanted before it: it could not be made."""
        if self._done and dataclasses.replace(self._done[-1].other, quality=before.quality) == before:
            self._done.pop()

    def clear(self) -> None:
        """Forget all."""
        self._done.clear()
        self._undone.clear()


REMEDY: Final = "press “My camera”, which opens the camera of the machine that shows this page"
_WORDS: Final = ("No camera here.", 'Press "My camera".')
_GREY, _WHITE = 64, 235
_PICTURE_SECONDS: Final = 0.5
"""Between pictures, which are all the same."""


class NoCamera(Source):
    """One grey picture with words, again and again."""

    live = True
    length = None
    fps = 1.0 / _PICTURE_SECONDS

    def __init__(self, size: tuple[int, int], error: SourceError) -> None:
        """Say what is wrong.

        Args:
            size: (width, height) of the picture, pixels.
            error: Why the capture device cannot be opened.
        """
        self.size, self.description, self.error = size, "no camera", error
        self.finding = Finding("source.absent", str(error).partition(";")[0], REMEDY)
        """What is wrong, and what to do on the page."""
        self._closed = threading.Event()

    def __iter__(self) -> Iterator[Frame]:
        """The picture, until the source is closed."""
        image, start, index = _picture(self.size), time.monotonic(), 0
        while not self._closed.is_set():
            yield Frame(index, time.monotonic() - start, image)
            index += 1
            self._closed.wait(_PICTURE_SECONDS)

    def close(self) -> None:
        """End the pictures."""
        self._closed.set()


def _picture(size: tuple[int, int]) -> npt.NDArray[np.uint8]:
    """Words in the middle of a grey picture, RGB (height, width, 3)."""
    image = np.full((size[1], size[0], 3), _GREY, np.uint8)
    scale = size[0] / 640
    for line, words in enumerate(_WORDS):
        (width, height), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, scale, 2)
        place = ((size[0] - width) // 2, size[1] // 2 + round((2.0 * line - 0.5) * height))
        cv2.putText(image, words, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (_WHITE,) * 3, 2, cv2.LINE_AA)
    return image


CAMERA: Final = "camera"
"""What a picture is compared with when it is not another preset."""
TRACED: Final = "traced"
DIFFERENCE: Final = "difference"
CONVERGING: Final = (TRACED, DIFFERENCE)
"""What a held picture is compared with: the reference, or how far from it the picture is, in colours."""


@dataclasses.dataclass(frozen=True, eq=False)
class Feed:
    """Where frames come from, and what changes together with that."""

    source: Source
    camera: Camera | None = None
    """Another camera than the scene's."""
    wanted: Wanted | None = None
    """What to show from then on."""
    owner: object = None
    """The viewer whose camera it is."""

    @property
    def is_browser(self) -> bool:
        """Whether a browser pushes the frames."""
        return isinstance(self.source, QueueSource)


def _where(spec: SourceSpec) -> str | int | Path:
    if spec.path is not None:
        return spec.path
    return spec.camera if spec.camera is not None else f"synthetic:{spec.synthetic}"


def open_feed(scene: Scene, given: str | int | Path | None, wanted: Wanted | None = None) -> Feed:
    """A scene's own source, or the one that was given instead; of a capture device that is not there a ``NoCamera``.

    Raises:
        WarpArError: It cannot be opened, or the scene names none.
    """
    spec = scene.source
    if given is None and spec is None:
        raise UsageError(f"scene {scene.name!r} names no source; give one with --source")
    try:
        if given is not None:
            return Feed(open_source(given, loop=True), wanted=wanted)
        assert spec is not None
        return Feed(open_source(_where(spec), fps=spec.fps, loop=True, exposures=spec.exposures or ()), wanted=wanted)
    except SourceError as error:
        if not _is_device(given if given is not None or spec is None else spec.camera):
            raise
        return Feed(NoCamera((scene.camera.width, scene.camera.height), error), wanted=wanted)


def _is_device(source: str | int | Path | None) -> bool:
    """Whether a source is a capture device that there may be."""
    if isinstance(source, str) and source.isdecimal() and len(source) <= 4 and not Path(source).exists():
        source = int(source)
    return isinstance(source, int) and 0 <= source <= MOST_INDEX


class Controls:
    """What to show, and whether. Methods may be called from any thread; whoever waits holds ``changed``."""

    def __init__(self, feed: Feed, wanted: Wanted, notify: Notify) -> None:
        self._notify = notify
        self.changed = threading.Condition()
        """Guards all of this; notified at every change."""
        self.wanted = wanted
        """What viewers see now, or will once it is built."""
        self.compare = ""
        """What stands beside the picture: nothing, ``CAMERA`` or a preset."""
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
        """Whether the present source shall be left."""
        return self.stopped or self._next is not None

    def change(self, make: Callable[[Wanted], Wanted], label: str | None = None) -> None:
        """Make what is wanted anew from what was.

        Args:
            make: Gives what is wanted from then on.
            label: What the edit does, in words; None is no edit, and cannot be undone.
        """
        with self.changed:
            before = self.wanted
            self.wanted = make(before)
            if label is not None and self.wanted != before:
                self._history.note(label, before, time.monotonic())
            self._touch()
            self._tell()

    def undo(self) -> None:
        """Take the last edit back; without one nothing happens."""
        self._step_to(self._history.undo)

    def redo(self) -> None:
        """Make the edit again that was taken back last; without one nothing happens."""
        self._step_to(self._history.redo)

    def _step_to(self, step: Callable[[Wanted], Wanted | None]) -> None:
        with self.changed:
            wanted = step(self.wanted)
            if wanted is not None:
                self.wanted = wanted
                self._touch()
            self._tell()

    def give_back(self, good: Wanted, refused: Wanted) -> None:
        """Want again what was wanted before an edit that could not be built, unless something else is wanted by now."""
        with self.changed:
            if self.wanted is not refused:
                return
            self.wanted = good
            self._history.drop(good)
            self._touch()
            self._tell()

    def start_anew(self, wanted: Wanted) -> None:
        """Want another scene; edits of the one before are forgotten."""
        with self.changed:
            self.wanted = wanted
            self._history.clear()
            self._touch()
            self._tell()

    def scene_message(self) -> dict[str, Any]:
        """The scene as it is edited, and what can be undone."""
        with self.changed:
            undo, redo = self._history.undo_label, self._history.redo_label
            return {"type": "scene", "scene": wanted_record(self.wanted), "undo": undo, "redo": redo}

    def camera_of(self, feed: Feed, wanted: Wanted | None = None) -> Camera:
        """What is known of the camera that took a feed's frames."""
        wanted = wanted or self.wanted
        return wanted.camera_of(feed.source.size) or feed.camera or wanted.scene.camera

    def _touch(self) -> None:
        self.edits += 1
        self.changed.notify_all()

    def _tell(self) -> None:
        """Tell viewers the scene; to be called with the lock held, so that what they hear last is what is."""
        self._notify(self.scene_message())

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
        """Take the feed that was asked for last; whether there was one."""
        with self.changed:
            if self._next is None:
                return False
            self.feed, self._next = self._next, None
            if self.feed.wanted is not None:
                self.wanted = self.feed.wanted
                self._history.clear()
            self._touch()
            self._tell()
        return True

    def use_camera(self, camera: Camera, source: Source) -> bool:
        """Say what camera takes a source's frames; False if the source has been left."""
        with self.changed:
            if self._next is not None and self._next.source is source:
                self._next = dataclasses.replace(self._next, camera=camera)
            elif self._next is None and self.feed.source is source:
                self.feed = dataclasses.replace(self.feed, camera=camera)
            else:
                return False
            self._touch()
        return True

    def close(self) -> None:
        """Let the sources go."""
        self.stopped = True
        for feed in (self.feed, self._next):
            if feed is not None:
                feed.source.close()
