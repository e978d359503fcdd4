"""Checks of the user's set-up while its frames are lit, and measurements of ball, response and camera."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import math
import re
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any, Final

from warp_ar.ball.ball_measure import measure_ball
from warp_ar.calibration.camera_calibration import GOOD_VIEWS, BoardViews, CameraReport, write_camera
from warp_ar.calibration.card import write_card
from warp_ar.calibration.response import MOST_DEVIATION, measure_grey_response, write_response
from warp_ar.checks.check_ball import is_in_view
from warp_ar.checks.check_objects import check_objects, find_outside
from warp_ar.checks.check_pictures import Look, board_instead, look_at, measure_focal, why_unseen
from warp_ar.checks.checkup import ball_is_seen, check_look
from warp_ar.checks.finding import Finding
from warp_ar.errors import UsageError, WarpArError
from warp_ar.light.card_light import light_by_card
from warp_ar.output.environment_file import write_environment
from warp_ar.scene import Camera, CapturedLight, Pose, Scene
from warp_ar.tracking.card_layout import CARD_MARKER
from warp_ar.tracking.tracking import TrackState
from warp_ar.viewer.controls import Controls, Feed, Image
from warp_ar.viewer.light_record import written
from warp_ar.viewer.protocol import Notify, begin, failure

KEPT: Final = 24
"""Number of recent frames kept for checks, ``STEP_SECONDS`` apart."""
STEP_SECONDS: Final = 0.4
LOST_SECONDS: Final = 1.5
"""Time without the marker after which the reason is searched, seconds."""
AGAIN_SECONDS: Final = 3.0
"""Time between two searches for the reason, and between two tests for a missing ball, seconds."""
BALL_SECONDS: Final = 10.0
"""Time between two tests for a visible ball, seconds; each takes a third of a second."""
PLACES_SECONDS: Final = 1.0
"""Time between two tests for objects in the picture, seconds."""
FOCAL_FRAMES: Final = 4
"""Number of frames after which a guessed camera's focal length is first estimated."""
FOCAL_SPREAD: Final = 0.04
"""Largest relative standard error of a focal length that is used."""
FOCAL_STEP: Final = 0.01
"""Relative change of the focal length that is worth a new pipeline."""
RESPONSE: Final = "response.txt"
"""Name of a measured response's file."""
NO_BALL: Final = Finding(
    "ball.unfound",
    "no mirror ball is seen where the scene has it, so the light is not that of this desk",
    "put the ball on the card’s cross, all of it in the picture, or press “Measure the ball”; without a ball, press "
    "“Light by the card”",
)
FEWEST: Final = 3
"""Smallest number of frames for a step of the set-up."""
PAGE_WORDS: Final = (
    (r"(?:run )?python -m warp_ar\.calibrate camera PICTURES", "press “Calibrate”"),
    (r"python -m warp_ar\.calibrate ball SCENE --write", "press “Measure the ball”"),
    (r"python -m warp_ar\.calibrate response PICTURES", "press “Measure from the card’s greys”"),
    (r"DICT_\w+ charuco(?: [\dx.]+)+", "printed card"),
    (r"DICT_(\w+?) (?:id )?(\d+)\b", r"marker \2 of the family \1"),
    (r"DICT_(\w+)", r"family \1"),
    (r"(?:the )?\[\[?([a-z]+)\]\]?", r"the scene’s \1"),
)
"""(pattern, replacement) pairs that turn commands and scene keys in a finding into words of the page."""


@dataclasses.dataclass
class _Step:
    """Step of the set-up that the page can start."""

    work: Callable[[Scene, Look], str]
    """Function that does the step and returns its result in words."""
    made: object = None
    """Part of the scene to which the result applies; None before the first result."""
    words: str = ""
    """Result in words."""
    failed: str = ""
    """Reason of a failure; empty if there was none."""


