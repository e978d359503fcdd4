"""A browser's camera as the source: its pictures, its estimated focal length, and its calibration by a printed board.

A square seen at a slant tells the focal length: its vanishing points fix that of a camera with square pixels, a central
principal point and no distortion. Corners are too noisy for that closed form when the view is nearly straight on, so
the focal length is the one under which the marker's corners, posed anew for each candidate, are reprojected best over
many views at once. The calibration measures the lens as well.
"""

from __future__ import annotations

import collections
import dataclasses
import math
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.calibration.camera_calibration import GOOD_VIEWS, BoardViews, CameraReport, write_camera
from warp_ar.calibration.card import write_card
from warp_ar.errors import UsageError
from warp_ar.pictures import decode_picture
from warp_ar.scene import Camera, Marker
from warp_ar.sources.sources import QueueSource, Source
from warp_ar.tracking.card_layout import SHEET
from warp_ar.tracking.markers import MarkerDetector
from warp_ar.viewer import protocol
from warp_ar.viewer.controls import Controls, Feed
from warp_ar.viewer.messages import Notify, begin, failure

DEFAULT_FIELD_OF_VIEW: Final = 60.0
"""Horizontal, degrees: between a phone's main camera (65 to 70) and a laptop's (50 to 60)."""

_FIELDS: Final = (30.0, 100.0)
_CANDIDATES: Final = 33
_VIEWS: Final = 2
_MOST_VIEWS: Final = 32
_NOISE: Final = 0.3
"""Standard error of a corner in pixels, with which the spread of the estimate is judged."""
_GOOD_ENOUGH: Final = 0.08
_NEW_VIEW: Final = 0.01
"""A view counts as another one when its corners have moved by this share of the picture's width."""


@dataclasses.dataclass(frozen=True)
class FocalEstimate:
    """A focal length and how sure it is."""

    focal: float
    """Pixels."""
    spread: float
    """Relative standard error."""
    views: int
    """How many views it rests on."""


def guessed_camera(width: int, height: int, transfer: Any = "srgb", focal: float | None = None) -> Camera:
    """A camera with square pixels, a central principal point, no distortion, and the default field of view."""
    focal = focal or 0.5 * width / math.tan(0.5 * math.radians(DEFAULT_FIELD_OF_VIEW))
    return Camera(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), transfer=transfer)


class FocalEstimator:
    """Collects views of a single marker until they tell the focal length."""

    def __init__(self, marker: Marker, width: int, height: int) -> None:
        self._marker, self._size = marker, (width, height)
        self._detector = MarkerDetector(marker.dictionary)
        half = 0.5 * marker.size
        self._square = np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
        self._views: list[npt.NDArray[np.float64]] = []

    @property
    def ripe(self) -> bool:
        """Whether twice as many views have come as at the last time that was worth an estimate."""
        return len(self._views) >= _VIEWS and len(self._views).bit_count() == 1

    @property
    def full(self) -> bool:
        """Whether more views would hardly tell more."""
        return len(self._views) >= _MOST_VIEWS

    def look(self, image: npt.NDArray[np.uint8]) -> bool:
        """Take a frame, uint8 RGB; True if it showed the marker from a new side."""
        found = [d for d in self._detector.detect(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) if d.id == self._marker.id]
        return len(found) == 1 and self.add(np.asarray(found[0].corners, np.float64))

    def add(self, corners: npt.NDArray[np.float64]) -> bool:
        """Take the marker's corners (4, 2) in pixels, clockwise from its top left; True if they show a new side."""
        if self.full:
            return False
        least = _NEW_VIEW * self._size[0]
        if any(np.abs(corners - view).max() < least for view in self._views):
            return False
        self._views.append(corners)
        return True

    def _error(self, focal: float) -> float:
        """Sum over all views of the squared reprojection error in pixels."""
        matrix = guessed_camera(*self._size, focal=focal).matrix()
        total = 0.0
        for corners in self._views:
            _, turns, shifts, _ = cv2.solvePnPGeneric(
                self._square, corners, matrix, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
            )
            errors = []
            for turn, shift in zip(turns, shifts, strict=True):
                turn, shift = cv2.solvePnPRefineLM(self._square, corners, matrix, None, turn, shift)
                points, _ = cv2.projectPoints(self._square, turn, shift, matrix, None)
                errors.append(float(((points[:, 0] - corners) ** 2).sum()))
            total += min(errors, default=0.0)
        return total

    def estimate(self) -> FocalEstimate | None:
        """The focal length, or None while the views do not tell it within 8 %."""
        if len(self._views) < _VIEWS:
            return None
        fields = np.radians(np.linspace(*_FIELDS, _CANDIDATES))
        logs = np.sort(np.log(0.5 * self._size[0] / np.tan(0.5 * fields)))
        errors = np.array([self._error(float(np.exp(log))) for log in logs])
        best = int(errors.argmin())
        if not 0 < best < len(logs) - 1:
            return None
        a, b, _ = np.polyfit(logs[best - 1 : best + 2] - logs[best], errors[best - 1 : best + 2], 2)
        if a <= 0.0:
            return None
        # Least squares: the error's curvature over the corners' variance is the information on log f.
        residual = errors[best] / max(8 * len(self._views) - 6 * len(self._views) - 1, 1)
        spread = math.sqrt(max(residual, _NOISE**2) / a)
        if spread > _GOOD_ENOUGH:
            return None
        return FocalEstimate(float(np.exp(logs[best] - b / (2.0 * a))), spread, len(self._views))


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


