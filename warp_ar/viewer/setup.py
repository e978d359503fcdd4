"""What is wrong with the set-up whose frames are shown, said in words while they are lit; and the ball, measured."""

from __future__ import annotations

import collections
import dataclasses
import math
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from warp_ar.ball.ball_measure import measure_ball
from warp_ar.calibration.grey_response import MOST_DEVIATION, measure_grey_response
from warp_ar.calibration.response import write_response
from warp_ar.checks.check_objects import check_objects, find_outside
from warp_ar.checks.check_pictures import Look, board_instead, look_at, why_unseen
from warp_ar.checks.checkup import check_look
from warp_ar.checks.finding import Finding
from warp_ar.errors import UsageError, WarpArError
from warp_ar.scene import Camera, Pose, Probe, Scene
from warp_ar.tracking.tracking import TrackState
from warp_ar.viewer.controls import Controls
from warp_ar.viewer.messages import Notify, begin

Image = npt.NDArray[np.uint8]

KEPT: Final = 24
"""Frames that are looked at: the newest, ``STEP_SECONDS`` from each other."""
STEP_SECONDS: Final = 0.4
LOST_SECONDS: Final = 1.5
"""How long the marker must not have been seen before it is looked at why."""
AGAIN_SECONDS: Final = 3.0
"""How often that is looked at."""
PLACES_SECONDS: Final = 1.0
"""How often it is looked at whether the picture shows an object."""
RESPONSE: Final = "response.txt"
"""Name of a measured response's file."""
FEWEST: Final = 3
"""Frames without which nothing is measured."""
PAGE_WORDS: Final = (
    ("and run python -m warp_ar.calibrate camera PICTURES", "and press “Calibrate”"),
    ("python -m warp_ar.calibrate camera PICTURES", "press “Calibrate”"),
    ("python -m warp_ar.calibrate ball SCENE --write", "press “Measure the ball”"),
)
"""What a finding's command is on the page."""