class SetupChecks:
    """Checks and measurements of recent frames, made on a helper's thread.

    The thread of the frames calls ``note``.
    """

    def __init__(self, controls: Controls, helper: Executor, notify: Notify, folder: Path) -> None:
        """Start without frames.

        Args:
            controls: Shown state, which receives the measurements.
            helper: Executor of checks and measurements.
            notify: Receiver of ``message``'s result after every change.
            folder: Folder for a measured response.
        """
        self._controls, self._helper, self._notify, self._path = controls, helper, notify, folder / RESPONSE
        works = {"check": self._check, "ball": self._ball, "light": self._light, "response": self._response}
        self._steps = {name: _Step(work) for name, work in works.items()}
        self._findings: list[Finding] = []
        self._frames: collections.deque[tuple[Image, float]] = collections.deque(maxlen=KEPT)
        self._of: object = None
        self._busy: Future[None] | None = None
        self._step: str | None = None
        self._doing = ""
        self._waits = False
        self._told: frozenset[str] = frozenset()
        self._start(0.0)

    def _start(self, now: float) -> None:
        """Forget the frames after a change of source or marker."""
        self._frames.clear()
        self._count, self._focal_due = 0, FOCAL_FRAMES
        self._seen, self._looked, self._placed, self._ball_looked = now, -math.inf, -math.inf, -math.inf
        self.missing: Finding | None = None
        """Finding that the marker is not seen, or belongs to a board; None otherwise."""
        self.outside: Finding | None = None
        """Finding that all virtual objects lie outside the picture; None otherwise."""
        self.ball = ""
        """``seen``, ``missing`` or ``outside`` (the picture); empty if the scene uses no mirror ball."""

    def note(
        self, image: Image, state: TrackState | None, pose: Pose | None, now: float, *, rests: bool = False
    ) -> None:
        """Keep a lit frame for checks, and start the checks that are due.

        Args:
            image: Picture of the camera, RGB.
            state: State of marker tracking; None if no stage tracked the marker.
            pose: ``camera_from_world``; None if unknown.
            now: Time on a monotonic clock, seconds.
            rests: True starts no automatic checks, as the helper is searching for the calibration board.
        """
        of = (self._controls.feed.source, self._controls.wanted.scene.marker)
        if self._of is None or of != self._of:
            self._of = of
            self._start(now)
        if now - self._placed > PLACES_SECONDS:
            self._placed = now
            self.outside = None if pose is None else self._find_outside(pose)
        if not self._frames or now - self._frames[-1][1] >= STEP_SECONDS:
            self._frames.append((image, now))
            self._count += 1
        if self._waits and self._step is not None and len(self._frames) >= FEWEST:
            self._waits = False
            self._busy = begin(self._helper, self._notify, self._run, self._step)
        if self._step is None and self._valid() != self._told:
            self._notify(self.message())
        tracked = state is TrackState.TRACKED
        if tracked or state is None:
            self._seen = now
            # A visible single marker may belong to a board, which is tested below.
            if self.missing is not None and self.missing.name != "marker.board":
                self.missing = None
        if not rests:
            self._begin_looks(image, now, tracked=tracked)

    def _begin_looks(self, image: Image, now: float, *, tracked: bool) -> None:
        """Start the check that is due, one at a time: of the focal length, or of marker and ball."""
        if self._busy is not None and not self._busy.done():
            return
        if self._guesses and self._count >= self._focal_due:
            # Again when the number of frames has doubled, later whenever all kept frames are new.
            self._focal_due = self._count + min(self._count, KEPT)
            self._busy = begin(self._helper, self._notify, self._estimate_focal, self._controls.feed)
        elif (tracked or now - self._seen > LOST_SECONDS) and now - self._looked > AGAIN_SECONDS:
            self._looked = now
            patience = BALL_SECONDS if self.ball == "seen" else AGAIN_SECONDS
            if for_ball := tracked and now - self._ball_looked > patience:
                self._ball_looked = now
            self._busy = begin(self._helper, self._notify, self._look, image, tracked, for_ball)

    def _shown(self) -> tuple[Scene, Camera]:
        wanted, feed = self._controls.wanted, self._controls.feed
        width, height = feed.source.size
        camera = feed.camera_for(wanted).scaled_to(width, height)
        return dataclasses.replace(wanted.scene, camera=camera), camera

    def _find_outside(self, pose: Pose) -> Finding | None:
        """Return the finding that all objects lie outside the picture; None if one lies inside."""
        try:
            scene, camera = self._shown()
        except WarpArError:
            return None  # the source has changed meanwhile
        if len(find_outside(scene, camera, [pose])) < len(scene.objects):
            return None
        return next(iter(check_objects(scene, camera, [pose])), None)

    def _look(self, image: Image, tracked: bool, for_ball: bool) -> None:
        """Update ``missing`` and ``ball`` by one frame.

        Args:
            image: Picture of the camera.
            tracked: True if the marker is tracked; otherwise the reason for its absence is searched.
            for_ball: True also tests for the mirror ball.
        """
        of, missing, ball = self._of, None, self.ball
        with contextlib.suppress(WarpArError, IndexError):  # the source has changed meanwhile
            scene, camera = self._shown()
            newest = list(self._frames)[-4:]
            if not tracked or scene.marker.board is None:
                missing = board_instead(scene.marker, [image for image, _ in newest[::-1]])
            if missing is None and not tracked:
                look = look_at(scene.marker, camera, newest)
                missing = None if look.views else why_unseen(scene.marker, look)
            if for_ball:
                ball = self._ball_in(look_at(scene.marker, camera, [(image, 0.0)]), scene)
        if of is self._of:  # otherwise the result is of another marker or source
            self.missing, self.ball = missing, ball

    def _ball_in(self, look: Look, scene: Scene) -> str:
        """Return the value of ``ball`` for one frame."""
        if not self._controls.wanted.shown_scene().probes or scene.captured is not None:
            return ""
        if not any(is_in_view(look, pose, probe) for _, pose in look.views for probe in scene.probes):
            return "outside" if look.views else self.ball
        return "seen" if ball_is_seen(scene, look.camera, look.views) else "missing"

    @property
    def _guesses(self) -> bool:
        """True while frames come from a browser's camera that has not been calibrated."""
        feed = self._controls.feed
        return feed.is_browser and self._controls.wanted.camera_of(feed.source.size) is None

    def _estimate_focal(self, feed: Feed) -> None:
        with contextlib.suppress(WarpArError):  # the source has changed meanwhile
            scene, camera = self._shown()
            self._take_focal(scene, look_at(scene.marker, camera, list(self._frames)), feed)

    def _take_focal(self, scene: Scene, look: Look, feed: Feed) -> None:
        """Estimate the focal length from frames, and use it if it is accurate enough."""
        fit, camera = measure_focal(scene.marker, look), look.camera
        if fit is None or fit.deviation > FOCAL_SPREAD or abs(fit.ratio - 1.0) < FOCAL_STEP * feed.estimated:
            return
        focal = fit.ratio * camera.fx
        if self._controls.use_estimate(dataclasses.replace(camera, fx=focal, fy=focal), feed):
            self._notify({"type": "intrinsics", "focal": focal, "spread": fit.deviation})

    # ----------------------------------------------------------------------------------------------------------- steps

    def step(self, step: str) -> None:
        """Start a step of the set-up as soon as there are enough frames.

        Raises:
            UsageError: Another step is running.
        """
        if self._step is not None:
            raise UsageError("a check or measurement is running: wait until it is done")
        self._step, self._waits = step, True
        self._steps[step].failed = ""
        self._notify(self.message())

    def _run(self, name: str) -> None:
        step = self._steps[name]
        try:
            scene, camera = self._shown()
            step.words = step.work(scene, look_at(scene.marker, camera, list(self._frames)))
            # A step may have changed the scene (a check with a guessed camera, a measurement): the result applies to
            # the changed scene.
            step.made = _state_of(scene if name == "check" and not self._guesses else self._shown()[0])[name]
        except WarpArError as error:
            step.failed = _page_words(str(error))
        finally:
            self._step, self._doing = None, ""
            self._notify(self.message())

    def _tell(self, words: str) -> None:
        """Show the progress of a step."""
        self._doing = words
        self._notify(self.message())

    def _check(self, scene: Scene, look: Look) -> str:
        if self._guesses:
            self._take_focal(scene, look, self._controls.feed)
            scene, camera = self._shown()
            look = look_at(scene.marker, camera, list(self._frames))
        self._findings = check_look(scene, look, views=2)
        return ""

    def _valid(self) -> frozenset[str]:
        """Return the steps whose results apply to the present scene; undo and redo change them."""
        made = {name: step.made for name, step in self._steps.items() if step.made is not None}
        try:
            now = _state_of(self._shown()[0]) if made else {}
        except WarpArError:
            return frozenset()  # the source has changed meanwhile
        return frozenset(name for name, state in made.items() if now[name] == state)

    def _ball(self, scene: Scene, look: Look) -> str:
        """Measure the place and radius of the first mirror ball, and set them in the scene."""
        if not scene.probes:
            raise UsageError("the scene has no mirror ball: use the printed card, or add one to its file")
        if len(look.views) < FEWEST:
            raise UsageError("the marker was seen in too few frames to measure the ball")
        probe, *others = scene.probes
        found = measure_ball(look.views, look.camera, probe, scene.proxies, others, tell=self._tell)
        if not found.is_usable:
            raise UsageError(
                f"the ball's place is known only to {2e3 * found.deviation:.0f} mm: nothing is changed. Have all of it "
                "in the picture, look at it from the side rather than from above, and move the camera around it"
            )
        x, y, z = (round(value, 5) for value in found.center)
        ball = dataclasses.replace(probe, center=(x, y, z), radius=round(found.radius, 5))
        self._controls.change(lambda w: w.with_scene(probes=(ball, *w.scene.probes[1:])), "measure the ball")
        moved = 1e3 * math.dist(found.center, probe.center)
        unsure = " as typed (the views are too similar to measure it: move the camera around)"
        radius = unsure if found.radius_deviation is None else f" ± {2e3 * found.radius_deviation:.1f} mm"
        return (
            f"The ball's centre was {moved:.1f} mm off; it is known to ± {2e3 * found.deviation:.1f} mm now. "
            f"Its radius: {1e3 * found.radius:.1f} mm{radius}."
        )

    def _light(self, scene: Scene, look: Look) -> str:
        """Light the scene with the light estimated from the card and other surfaces in the newest frame."""
        if not look.views:
            raise UsageError("the marker was not seen: have all of the card in the picture")
        found = light_by_card(look.views[-1][0], scene, look.views[-1][1])
        path = self._path.with_name(f"card_light_{self._count}.exr")
        write_environment(path, found.latlong)
        captured = CapturedLight(path)
        self._controls.change(lambda w: w.with_scene(captured=captured), "light by the card")
        return found.words

    def _response(self, scene: Scene, look: Look) -> str:
        """Measure the camera's response from the card's grey patches, and return a message for the page."""
        found = measure_grey_response(look.images)
        interval = 2 * found.deviation[128].max()
        if interval > MOST_DEVIATION:
            raise UsageError(
                f"the curve is known only to {interval:.0%} from {found.views} pictures, so it may be sRGB: nothing "
                "is changed. Show the card under exposures or lamps that differ more"
            )
        write_response(found.curve, self._path)
        camera = dataclasses.replace(scene.camera, transfer=self._path)
        self._controls.change(lambda w: w.with_camera(camera), "measure the response")
        return (
            f"Code 128 is {found.curve[128].mean():.3f} of clipping ± {interval:.0%} (sRGB: 0.216), by "
            f"{found.views} pictures. Several exposures, or lamps on and off, measure it better."
        )

    def response_file(self) -> bytes:
        """Return the measured response.

        Raises:
            UsageError: No response was measured.
        """
        if not self._steps["response"].words:
            raise UsageError("no response was measured here")
        return self._path.read_bytes()

    def message(self) -> dict[str, Any]:
        """Return the message of findings and measurements for the page."""
        self._told = valid = self._valid()
        findings = None
        if "check" in valid:
            findings = [page_record(one) | {"cost": one.cost} for one in self._findings]
        steps = self._steps.items()
        return {
            "type": "setup",
            "busy": self._step,
            "doing": self._doing,
            "findings": findings,
            "outdated": self._steps["check"].made is not None and findings is None,
            "measured": {name: step.words for name, step in steps if step.words and name in valid},
            "failed": {name: step.failed for name, step in steps if step.failed},
        }

    def guide(self) -> dict[str, str] | None:
        """Return the most important finding about the picture, with its remedy; None if there is none."""
        found = self.missing or self.outside or (NO_BALL if self.ball == "missing" else None)
        return None if found is None else page_record(found)