_BOARD_SECONDS: Final = 0.4
"""How often the board is looked for."""


class CalibrationSession:
    """Collects views of the board. ``look`` is called by the thread of the frames, all else by any."""

    def __init__(self, helper: Executor, notify: Notify, use: Callable[[Camera], None]) -> None:
        """Start without a calibration.

        Args:
            helper: Looks for the board, beside the frames.
            notify: Takes ``message`` whenever it has changed.
            use: Takes the calibrated camera, whose transfer is still that of a board's pictures.
        """
        self._helper, self._notify, self._use = helper, notify, use
        self._views: BoardViews | None = None
        self._report: CameraReport | None = None
        self._looking: Future[None] | None = None
        self._looked = 0.0

    def step(self, step: str) -> None:
        """Start, stop or finish.

        Raises:
            WarpArError: There is nothing to finish, or what was seen tells too little: looking goes on.
        """
        if step == "finish":
            seen = self._views  # once: another viewer may finish or stop it meanwhile
            if seen is None:
                raise UsageError("nothing was looked at yet: start the calibration first")
            report = seen.solve()
            if report.doubt:
                # The views stay, for more of them to be added.
                views = len(report.view_errors)
                raise UsageError(f"{report.doubt}, in {views} views: nothing is used. Show the card from other sides")
            self._report = report
            self._use(report.camera)
        self._views = BoardViews() if step == "start" else None
        self._notify(self.message())

    def look(self, image: npt.NDArray[np.uint8]) -> None:
        """Have a frame looked at; newer ones are left aside meanwhile."""
        views, now = self._views, time.monotonic()
        if views is None or now - self._looked < _BOARD_SECONDS:
            return
        if self._looking is not None and not self._looking.done():
            return
        self._looked = now
        self._looking = begin(self._helper, self._notify, self._add, views, image)

    def _add(self, views: BoardViews, image: npt.NDArray[np.uint8]) -> None:
        try:
            new = views.add(image)
        except UsageError as error:  # the source has changed
            new = True
            if self._views is views:
                self._views = None
            self._notify(failure(error))
        if new:
            self._notify(self.message())

    def message(self) -> dict[str, Any]:
        """How far the calibration has come."""
        views, report = self._views, self._report
        told = None
        if report is not None:
            told = {
                "focal": report.camera.fx,
                "error": report.error,
                "deviation": report.focal_deviation,
                "coverage": report.coverage,
                "warnings": list(report.warnings),
            }
        return {
            "type": "calibration",
            "on": views is not None,
            "views": 0 if views is None else len(views.views),
            "wanted": GOOD_VIEWS,
            "covered": [] if views is None else views.covered().tolist(),
            "report": told,
        }

    def camera_file(self) -> bytes:
        """The calibrated camera as OpenCV's YAML.

        Raises:
            UsageError: None was calibrated.
        """
        report = self._report
        if report is None:
            raise UsageError("no camera was calibrated here")
        return written("camera.yml", lambda path: write_camera(report, path))


def card_pdf(paper: str) -> bytes:
    """The card to print, a PDF."""
    return written("card.pdf", lambda path: write_card(SHEET, path, paper))


def written(name: str, write: Callable[[Path], object]) -> bytes:
    """What ``write`` writes into a file of that name, which is gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="warp_ar_live_") as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()
