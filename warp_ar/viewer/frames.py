"""Frames of the page: taken from the source when they are due, lit, recorded, handed out."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.device import exclusive
from warp_ar.engine.pipeline import Pipeline, Result
from warp_ar.errors import UsageError, WarpArError
from warp_ar.output.sinks import VideoSink
from warp_ar.scene import Camera, Pose
from warp_ar.sources.sources import Frame, Source
from warp_ar.stages.quality import PRESETS
from warp_ar.tracking.tracking import TrackState
from warp_ar.viewer.budget import BudgetSetting
from warp_ar.viewer.camera import BrowserCamera, CalibrationSession, Image, Pushed, guessed_camera
from warp_ar.viewer.controls import CONVERGING, Controls
from warp_ar.viewer.convergence import Convergence
from warp_ar.viewer.edits import Wanted
from warp_ar.viewer.light_record import LightState
from warp_ar.viewer.lighting import Lighting
from warp_ar.viewer.messages import Notify, failure
from warp_ar.viewer.setup import SetupChecks

MOST_FRAMES: Final = 9000
"""After so many a recording ends by itself: five minutes at 30 a second."""


class Recorder:
    """One recording at a time. Methods may be called from any thread."""

    def __init__(self, folder: Path) -> None:
        """Start without a recording.

        Args:
            folder: Where the video is kept; the newest recording replaces the one before.
        """
        self._path = folder / "recording.mp4"
        self._lock = threading.Lock()
        self._sink: VideoSink | None = None
        self._count = 0

    @property
    def count(self) -> int | None:
        """Frames recorded so far; None while nothing is recorded."""
        return None if self._sink is None else self._count

    def start(self, fps: float) -> None:
        """Record from now on; a recording that runs goes on."""
        with self._lock:
            if self._sink is None:
                self._path.unlink(missing_ok=True)
                self._sink, self._count = VideoSink(self._path, fps=fps), 0

    def stop(self) -> None:
        """Finish the recording, if there is one."""
        with self._lock:
            self._finish()

    def _finish(self) -> None:
        if self._sink is not None:
            sink, self._sink = self._sink, None
            sink.close()

    def add(self, image: npt.NDArray[np.uint8]) -> None:
        """Record a frame, if a recording runs.

        Raises:
            WarpArError: It cannot be recorded, such as one of another size; the recording has ended.
        """
        with self._lock:
            if self._sink is None:
                return
            try:
                self._sink.write(image)
            except WarpArError:
                with contextlib.suppress(WarpArError):
                    self._finish()
                raise
            self._count += 1
            if self._count >= MOST_FRAMES:
                self._finish()

    def video(self) -> bytes:
        """The finished recording, an MP4.

        Raises:
            UsageError: There is none.
        """
        with self._lock:  # a file that is being finished is not whole yet
            if self._sink is not None or not self._path.is_file():
                raise UsageError("nothing was recorded, or it has not ended")
            return self._path.read_bytes()


PLAY_RATE: Final = 30.0
"""Frames a second of clips that tell no rate."""
_LIGHT_SECONDS: Final = 0.25
"""How often the environment is looked at."""
_MEASURING_REST: Final = 0.15
"""Seconds that the frames rest, one from the next, while methods are timed: what runs beside them spoils the times."""
_STILL_SECONDS: Final = 0.25
"""How often a held frame is looked at again, where nothing was edited."""
_BUILDING_SECONDS: Final = 0.03
"""How often it is looked at while a pipeline is built."""
_NOTICE_SECONDS: Final = 5.0
"""Shortest time between two notices of frames that cannot be lit."""


@dataclasses.dataclass(frozen=True, eq=False)
class Lit:
    """One frame as the viewers get it."""

    id: int
    """Number of the frame since the page was started."""
    taken: float
    """When the source gave it, seconds of ``time.monotonic``."""
    stamp: float | None
    """When a browser's camera took it, milliseconds of the browser's own clock; None from other sources."""
    image: Image
    """Lit, uint8 RGB; the camera's own where nothing can light it yet."""
    other: Image | None
    """What it is compared with."""
    frame: Image
    """As the camera gave it."""
    pose: Pose | None
    """``camera_from_world``."""
    state: TrackState | None
    camera: Camera
    stages: tuple[tuple[str, float, bool], ...]
    """Name, milliseconds and whether it was skipped."""
    light_ms: float
    """From the frame in hand to the lit frame."""
    plan: int
    """Number of the plan that it was lit by; 0 where it was not."""