def _state_of(scene: Scene) -> dict[str, object]:
    """Return, by the name of each step, the part of the scene to which its result applies."""
    ball = scene.probes[0] if scene.probes else None
    return {
        "ball": ball and (ball.center, ball.radius),
        "light": scene.captured,
        "response": scene.camera.transfer,
        "check": (scene.camera, scene.marker, scene.probes, scene.proxies),
    }


def page_record(finding: Finding) -> dict[str, str]:
    """Return a finding's name, text and remedy, in words of the page."""
    return {"name": finding.name, "text": _page_words(finding.text), "remedy": _page_words(finding.remedy)}


def _page_words(text: str) -> str:
    """Replace commands and scene keys in a text by words of the page."""
    for command, words in PAGE_WORDS:
        text = re.sub(command, words, text)
    return text


_BOARD_SECONDS: Final = 0.4
"""Time between two searches for the board, seconds."""


class CalibrationSession:
    """Calibration of the camera from views of the board.

    The thread of the frames calls ``look``; other methods may be called from any thread.
    """

    def __init__(self, helper: Executor, notify: Notify, use: Callable[[Camera], None]) -> None:
        """Start without a calibration.

        Args:
            helper: Executor of the search for the board.
            notify: Receiver of ``message``'s result after every change.
            use: Receiver of the calibrated camera. Its transfer function is not measured.
        """
        self._helper, self._notify, self._use = helper, notify, use
        self._views: BoardViews | None = None
        self._report: CameraReport | None = None
        self._looking: Future[None] | None = None
        self._looked = 0.0

    @property
    def on(self) -> bool:
        """True while views are collected."""
        return self._views is not None

    def step(self, step: str) -> None:
        """Start, stop or finish the calibration.

        Raises:
            WarpArError: No calibration was started, or the views do not suffice. Collecting views continues.
        """
        if step == "finish":
            seen = self._views  # read once, as another viewer may finish or stop meanwhile
            if seen is None:
                raise UsageError("no calibration is running: start one first")
            report = seen.solve()
            if report.doubt:
                # The views are kept, so that more can be added.
                views = len(report.view_errors)
                raise UsageError(f"{report.doubt}, in {views} views: nothing is used. Show the card from other sides")
            self._report = report
            self._use(report.camera)
        self._views = BoardViews() if step == "start" else None
        self._notify(self.message())

    def look(self, image: Image) -> None:
        """Search a frame for the board in the background; frames that arrive during a search are skipped."""
        views, now = self._views, time.monotonic()
        if views is None or now - self._looked < _BOARD_SECONDS:
            return
        if self._looking is not None and not self._looking.done():
            return
        self._looked = now
        self._looking = begin(self._helper, self._notify, self._add, views, image)

    def _add(self, views: BoardViews, image: Image) -> None:
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
        """Return the message of the calibration's progress and result."""
        views, report = self._views, self._report
        told = None
        if report is not None:
            told = {
                "focal": report.camera.fx,
                "error": report.error,
                "deviation": report.focal_deviation,
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
        """Return the calibrated camera as OpenCV's YAML.

        Raises:
            UsageError: No camera was calibrated.
        """
        report = self._report
        if report is None:
            raise UsageError("no camera was calibrated here")
        return written("camera.yml", lambda path: write_camera(report, path))


def card_pdf(paper: str) -> bytes:
    """Return the printable card as a PDF, for paper ``a4`` or ``letter``."""
    return written("card.pdf", lambda path: write_card(CARD_MARKER, path, paper))