class SetupChecks:
    """Keeps some of the frames and looks at them on a helper's thread. The thread of the frames calls ``note``."""

    def __init__(self, controls: Controls, helper: Executor, notify: Notify, folder: Path) -> None:
        """Start without frames.

        Args:
            controls: What is shown, and where measurements go.
            helper: Looks at the frames, beside them.
            notify: Takes ``message`` whenever it has changed.
            folder: Where a measured response is kept.
        """
        self._folder = folder
        self._controls, self._helper, self._notify = controls, helper, notify
        self._frames: collections.deque[tuple[Image, float]] = collections.deque(maxlen=KEPT)
        self._of: object = None
        self._busy: Future[None] | None = None
        self._step: str | None = None
        self._doing = ""
        self._waits = False
        self._work: dict[str, Callable[[Scene, Look], None]] = {
            "check": self._check,
            "ball": self._ball,
            "response": self._response,
        }
        self._seen = self._looked = 0.0
        self._findings: list[Finding] | None = None
        self._measured: dict[str, str] = {}
        self._made: dict[str, object] = {}
        self._told: frozenset[str] = frozenset()
        self._failed: dict[str, str] = {}
        self.missing: Finding | None = None
        """Why the marker is not seen, or that it is one of a board's, in words; None while all is right."""
        self.outside: Finding | None = None
        """That all virtual objects lie outside the picture, and where; None while it shows one."""
        self._placed = -math.inf

    def note(self, image: Image, state: TrackState | None, pose: Pose | None, now: float) -> None:
        """Take notice of a frame.

        Args:
            image: As the camera gave it, RGB.
            state: Whether the marker was seen; None where nothing looked for it.
            pose: ``camera_from_world``; None where it is not known.
            now: Seconds on a clock that does not jump.
        """
        if now - self._placed > PLACES_SECONDS:
            self._placed = now
            self.outside = None if pose is None else self._find_outside(pose)
        feed = self._controls.feed
        of = (feed.source, self._controls.wanted.scene.marker)
        if self._of is None or of != self._of:
            self._of = of
            self._frames.clear()
            self._seen, self._looked, self.missing = now, -math.inf, None
        if not self._frames or now - self._frames[-1][1] >= STEP_SECONDS:
            self._frames.append((image, now))
        self._begin()
        if self._step is None and self._made and self._valid() != self._told:
            self._notify(self.message())
        if state in (None, TrackState.TRACKED):
            self._seen = now
            # A single marker that is seen may be one of a board's, which is looked at below.
            if self.missing is not None and self.missing.name != "marker.board":
                self.missing = None
        doubtful = state is TrackState.TRACKED and self._controls.wanted.scene.marker.board is None
        due = doubtful or now - self._seen > LOST_SECONDS
        if due and now - self._looked > AGAIN_SECONDS and not self._is_busy:
            self._looked = now
            self._busy = begin(self._helper, self._notify, self._say_why, doubtful)

    @property
    def _is_busy(self) -> bool:
        return self._busy is not None and not self._busy.done()

    def _shown(self) -> tuple[Scene, Camera]:
        wanted, feed = self._controls.wanted, self._controls.feed
        width, height = feed.source.size
        camera = self._controls.camera_of(feed, wanted).scaled_to(width, height)
        return dataclasses.replace(wanted.scene, camera=camera), camera

    def _find_outside(self, pose: Pose) -> Finding | None:
        """Say where the objects are, if the picture shows none of them."""
        try:
            scene, camera = self._shown()
        except WarpArError:
            return None  # the source has changed meanwhile
        if len(find_outside(scene, camera, [pose])) < len(scene.objects):
            return None
        return next(iter(check_objects(scene, camera, [pose])), None)

    def _say_why(self, seen: bool) -> None:
        """Say why the marker is not seen; of one that is seen, whether it belongs to a board."""
        try:
            scene, camera = self._shown()
            of, newest = self._of, list(self._frames)[-4:]
            missing = board_instead(scene.marker, [image for image, _ in newest[::-1]])
            if missing is None and not seen:
                look = look_at(scene.marker, camera, newest)
                missing = None if look.views else why_unseen(scene.marker, look)
            if of is self._of:  # else the marker or the source has changed meanwhile
                self.missing = missing
        except (WarpArError, IndexError):
            self.missing = None  # the source has changed meanwhile

    def step(self, step: str) -> None:
        """Begin to look at the frames, or to measure by them, as soon as there are enough.

        Raises:
            UsageError: It is at that already.
        """
        if self._step is not None:
            raise UsageError("the frames are being looked at already: wait until that is done")
        if step not in self._work:
            raise UsageError(f"no step {step!r}; expected {', '.join(self._work)}")
        self._step, self._waits = step, True
        self._failed.pop(step, None)
        self._notify(self.message())

    def _begin(self) -> None:
        """Do what was asked for, if there are enough frames."""
        if self._waits and self._step is not None and len(self._frames) >= FEWEST:
            self._waits = False
            self._busy = begin(self._helper, self._notify, self._run, self._step)

    def _run(self, step: str) -> None:
        try:
            scene, camera = self._shown()
            self._work[step](scene, look_at(scene.marker, camera, list(self._frames)))
        except WarpArError as error:
            self._failed[step] = str(error)
        finally:
            self._step, self._doing = None, ""
            self._notify(self.message())

    def _tell(self, words: str) -> None:
        """Say what is being looked at."""
        self._doing = words
        self._notify(self.message())

    def _check(self, scene: Scene, look: Look) -> None:
        self._findings = check_look(scene, look, views=2)
        self._made["check"] = _state_of(scene)["check"]

    def _valid(self) -> frozenset[str]:
        """Steps whose result is that of the set-up as it is: undo takes it back, redo brings it again."""
        try:
            now = _state_of(self._shown()[0])
        except WarpArError:
            return frozenset()  # the source has changed meanwhile
        # A copy: the helper adds to it.
        return frozenset(step for step, made in list(self._made.items()) if now[step] == made)

    def _ball(self, scene: Scene, look: Look) -> None:
        """Measure the first mirror ball and put it where it stands."""
        if not scene.probes:
            raise UsageError("the scene has no mirror ball: use the printed card, or add one to its file")
        if len(look.views) < FEWEST:
            raise UsageError("the marker was seen in too few frames to measure the ball by")
        probe, *others = scene.probes
        found = measure_ball(look.views, look.camera, probe, scene.proxies, others, tell=self._tell)
        if not found.is_usable:
            raise UsageError(
                f"the ball is known to {2e3 * found.deviation:.0f} mm only: nothing is changed. Have all of it in the "
                "picture, look at it from the side rather than from above, and move the camera around it"
            )
        x, y, z = (round(value, 5) for value in found.center)
        ball = dataclasses.replace(probe, center=(x, y, z), radius=round(found.radius, 5))
        self._controls.change(lambda w: dataclasses.replace(w, scene=_with_ball(w.scene, ball)), "measure the ball")
        self._made["ball"] = (ball.center, ball.radius)
        moved = 1e3 * math.dist(found.center, probe.center)
        radius = f"{1e3 * found.radius:.1f} mm"
        radius += (
            " as typed (the views are too alike to tell it: move the camera around)"
            if found.radius_deviation is None
            else f" ± {2e3 * found.radius_deviation:.1f} mm"
        )
        self._measured["ball"] = (
            f"The ball's centre was {moved:.1f} mm off; it is known to ± {2e3 * found.deviation:.1f} mm now. "
            f"Its radius: {radius}."
        )

    def _response(self, scene: Scene, look: Look) -> None:
        """Measure how the camera encodes light, by the card's greys."""
        found = measure_grey_response(look.images)
        if (interval := 2 * found.deviation[128].max()) > MOST_DEVIATION:
            raise UsageError(
                f"the curve is known to {interval:.0%} only, by {found.views} pictures, and sRGB is as likely: nothing "
                "is changed. Show the card under exposures, or lamps, that differ more"
            )
        path = self._folder / RESPONSE
        write_response(found.curve, path)
        camera = dataclasses.replace(scene.camera, transfer=path)
        self._controls.change(lambda w: w.with_camera(camera), "measure the response")
        self._made["response"] = path
        middle = found.curve[128].mean()
        self._measured["response"] = (
            f"Code 128 is {middle:.3f} of clipping ± {2 * found.deviation[128].max():.0%} (sRGB: 0.216), by "
            f"{found.views} pictures. Several exposures, or lamps on and off, tell it better."
        )

    def response_file(self) -> bytes:
        """The measured response.

        Raises:
            UsageError: None was measured.
        """
        if "response" not in self._measured:
            raise UsageError("no response was measured here")
        return (self._folder / RESPONSE).read_bytes()

    def message(self) -> dict[str, Any]:
        """What was found and measured."""
        self._told = valid = self._valid()
        findings = None
        if self._findings is not None and "check" in valid:
            findings = [
                {"name": f.name, "text": f.text, "cost": f.cost, "remedy": _page_words(f.remedy), "error": f.error}
                for f in self._findings
            ]
        return {
            "type": "setup",
            "busy": self._step,
            "doing": self._doing,
            "findings": findings,
            "outdated": self._findings is not None and findings is None,
            "frames": len(self._frames),
            "measured": {step: words for step, words in list(self._measured.items()) if step in valid},
            "failed": dict(self._failed),
        }


def _with_ball(scene: Scene, ball: Probe) -> Scene:
    return dataclasses.replace(scene, probes=(ball, *scene.probes[1:]))


def _state_of(scene: Scene) -> dict[str, object]:
    """What each step's result is about, as a scene has it."""
    ball = scene.probes[0] if scene.probes else None
    return {
        "ball": ball and (ball.center, ball.radius),
        "response": scene.camera.transfer,
        "check": (scene.camera, scene.marker, scene.probes, scene.proxies),
    }


def _page_words(remedy: str) -> str:
    """A finding's remedy with the page's buttons instead of commands."""
    for command, words in PAGE_WORDS:
        remedy = remedy.replace(command, words)
    return remedy
