"""A browser's camera as the source: its pictures come over the WebSocket, its focal length from the marker."""

from __future__ import annotations

import collections
import dataclasses
import math
import threading
import time
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import UsageError
from warp_ar.pictures import decode_picture
from warp_ar.sources.sources import QueueSource, Source
from warp_ar.viewer import protocol
from warp_ar.viewer.controls import Controls, Feed
from warp_ar.viewer.intrinsics import FocalEstimator, guessed_camera
from warp_ar.viewer.messages import Notify

Image = npt.NDArray[np.uint8]

_LEAD_MS: Final = 40.0
"""How long a picture of a browser's camera is about to be packed, sent and unpacked."""
_FOCAL_STEP: Final = 0.01
"""Share by which a better estimate must differ to be worth another pipeline."""
_LOOK_SECONDS: Final = 0.2
"""How often it is looked at meanwhile: finding the marker once more takes several milliseconds."""
_ESTIMATE_SECONDS: Final = 30.0
"""How long a browser's camera is watched before its guessed focal length is left as it is."""


@dataclasses.dataclass(frozen=True, eq=False)
class Pushed:
    """A picture of a browser's camera on its way to being lit."""

    image: Image
    id: int
    taken: float
    """When it came, seconds of ``time.monotonic``."""
    stamp: float
    """When it was taken, milliseconds of the browser's own clock."""


class BrowserCamera:
    """Takes pictures that a viewer pushes. Methods may be called from any thread."""

    def __init__(self, controls: Controls, notify: Notify) -> None:
        self._controls, self._notify = controls, notify
        self._choosing = threading.Lock()
        """Held by who makes a camera the source: of two viewers who ask at once one is refused."""
        self._estimator: FocalEstimator | None = None
        self._estimated: float | None = None
        self._estimate_until = 0.0
        self._looked = 0.0
        self._pushed: collections.deque[Pushed] = collections.deque(maxlen=4)

    @property
    def estimating(self) -> bool:
        """Whether the focal length is still being estimated."""
        return self._estimator is not None

    @property
    def estimated(self) -> bool:
        """Whether the marker has told the focal length."""
        return self._estimated is not None

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
            self._estimator = self._estimated = None
            known = controls.wanted.camera_of((width, height))
            marker = controls.wanted.scene.marker
            if known is None and marker.board is None:
                self._estimator = FocalEstimator(marker, width, height)
                self._estimate_until = time.monotonic() + _ESTIMATE_SECONDS
            source = QueueSource((width, height), description="the browser's camera")
            controls.switch(Feed(source, guessed_camera(width, height), owner=owner))

    def is_of(self, owner: object) -> bool:
        """Whether ``owner``'s camera is the source."""
        feed = self._controls.newest_feed
        return feed.is_browser and feed.owner is owner

    def leave(self, feed: Feed) -> None:
        """Go on with another feed."""
        self._estimator = None
        self._controls.switch(feed)

    def size(self, owner: object) -> tuple[int, int] | None:
        """Size of the pictures that ``owner`` may push now; None if it is not the source."""
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
        self._estimate(picture, now, feed.source)

    def begin(self, image: Image, busy_ms: float) -> Pushed | None:
        """Say that a frame is about to be lit; what is known of it if it was pushed.

        Args:
            image: The frame.
            busy_ms: What lighting a frame takes.
        """
        pushed = next((item for item in tuple(self._pushed) if item.image is image), None)
        if pushed is not None:
            # The next one shall come when this one is done, not sooner, and not have waited by then.
            wait = max(busy_ms - _LEAD_MS, 0.0)
            self._notify({"type": "taken", "id": pushed.id, "wait": round(wait, 1)})
        return pushed

    def _estimate(self, picture: Image, now: float, source: Source) -> None:
        """Learn the focal length from a picture of ``source``; what comes after that was left says nothing."""
        estimator = self._estimator
        if estimator is None or now < self._looked + _LOOK_SECONDS:
            return
        self._looked = now
        found = estimator.estimate() if estimator.look(picture) and estimator.ripe else None
        if found is not None and abs(found.focal / (self._estimated or math.inf) - 1.0) > _FOCAL_STEP:
            camera = guessed_camera(picture.shape[1], picture.shape[0], focal=found.focal)
            if self._estimator is not estimator or not self._controls.use_camera(camera, source):
                return
            self._estimated = found.focal
            self._notify({"type": "intrinsics", "focal": found.focal, "spread": found.spread, "views": found.views})
        if self._estimator is estimator and (estimator.full or now > self._estimate_until):
            self._estimator = None
            if self._estimated is None:
                self._notify({"type": "intrinsics", "focal": None, "spread": None, "views": 0})

    def stop_estimating(self) -> None:
        """Leave the focal length as it is: it was calibrated."""
        self._estimator = None
