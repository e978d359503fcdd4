"""Calibrates the camera from a printed board while its frames are lit."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from warp_ar.calibration.camera_calibration import GOOD_VIEWS, BoardViews, CameraReport, write_camera
from warp_ar.calibration.card import write_card
from warp_ar.errors import UsageError
from warp_ar.scene import Camera
from warp_ar.tracking.card_layout import SHEET
from warp_ar.viewer.messages import Notify, begin, failure

_LOOK_SECONDS: Final = 0.4
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

    def step(self, name: str) -> None:
        """Start, stop or finish.

        Raises:
            WarpArError: There is nothing to finish, or what was seen tells too little: looking goes on.
        """
        if name == "finish":
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
        self._views = BoardViews() if name == "start" else None
        self._notify(self.message())

    def look(self, image: npt.NDArray[np.uint8]) -> None:
        """Have a frame looked at; newer ones are left aside meanwhile."""
        views, now = self._views, time.monotonic()
        if views is None or now - self._looked < _LOOK_SECONDS:
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


def with_transfer(camera: Camera, like: Camera) -> Camera:
    """A calibrated camera with another's transfer curve, which a board does not tell."""
    return dataclasses.replace(camera, transfer=like.transfer)