@dataclasses.dataclass(frozen=True)
class Helpers:
    """What takes part in every frame."""

    lighting: Lighting
    budget: BudgetSetting
    camera: BrowserCamera
    calibration: CalibrationSession
    recorder: Recorder
    setup: SetupChecks


class FrameLoop:
    """Lights frames on one thread, in ``run``. Its attributes may be read by any."""

    def __init__(
        self,
        controls: Controls,
        helpers: Helpers,
        *,
        frames: int | None,
        publish: Callable[[Lit], None],
        notify: Notify,
    ) -> None:
        """Begin nothing yet.

        Args:
            controls: What to show.
            helpers: What takes part in every frame.
            frames: End after so many lit frames.
            publish: Takes every frame, on the thread of ``run``.
            notify: Takes what else viewers should know.
        """
        self._controls, self._helpers, self._frames = controls, helpers, frames
        self._publish, self._notify = publish, notify
        self._id = self._lit = 0
        self._base = 0.0
        self._busy_ms = 0.0
        self._plan = 0
        self._light_time = self._notice_time = 0.0
        self.seconds = 0.0
        """Of the newest frame that was lit, since the first: the time of animations."""
        self._times: collections.deque[float] = collections.deque(maxlen=60)
        self._at = 0.0
        self._compared = ""
        self.convergence = Convergence()
        """The reference of a held frame."""
        self.latest: Lit | None = None
        """The newest frame."""
        self.light_state: LightState | None = None
        """The environment as it was a moment ago, with what is known of it; None while it is not known."""

    @property
    def fps(self) -> float:
        """Frames a second over the last ones."""
        times = list(self._times)
        return (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 and times[-1] > times[0] else 0.0

    @property
    def difference(self) -> float | None:
        """Mean absolute difference of the two compared pictures in percent of full scale."""
        lit = self.latest
        if (
            self._controls.compare not in PRESETS
            or lit is None
            or lit.other is None
            or lit.other.shape != lit.image.shape
        ):
            return None
        return round(100.0 * float(cv2.norm(lit.image, lit.other, cv2.NORM_L1)) / (lit.image.size * 255.0), 3)

    def run(self) -> None:
        """Light frames until told to stop. A failure of a source is told to the viewers; another source may follow."""
        controls = self._controls
        while not controls.stopped:
            try:
                with controls.feed.source as source:
                    self._run_source(source)
            except Exception as error:
                self._notify(failure(error, "no more frames come from this source"))
            with controls.changed:
                controls.changed.wait_for(lambda: controls.leaving)
            controls.adopt()

    def _run_source(self, source: Source) -> None:
        due, previous = time.monotonic(), 0.0
        start: float | None = None
        still: Frame | None = None
        for frame in source:
            if still is None or frame.exposure_time in (None, *source.exposures[:1]):
                still = frame  # a held picture is one of those that are shown
            if start is None:
                start = self._base - frame.time  # the pipeline's clock never runs back
            if not source.live:
                due = self._pace(due, max(frame.time - previous, 0.0))
                previous = frame.time
            if not (self._light_frame(frame, frame.time + start) and self._hold(still, frame.time + start)):
                return
            if self._frames is not None and self._lit >= self._frames:
                self._controls.stop()
                return

    def _pace(self, due: float, step: float) -> float:
        """Wait until a recorded frame is due; one that is late moves all that follow."""
        due = max(due + step, time.monotonic())
        controls = self._controls
        with controls.changed:
            controls.changed.wait_for(lambda: controls.leaving, timeout=max(due - time.monotonic(), 0.0))
        return due

    def _hold(self, frame: Frame, now: float) -> bool:
        """Rest while nobody watches; while held, light the same frame again after edits. False to leave the source."""
        controls, lighting, recorder = self._controls, self._helpers.lighting, self._helpers.recorder
        while True:
            with controls.changed:
                idle = controls.watchers == 0 and recorder.count is None and self._frames is None
                if controls.leaving:
                    return False
                if controls.playing and not idle:
                    return True
                seen = controls.edits
                controls.changed.wait_for(
                    lambda seen=seen, idle=idle: (  # type: ignore[misc]
                        controls.leaving or controls.edits != seen or (controls.playing and not idle)
                    ),
                    timeout=self._rest(idle),
                )
            if controls.watchers == 0 and recorder.count is None:
                lighting.follow()  # what is being built is to be there when somebody comes
            elif not controls.playing and not (self._converge() or self._light_frame(frame, now)):
                return False

    def _rest(self, idle: bool) -> float | None:
        """Seconds until a held frame is looked at again; None waits for somebody to come."""
        if idle and not self._helpers.lighting.busy:
            return None
        if not idle and self._converges():
            return 0.0
        return _BUILDING_SECONDS if self._helpers.lighting.busy else _STILL_SECONDS

    def _held(self) -> tuple[Wanted, int, float]:
        """What a held picture is of, the frame's own time among it; another one is dropped."""
        return self._controls.wanted, self._plan, self._at

    def _asks_reference(self) -> bool:
        """Whether a held frame is compared with its reference, and nothing changes how it is lit."""
        controls, latest = self._controls, self.latest
        asked = controls.compare in CONVERGING and not controls.playing and latest is not None and latest.plan != 0
        return asked and not self._helpers.lighting.changing

    def _converges(self) -> bool:
        """Whether samples are to be added to the reference of the held frame, which nothing has changed."""
        return self._asks_reference() and self.convergence.wants(self._held())

    def _converge(self) -> bool:
        """Add a slice of samples, and hand out what they show; False where the frame is to be lit instead.

        At rest the picture stays that of the reference: lit again, it would have light that came in meanwhile.
        """
        latest, compare = self.latest, self._controls.compare
        if latest is None or not self._asks_reference():
            return False
        if self.convergence.rests(self._held()) and self._helpers.recorder.count is None:
            shows = compare != self._compared
        elif self.convergence.wants(self._held()):
            shows = self._step()
        else:
            return False
        if shows:
            self._id += 1
            other, self._compared = self.convergence.other(self._held(), compare), compare
            self.latest = dataclasses.replace(latest, id=self._id, taken=time.monotonic(), stamp=None, other=other)
            self._publish(self.latest)
        return True

    def _step(self) -> bool:
        """Add a slice of samples; True if there is a new picture to show. A failure is told."""
        try:
            return self.convergence.step()
        except Exception as error:
            self._notify(failure(error, "the picture goes on without a reference"))
            return False

    def _beside(self, pipeline: Pipeline, frame: Frame, result: Result, now: float) -> Image | None:
        """What the picture is compared with."""
        controls, lighting = self._controls, self._helpers.lighting
        if controls.compare not in CONVERGING or controls.playing or lighting.changing:
            self.convergence.drop()
        if controls.compare not in CONVERGING:
            return lighting.other(frame, now)
        if not controls.playing and not lighting.changing:
            self.convergence.begin(self._held(), pipeline, frame.image, result, now, lighting.builder)
        self._compared = controls.compare
        return self.convergence.other(self._held(), controls.compare)

    def _light_frame(self, frame: Frame, now: float) -> bool:
        """Light one frame and hand it out; False to leave the source."""
        if self._controls.leaving:
            return False
        begin = time.perf_counter()
        self._at = now  # seconds on the pipeline's clock, which never runs back: another frame has another
        helpers = self._helpers
        pushed = helpers.camera.begin(frame.image, self._busy_ms)
        helpers.calibration.look(frame.image)
        pipeline = helpers.lighting.follow()
        if helpers.lighting.swaps != self._plan:
            self._plan = helpers.lighting.swaps
            helpers.budget.restart()
        try:
            lit = self._lit_by(pipeline, frame, now, pushed)
        except Exception as error:
            self._tell_failure(error)
            lit = None
        self.latest = lit or self._plain(frame, pushed)
        self._times.append(time.monotonic())
        if self.latest.plan:
            helpers.lighting.note_lit()
            helpers.setup.note(frame.image, self.latest.state, self.latest.pose, self._times[-1])
        try:
            helpers.recorder.add(self.latest.image)
        except Exception as error:
            self._notify(failure(error))
        self._publish(self.latest)
        self._busy_ms = (time.perf_counter() - begin) * 1e3
        if helpers.budget.measuring:
            controls = self._controls
            with controls.changed:
                controls.changed.wait_for(lambda: controls.leaving, timeout=_MEASURING_REST)
        return True

    def _tell_failure(self, error: Exception) -> None:
        """Tell why a frame is not lit. After a fault, the edit since the last lit frame is taken back.

        An error of the program's own, such as of an exposure that was not announced, says nothing of the edit.
        """
        taken_back = not isinstance(error, WarpArError) and self._helpers.lighting.take_back()
        if taken_back or time.monotonic() - self._notice_time > _NOTICE_SECONDS:
            self._notice_time = time.monotonic()
            then = "the edit is taken back and the frames go on" if taken_back else "the frames go on"
            self._notify(failure(error, then))

    def _lit_by(self, pipeline: Pipeline | None, frame: Frame, now: float, pushed: Pushed | None) -> Lit | None:
        """The lit frame; None where it cannot be lit."""
        height, width = frame.image.shape[:2]
        if pipeline is None or pipeline.size != (width, height):
            return None  # a pipeline for this camera is being built
        start = time.perf_counter()
        result = pipeline(frame.image, time_seconds=now, exposure_time=frame.exposure_time)
        image = result.image
        light_ms = (time.perf_counter() - start) * 1e3
        self.seconds = float(pipeline.arrays["seconds"]())
        self._base = now + 1.0 / PLAY_RATE
        self._lit += 1
        other = self._beside(pipeline, frame, result, now)
        self._look_at_light(pipeline)
        self._watch_cost(pipeline, frame, result, light_ms)
        stages = tuple((name, round(t.milliseconds, 3), t.skipped) for name, t in result.stages.items())
        return dataclasses.replace(
            self._plain(frame, pushed),
            image=image,
            other=other,
            pose=result.pose,
            state=result.state,
            camera=pipeline.camera,
            stages=stages,
            light_ms=light_ms,
            plan=self._plan,
        )

    def _plain(self, frame: Frame, pushed: Pushed | None) -> Lit:
        """A frame as the camera gave it, for viewers to see meanwhile."""
        self._id += 1
        taken, stamp = (pushed.taken, pushed.stamp) if pushed is not None else (time.monotonic(), None)
        camera = self._controls.camera_of(self._controls.feed)
        size = frame.image.shape[1], frame.image.shape[0]
        if (camera.width, camera.height) != size:
            camera = guessed_camera(*size)
        return Lit(self._id, taken, stamp, frame.image, None, frame.image, None, None, camera, (), 0.0, 0)

    def _look_at_light(self, pipeline: Pipeline) -> None:
        now = time.monotonic()
        if now - self._light_time < _LIGHT_SECONDS:
            return
        self._light_time = now
        light = pipeline.arrays.get("environment")
        if light is None:
            self.light_state = None
            return
        with exclusive(pipeline.device):
            values = np.array(light.numpy())
            others = pipeline.arrays.get("others_environment")
            others = () if others is None else tuple(np.array(others.numpy()))
            scale = pipeline.arrays.get("expose_scale")
            exposure = 1.0 if scale is None else float(scale.numpy()[0])
        status = pipeline.arrays.get("recover_status")
        known = {} if status is None else status()
        places = tuple(probe.center for probe in pipeline.scene.probes[: len(others) + 1])
        seen = values.any()  # black until the ball has been seen once
        self.light_state = LightState(values, exposure, known, others, places) if seen else None

    def _watch_cost(self, pipeline: Pipeline, frame: Frame, result: Result, light_ms: float) -> None:
        """Learn what the preset costs; under a budget, choose the methods that it asks for."""
        if not result.shown or (result.pose is None and pipeline.plan.needs("pose")):
            return
        controls, helpers = self._controls, self._helpers
        wanted = controls.wanted
        # A held frame changes nothing, a pipeline on its way out says nothing about the next one.
        steady = not helpers.lighting.changing and controls.playing and pipeline.quality == wanted.shown_quality()
        helpers.budget.look(pipeline, frame.image, result.pose, helpers.lighting.builder)
        chosen = helpers.budget.observe(wanted.quality.name, light_ms if steady else None)
        if chosen is not None and chosen != wanted.quality:
            helpers.budget.forget_costs(chosen.name)
            controls.change(lambda w: dataclasses.replace(w, quality=chosen) if helpers.budget.rules(w.quality) else w)
