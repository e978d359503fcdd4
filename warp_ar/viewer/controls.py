"""What viewers ask for: the one state that the page's threads share, and its lock."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from warp_ar.errors import SourceError, UsageError
from warp_ar.scene import Camera, Scene, SourceSpec
from warp_ar.sources.sources import MOST_INDEX, QueueSource, Source, open_source
from warp_ar.stages.quality import PRESETS
from warp_ar.viewer.edits import Wanted, wanted_record
from warp_ar.viewer.history import History
from warp_ar.viewer.messages import Notify
from warp_ar.viewer.no_camera import NoCamera

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
