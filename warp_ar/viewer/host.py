"""Runs a session's frames for the page: one thread lights them, another builds pipelines, edits come in between."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import math
import statistics
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.accuracy.budget import AUTO
from warp_ar.device import exclusive
from warp_ar.engine.pipeline import Pipeline, Result, resolve_quality
from warp_ar.errors import UsageError, WarpArError
from warp_ar.input.camera_calibration import GOOD_VIEWS, BoardViews, CameraReport, write_camera
from warp_ar.input.card import write_card
from warp_ar.input.exposures import plan_bracket
from warp_ar.input.sources import Frame, QueueSource, Source, open_source
from warp_ar.input.tracking import TrackState
from warp_ar.output.report import left_out, stage_names
from warp_ar.output.sinks import VideoSink, write_environment
from warp_ar.scene import Camera, CharucoBoard, Marker, Pose, Scene, SourceSpec, bundled_scenes, dumps_scene, load_scene
from warp_ar.stages import STAGES
from warp_ar.stages.quality import DEFAULT_PRESET, PRESETS, Quality
from warp_ar.viewer import edits, protocol
from warp_ar.viewer.dial import Dial
from warp_ar.viewer.edits import Wanted
from warp_ar.viewer.intrinsics import FocalEstimator, guessed_camera

Image = npt.NDArray[np.uint8]

CAMERA: Final = "camera"
"""What a picture is compared with when it is not another preset."""
MOST_RECORDED: Final = 9000
"""Frames after which a recording ends by itself: five minutes at 30 a second."""
PLAY_RATE: Final = 30.0
"""Frames a second of clips that tell no rate."""
_LIGHT_SECONDS: Final = 0.25
"""How often the environment is looked at."""
_COST_FRAMES: Final = 30
_SETTLED: Final = 10
_MEASURING_REST: Final = 0.15
"""Seconds that the frames rest, one from the next, while methods are timed: what runs beside them spoils the times."""
BOARD: Final = Marker(dictionary="DICT_5X5_100", board=CharucoBoard(7, 5, 0.03, 0.022))
"""What a camera is calibrated with: a sheet of A4."""
_BOARD_SECONDS: Final = 0.4
"""How often the board is looked for."""
_CAMERA_LEAD_MS: Final = 40.0
"""How long a picture of a browser's camera is about to be packed, sent and unpacked."""
_STILL_SECONDS: Final = 0.25
"""How often a held frame is looked at again, where nothing was edited."""
_FOCAL_STEP: Final = 0.01
"""Share by which a better estimate must differ to be worth another pipeline."""
_LOOK_SECONDS: Final = 0.2
"""How often it is looked at meanwhile: finding the marker once more takes several milliseconds."""
_ESTIMATE_SECONDS: Final = 30.0
"""How long a browser's camera is watched before its guessed focal length is left as it is."""


@dataclasses.dataclass(frozen=True, eq=False)
class Lit:
    """One frame as the viewers get it."""

    id: int
    """Number of the frame since the host was started."""
    taken: float
    """When the source gave it, seconds of ``time.monotonic``."""
    stamp: float | None
    """When a browser's camera took it, milliseconds of the browser's own clock; None from other sources."""
    image: Image
    """Lit, uint8 RGB."""
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
    """Number of the plan that it was lit by: grows whenever stages or quality change."""


@dataclasses.dataclass(frozen=True)
class _Target:
    """What a pipeline is built for."""

    scene: Scene
    quality: Quality
    size: tuple[int, int]
    outputs: tuple[str, ...]
    exposures: tuple[float, ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class _Pushed:
    """A picture of a browser's camera on its way to being lit."""

    image: Image
    id: int
    taken: float
    """When it came, seconds of ``time.monotonic``."""
    stamp: float
    """When it was taken, milliseconds of the browser's own clock."""


@dataclasses.dataclass(frozen=True, eq=False)
class _Feed:
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


class _Slot:
    """A pipeline that follows what is wanted: edited in place where only numbers change, else built anew meanwhile."""

    def __init__(self, device: str, builder: ThreadPoolExecutor) -> None:
        self._device, self._builder = device, builder
        self._building: Future[Pipeline] | None = None
        self._built_for: _Target | None = None
        self._target: _Target | None = None
        self.pipeline: Pipeline | None = None
        self.swaps = 0

    def _build(self, target: _Target) -> Pipeline:
        # On CUDA only a pipeline that profiles knows what each stage takes.
        pipeline = Pipeline(
            target.scene,
            device=self._device,
            quality=target.quality,
            size=target.size,
            outputs=target.outputs,
            exposures=target.exposures,
            profile=True,
        )
        pipeline.warm_up()
        return pipeline

    def _fits(self, pipeline: Pipeline, target: _Target) -> bool:
        request = pipeline.plan.request
        same = (request.quality, pipeline.size, request.outputs) == (target.quality, target.size, target.outputs)
        same = same and request.exposures == plan_bracket(target.exposures).ratios
        return same and pipeline.update(target.scene)

    def follow(self, target: _Target, *, wait: bool = False) -> Pipeline | None:
        """The pipeline to use for the next frame: ``target``'s if it is ready, else the one before.

        Raises:
            WarpArError: The pipeline for ``target`` cannot be built; the one before stays.
        """
        if self._building is not None and (wait or self._building.done()):
            building, self._building = self._building, None
            new = building.result()
            if self._fits(new, target):
                if self.pipeline is not None:
                    new.continue_from(self.pipeline)
                    self.pipeline.close()
                self.pipeline, self._target = new, target
                self.swaps += 1
                return new
            new.close()
        if target is not self._target and self._building is None:
            if self.pipeline is not None and self._fits(self.pipeline, target):
                self._target = target
            else:
                self._building = self._builder.submit(self._build, target)
                if wait:
                    return self.follow(target, wait=True)
        return self.pipeline

    @property
    def busy(self) -> bool:
        """Whether a pipeline is being built."""
        return self._building is not None

    def close(self) -> None:
        """Let everything go."""
        if self._building is not None:
            with contextlib.suppress(WarpArError):
                self._building.result().close()
            self._building = None
        if self.pipeline is not None:
            self.pipeline.close()
            self.pipeline = None
        self._target = None


def _where(spec: SourceSpec) -> str | int | Path:
    if spec.path is not None:
        return spec.path
    return spec.camera if spec.camera is not None else f"synthetic:{spec.synthetic}"


class Host:
    """Lights frames for viewers. Every method may be called from any thread."""

    def __init__(
        self,
        scene: Scene,
        *,
        source: str | int | Path | None = None,
        device: str = "auto",
        quality: str | Quality = "medium",
        budget_ms: float | None = None,
        frames: int | None = None,
        publish: Callable[[Lit], None] = lambda lit: None,
        notify: Callable[[dict[str, Any]], None] = lambda message: None,
    ) -> None:
        """Open the source and build the pipeline.

        Args:
            scene: What to show first.
            source: Frames instead of the scene's own.
            device: ``auto``, ``cpu`` or ``cuda:N``.
            quality: A preset's name, a value, or ``auto``.
            budget_ms: Milliseconds per frame for ``auto``; None means 33.
            frames: End after so many frames.
            publish: Takes every lit frame, on the host's own thread.
            notify: Takes what else viewers should know, on any thread.

        Raises:
            WarpArError: The source cannot be opened, or the pipeline not built.
        """
        self._publish, self._notify = publish, notify
        self._given_source, self._frames = source, frames
        self._lock = threading.Condition()
        self._dial = Dial(notify)
        if quality == AUTO:
            self._dial.switch(budget_ms or self._dial.last_budget)
        self._preset = PRESETS[DEFAULT_PRESET] if quality == AUTO else resolve_quality(quality)
        self._wanted = Wanted(scene, self._dial.start_quality() if quality == AUTO else self._preset)
        self._original = self._wanted
        self._good = self._wanted
        self._edits = 0
        self._playing = True
        self._watchers = 0
        self._compare = ""
        self._stopped = False
        self._camera_owner: object | None = None
        self._estimator: FocalEstimator | None = None
        self._estimated: float | None = None
        self._views: BoardViews | None = None
        self._looking: Future[None] | None = None
        self._looked_at_board = 0.0
        self._report: CameraReport | None = None
        self._calibrated: dict[tuple[int, int], Camera] = {}
        self._next: _Feed | None = None
        self._feed = _Feed(self._open(scene))
        self._builder = ThreadPoolExecutor(1, "warp-ar-build")
        self._main, self._second = _Slot(device, self._builder), _Slot(device, self._builder)
        self._costs: dict[str, collections.deque[float]] = {}
        self._since_swap = 0
        self._recording: tuple[VideoSink, Path] | None = None
        self._recorded = 0
        self._folder = tempfile.TemporaryDirectory(prefix="warp_ar_live_")
        self._times: collections.deque[float] = collections.deque(maxlen=60)
        self._pushed: collections.deque[_Pushed] = collections.deque(maxlen=4)
        self._looked = 0.0
        self._busy_ms = 0.0
        self._followed: Any = None
        self._light: npt.NDArray[np.float32] | None = None
        self._light_time = 0.0
        self._id = 0
        self._base = 0.0
        self.latest: Lit | None = None
        """The newest frame."""
        try:
            self._main.follow(self._target(), wait=True)
        except BaseException:
            self.close()
            raise

    # ------------------------------------------------------------------------------------------------- what viewers ask

    @property
    def description(self) -> str:
        """The source in one line, without its folder."""
        return self._feed.source.description.rsplit("/", 1)[-1]

    def watch(self, change: int) -> None:
        """One viewer more (1) or less (-1): without any, no frame is lit."""
        with self._lock:
            self._watchers += change
            self._edits += change > 0
            self._lock.notify_all()

    def stop(self) -> None:
        """End ``run`` after the frame in hand."""
        with self._lock:
            self._stopped = True
            self._lock.notify_all()
        if self._feed.source.live:
            self._feed.source.close()

    def wanted(self) -> Wanted:
        """What viewers see now, or will once it is built."""
        return self._wanted

    def _change(self, make: Callable[[Wanted], Wanted]) -> None:
        with self._lock:
            self._wanted = make(self._wanted)
            self._edits += 1
            self._lock.notify_all()
        self._notify(self.scene_message())

    def edit(self, command: protocol.Command, owner: object = None) -> None:
        """Do what a page asks for.

        Args:
            command: What.
            owner: Who asks; matters for the camera only.

        Raises:
            WarpArError: It cannot be done; nothing has changed.
        """
        match command:
            case protocol.Set(part, index, key, value):
                self._change(lambda w: dataclasses.replace(w, scene=edits.set_value(w.scene, part, index, key, value)))
            case protocol.Add(part, kind):
                self._change(lambda w: dataclasses.replace(w, scene=edits.add_part(w.scene, part, kind)))
            case protocol.Remove(part, index):
                self._change(lambda w: w.without_part(part, index))
            case protocol.Show(part, index, on):
                item = {(part, index)}
                self._change(lambda w: dataclasses.replace(w, hidden=w.hidden - item if on else w.hidden | item))
            case protocol.Effect(name, on):
                self._change(lambda w: w.with_effect(name, on))
            case protocol.SetQuality(name):
                self._set_budget(self._dial.last_budget if name == AUTO else None, name)
            case protocol.Method(stage, method):
                self._change(lambda w: w.with_method(stage, method))
            case protocol.Budget(ms):
                self._set_budget(ms, self._preset.name)
            case protocol.Compare(other):
                if other not in ("", CAMERA, *PRESETS):
                    raise UsageError(f"compare with {other!r}; expected {CAMERA} or a preset: {', '.join(PRESETS)}")
                with self._lock:
                    self._compare = other
                    self._edits += 1
                    self._lock.notify_all()
                self._notify(self.state_message())
            case protocol.Play(on):
                with self._lock:
                    self._playing = on
                    self._lock.notify_all()
                self._notify(self.state_message())
            case protocol.OpenScene(name):
                self._open_scene(name)
            case protocol.Reset():
                self._change(lambda w: dataclasses.replace(self._original, quality=w.quality))
            case protocol.UseCamera(width, height):
                self._use_camera(width, height, owner)
            case protocol.LeaveCamera():
                self.leave_camera(owner)
            case protocol.Calibrate(step):
                self._calibrate(step)
            case protocol.Record(on):
                with self._lock:
                    self._start_recording() if on else self._stop_recording()
                self._notify(self.state_message())

    def _set_budget(self, budget: float | None, preset: str) -> None:
        """Keep to a budget, or with None show a preset."""
        if budget is None:
            quality = self._preset = resolve_quality(preset)
        else:
            auto = self._wanted.quality.name == AUTO
            quality = self._wanted.quality if auto else self._dial.start_quality()
        self._dial.switch(budget)
        self._change(lambda w: dataclasses.replace(w, quality=quality))
        self._notify(self.state_message())

    def _open(self, scene: Scene) -> Source:
        if self._given_source is not None:
            return open_source(self._given_source, loop=True)
        if scene.source is None:
            raise UsageError(f"scene {scene.name!r} names no source; give one with --source")
        spec = scene.source
        return open_source(_where(spec), fps=spec.fps, loop=True, exposures=spec.exposures or ())

    def _open_scene(self, name: str) -> None:
        if name not in bundled_scenes():
            raise UsageError(f"no bundled scene {name!r}; expected {', '.join(bundled_scenes())}")
        scene = load_scene(name)
        auto = self._wanted.quality.name == AUTO
        wanted = self._original = Wanted(scene, self._dial.start_quality() if auto else self._wanted.quality)
        self._costs.clear()
        if self._feed.is_browser or self._given_source is not None:
            self._change(lambda _: wanted)
        else:
            self._switch(_Feed(self._open(scene), wanted=wanted))

    def _switch(self, feed: _Feed) -> None:
        """Go on with another source after the frame in hand."""
        with self._lock:
            left, self._next = self._next, feed
            current = self._feed.source
            self._lock.notify_all()
        if left is not None:
            left.source.close()
        if current.live:
            current.close()

    def _adopt(self) -> None:
        with self._lock:
            if self._next is None:
                return
            self._feed, self._next = self._next, None
            self._wanted = self._feed.wanted or self._wanted
        self._notify(self.scene_message())
        self._notify(self.state_message())

    # ----------------------------------------------------------------------------------------------- the page's camera

    def _use_camera(self, width: int, height: int, owner: object) -> None:
        feed = self._next or self._feed
        if feed.is_browser and feed.owner is not owner:
            raise UsageError("another viewer's camera is the source; it must be switched off there first")
        self._estimator = self._estimated = None
        known = self._calibrated.get((width, height))
        if known is None and self._wanted.scene.marker.board is None:
            self._estimator = FocalEstimator(self._wanted.scene.marker, width, height)
            self._estimate_until = time.monotonic() + _ESTIMATE_SECONDS
        source = QueueSource((width, height), description="the browser's camera")
        self._switch(_Feed(source, known or guessed_camera(width, height), owner=owner))

    def leave_camera(self, owner: object) -> None:
        """Back to the scene's own source, if ``owner``'s camera is the source."""
        feed = self._next or self._feed
        if feed.is_browser and feed.owner is owner:
            self._estimator = None
            self._switch(_Feed(self._open(self._wanted.scene)))

    def camera_size(self, owner: object) -> tuple[int, int] | None:
        """Size of the pictures that ``owner`` may push now; None if it is not the source."""
        feed = self._next or self._feed
        return feed.source.size if feed.is_browser and feed.owner is owner else None

    def push(self, taken: protocol.Picture, owner: object) -> None:
        """Take a picture of a browser's camera; blocks while it is decoded.

        The page hears of it again, as ``taken``, when it is its turn to be lit: sooner, another would only take its
        place.

        Raises:
            ProtocolError: It cannot be decoded.
        """
        try:
            picture = cv2.imdecode(np.frombuffer(taken.jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)
        except cv2.error as error:
            raise protocol.ProtocolError("picture cannot be decoded") from error
        if picture is None:
            raise protocol.ProtocolError("picture cannot be decoded")
        feed = self._next or self._feed
        if feed.owner is not owner or feed.source.size != (picture.shape[1], picture.shape[0]):
            return  # switched off meanwhile
        assert isinstance(feed.source, QueueSource)
        now = time.monotonic()
        self._pushed.append(_Pushed(picture, taken.id, now, taken.taken))
        feed.source.push(picture, now)
        self._estimate(picture, now)

    def _estimate(self, picture: Image, now: float) -> None:
        estimator = self._estimator
        if estimator is None or now < self._looked + _LOOK_SECONDS:
            return
        self._looked = now
        found = estimator.estimate() if estimator.look(picture) and estimator.ripe else None
        if found is not None and abs(found.focal / (self._estimated or math.inf) - 1.0) > _FOCAL_STEP:
            self._estimated = found.focal
            camera = guessed_camera(picture.shape[1], picture.shape[0], focal=found.focal)
            with self._lock:
                self._feed = dataclasses.replace(self._feed, camera=camera)
                self._edits += 1
            self._notify({"type": "intrinsics", "focal": found.focal, "spread": found.spread, "views": found.views})
        if estimator.full or now > self._estimate_until:
            self._estimator = None
            if self._estimated is None:
                self._notify({"type": "intrinsics", "focal": None, "spread": None, "views": 0})

    # ----------------------------------------------------------------------------------------------------- calibration

    def _calibrate(self, step: str) -> None:
        if step == "finish":
            if self._views is None:
                raise UsageError("nothing was looked at yet: start the calibration first")
            self._report = report = self._views.solve()
            camera = dataclasses.replace(report.camera, transfer=self._wanted.scene.camera.transfer)
            with self._lock:
                self._calibrated[camera.width, camera.height] = camera
                self._feed = dataclasses.replace(self._feed, camera=camera)
                self._edits += 1
            self._estimator = None
        self._views = BoardViews(BOARD) if step == "start" else None
        self._notify(self.calibration_message())

    def _look_for_board(self, image: Image) -> None:
        """Have a frame looked at beside the others; newer ones are left aside meanwhile."""
        views, now = self._views, time.monotonic()
        if views is None or now - self._looked_at_board < _BOARD_SECONDS:
            return
        if self._looking is not None and not self._looking.done():
            return
        self._looked_at_board = now

        def look() -> None:
            try:
                new = views.add(image)
            except UsageError as error:  # the source has changed
                self._views, new = None, True
                self._notify({"type": "notice", "text": str(error), "bad": True})
            if new:
                self._notify(self.calibration_message())

        self._looking = self._builder.submit(look)

    def calibration_message(self) -> dict[str, Any]:
        """How far the calibration has come."""
        views, report = self._views, self._report
        return {
            "type": "calibration",
            "on": views is not None,
            "views": 0 if views is None else len(views.views),
            "wanted": GOOD_VIEWS,
            "covered": [] if views is None else views.covered().tolist(),
            "report": None
            if report is None
            else {
                "focal": report.camera.fx,
                "error": report.error,
                "deviation": report.focal_deviation,
                "coverage": report.coverage,
                "warnings": list(report.warnings),
            },
        }

    def camera_file(self) -> bytes:
        """The calibrated camera as OpenCV's YAML.

        Raises:
            UsageError: None was calibrated.
        """
        if self._report is None:
            raise UsageError("no camera was calibrated here")
        with tempfile.TemporaryDirectory(dir=self._folder.name) as folder:
            path = Path(folder) / "camera.yml"
            write_camera(self._report, path)
            return path.read_bytes()

    def board_picture(self) -> bytes:
        """The board to print, a PNG of a sheet of A4."""
        with tempfile.TemporaryDirectory(dir=self._folder.name) as folder:
            path = Path(folder) / "board.png"
            write_card(BOARD, path, dpi=300.0)
            return path.read_bytes()

    # ------------------------------------------------------------------------------------------------------ the frames

    def run(self) -> None:
        """Light frames until told to stop. Errors of a source are told to the viewers; another source may follow."""
        while not self._stopped:
            try:
                with self._feed.source as source:
                    self._run_source(source)
            except WarpArError as error:
                self._notify({"type": "notice", "text": str(error), "bad": True})
            with self._lock:
                self._lock.wait_for(self._leaving)
            self._adopt()

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
            if self._frames is not None and self._id >= self._frames:
                self._stopped = True
                return

    def _pace(self, due: float, step: float) -> float:
        """Wait until a recorded frame is due; one that is late moves all that follow."""
        due = max(due + step, time.monotonic())
        with self._lock:
            self._lock.wait_for(self._leaving, timeout=max(due - time.monotonic(), 0.0))
        return due

    def _leaving(self) -> bool:
        return self._stopped or self._next is not None

    def _hold(self, frame: Frame, now: float) -> bool:
        """Rest while nobody watches; while held, light the same frame again after edits. False to leave the source."""
        while True:
            with self._lock:
                idle = self._watchers == 0 and self._recording is None and self._frames is None
                if self._leaving():
                    return False
                if self._playing and not idle:
                    return True
                seen = self._edits
                busy = self._main.busy or self._second.busy
                self._lock.wait_for(
                    lambda seen=seen, idle=idle: self._leaving() or self._edits != seen or (self._playing and not idle),  # type: ignore[misc]
                    timeout=0.03 if busy and not idle else None if idle else _STILL_SECONDS,
                )
                if self._watchers == 0 and self._recording is None:
                    continue
            if not self._playing and not self._light_frame(frame, now):
                return False

    def _target(self) -> _Target:
        scene = dataclasses.replace(self._wanted.shown_scene(), camera=self._feed.camera or self._wanted.scene.camera)
        # The page draws handles where parts are: that takes the pose, even where no stage does.
        outputs = ("image", "pose") if self._wanted.scene.objects or self._wanted.scene.lights else ("image",)
        source = self._feed.source
        return _Target(scene, self._wanted.shown_quality(), source.size, outputs, source.exposures)

    def _follow(self) -> Pipeline | None:
        """The pipeline for the next frame; what cannot be built is undone and told."""
        with self._lock:
            wanted, compare = self._wanted, self._compare
            if (wanted, compare, self._feed) != self._followed:
                self._followed = (wanted, compare, self._feed)
                self._now = self._target()
                self._then = dataclasses.replace(self._now, quality=PRESETS[compare]) if compare in PRESETS else None
        before = self._main.swaps
        try:
            pipeline = self._main.follow(self._now)
            if not self._main.busy:
                self._good = wanted
        except WarpArError as error:
            self._notify({"type": "notice", "text": str(error), "bad": True})
            self._dial.switch(None)
            self._change(lambda _: self._good)
            pipeline = self._main.pipeline
        if self._main.swaps != before:
            self._since_swap = 0
            self._dial.restart()
            self._notify(self.plan_message())
        if self._then is None:
            self._second.close()
        elif not self._main.busy:
            with contextlib.suppress(WarpArError):
                self._second.follow(self._then)
        return pipeline

    def _light_frame(self, frame: Frame, now: float) -> bool:
        """Light one frame and hand it out; False to leave the source."""
        if self._leaving():
            return False
        pushed = next((item for item in tuple(self._pushed) if item.image is frame.image), None)
        if pushed is not None:
            # The next one shall come when this one is done, not sooner, and not have waited by then.
            wait = max(self._busy_ms - _CAMERA_LEAD_MS, 0.0)
            self._notify({"type": "taken", "id": pushed.id, "wait": round(wait, 1)})
        begin = time.perf_counter()
        self._look_for_board(frame.image)
        pipeline = self._follow()
        height, width = frame.image.shape[:2]
        if pipeline is None or pipeline.size != (width, height):
            time.sleep(0.01)  # a pipeline for this camera is being built
            return True
        taken, stamp = (pushed.taken, pushed.stamp) if pushed is not None else (time.monotonic(), None)
        start = time.perf_counter()
        result = pipeline(frame.image, time_seconds=now, exposure_time=frame.exposure_time)
        image = result.image
        light_ms = (time.perf_counter() - start) * 1e3
        self._base = now + 1.0 / PLAY_RATE
        other = self._other(frame, now)
        self._look_at_light(pipeline)
        self._watch_cost(pipeline, frame.image, result, light_ms)
        self._id += 1
        self._times.append(time.monotonic())
        stages = tuple((name, round(t.milliseconds, 3), t.skipped) for name, t in result.stages.items())
        self.latest = Lit(
            self._id,
            taken,
            stamp,
            image,
            other,
            frame.image,
            result.pose,
            result.state,
            pipeline.camera,
            stages,
            light_ms,
            self._main.swaps,
        )
        self._record(image)
        self._publish(self.latest)
        self._busy_ms = (time.perf_counter() - begin) * 1e3
        if self._dial.measuring:
            with self._lock:
                self._lock.wait_for(self._leaving, timeout=_MEASURING_REST)
        return True

    def _other(self, frame: Frame, now: float) -> Image | None:
        if self._compare == CAMERA:
            return frame.image
        pipeline = self._second.pipeline
        if pipeline is None or pipeline.size != (frame.image.shape[1], frame.image.shape[0]):
            return None
        return pipeline(frame.image, time_seconds=now, exposure_time=frame.exposure_time).image

    def _look_at_light(self, pipeline: Pipeline) -> None:
        now = time.monotonic()
        if now - self._light_time < _LIGHT_SECONDS:
            return
        self._light_time = now
        light = pipeline.arrays.get("environment")
        if light is None:
            self._light = None
            return
        with exclusive(pipeline.device):
            values = np.array(light.numpy())
        # Black until the ball has been seen once.
        self._light = values if values.any() else None

    def _watch_cost(self, pipeline: Pipeline, image: Image, result: Result, light_ms: float) -> None:
        """Learn what the preset costs; under a budget, turn the settings that it asks for."""
        if not result.shown or (result.pose is None and pipeline.plan.needs("pose")):
            return
        self._since_swap += 1
        wanted = self._wanted
        # A held frame changes nothing, a pipeline on its way out says nothing about the next one.
        busy = self._main.busy or self._dial.measuring or not self._playing
        counts = not busy and pipeline.quality == wanted.shown_quality()
        if counts and self._since_swap > _SETTLED:
            self._costs.setdefault(wanted.quality.name, collections.deque(maxlen=_COST_FRAMES)).append(light_ms)
        self._dial.look(pipeline, image, result.pose, self._builder)
        chosen = self._dial.choose(light_ms if counts else None, time.monotonic())
        if chosen is not None and chosen != wanted.quality:
            self._costs.pop(AUTO, None)
            self._change(lambda w: dataclasses.replace(w, quality=chosen) if w.quality.name == AUTO else w)

    def costs(self) -> dict[str, float]:
        """Median milliseconds per frame of every preset that has run on this scene."""
        return {name: round(statistics.median(times), 2) for name, times in list(self._costs.items()) if times}

    # ------------------------------------------------------------------------------------------------------- recording

    def _start_recording(self) -> None:
        if self._recording is not None:
            return
        path = Path(self._folder.name) / "recording.mp4"
        path.unlink(missing_ok=True)
        self._recording, self._recorded = (VideoSink(path, fps=self._feed.source.fps), path), 0

    def _stop_recording(self) -> None:
        if self._recording is not None:
            (sink, _), self._recording = self._recording, None
            sink.close()

    def _record(self, image: Image) -> None:
        with self._lock:
            if self._recording is None:
                return
            try:
                self._recording[0].write(image)
                self._recorded += 1
                if self._recorded >= MOST_RECORDED:
                    self._stop_recording()
            except WarpArError as error:  # such as another size of the frames
                self._notify({"type": "notice", "text": str(error), "bad": True})
                with contextlib.suppress(WarpArError):
                    self._stop_recording()

    def recording(self) -> bytes:
        """The finished recording, an MP4.

        Raises:
            UsageError: There is none.
        """
        path = Path(self._folder.name) / "recording.mp4"
        if self._recording is not None or not path.is_file():
            raise UsageError("nothing was recorded, or it has not ended")
        return path.read_bytes()

    def snapshot(self) -> bytes:
        """The newest lit frame as a PNG.

        Raises:
            UsageError: No frame has been lit.
        """
        if self.latest is None:
            raise UsageError("no frame has been lit yet")
        return bytes(cv2.imencode(".png", self.latest.image[..., ::-1])[1])

    def environment_exr(self) -> bytes:
        """The environment as an EXR.

        Raises:
            UsageError: It is not known.
        """
        if self._light is None:
            raise UsageError(
                "the environment is not captured: no stage of this scene reads it, or the marker was not seen"
            )
        with tempfile.TemporaryDirectory(dir=self._folder.name) as folder:
            path = Path(folder) / "environment.exr"
            write_environment(path, self._light)
            return path.read_bytes()

    def scene_toml(self, *, full_paths: bool) -> str:
        """The scene as it is shown, as a scene file.

        Args:
            full_paths: Write the paths of files in full; else relative to the scene's folder where they lie in it.
        """
        scene = self._target().scene
        folder = None if full_paths or scene.path is None else scene.path.parent
        return dumps_scene(dataclasses.replace(scene, path=None), folder)

    # ---------------------------------------------------------------------------------------------------- what is told

    def scene_message(self) -> dict[str, Any]:
        """The scene as it is edited."""
        return {"type": "scene", "scene": edits.wanted_record(self._wanted)}

    def plan_message(self) -> dict[str, Any]:
        """The stages that run, and why the others do not."""
        pipeline = self._main.pipeline
        assert pipeline is not None
        summaries = {kind.name: kind.summary for kind in STAGES} | {"track": "finds the marker and the camera's pose"}
        methods = {kind.name: list(kind.methods) for kind in STAGES if len(kind.methods) > 1}
        plan = pipeline.plan
        return {
            "type": "plan",
            "plan": self._main.swaps,
            "device": str(pipeline.device),
            "quality": pipeline.quality.name,
            "run": [
                {
                    "stage": name,
                    "method": pipeline.quality.method(name),
                    "methods": methods.get(name, []),
                    "summary": summaries[name],
                }
                for name in stage_names(plan)
            ],
            "left_out": [
                {"stage": name, "reason": reason, "methods": methods.get(name, [])} for name, reason in left_out(plan)
            ],
        }

    def state_message(self) -> dict[str, Any]:
        """What changes by itself."""
        times = list(self._times)
        fps = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 and times[-1] > times[0] else 0.0
        second = self._second.pipeline
        return {
            "type": "state",
            "fps": round(fps, 2),
            "source": self.description,
            "camera": self._feed.is_browser,
            "estimating": self._estimator is not None,
            "playing": self._playing,
            "recording": self._recorded if self._recording is not None else None,
            "building": self._main.busy or self._second.busy,
            "compare": self._compare,
            "compare_ready": self._compare in ("", CAMERA) or second is not None,
            "budget": self._dial.budget,
            "auto": self._dial.state(),
            "costs": self.costs(),
            "watchers": self._watchers,
            "difference": self._measured_difference(),
        }

    def _measured_difference(self) -> float | None:
        """Mean absolute difference of the two compared pictures in percent of full scale."""
        lit = self.latest
        if self._compare not in PRESETS or lit is None or lit.other is None or lit.other.shape != lit.image.shape:
            return None
        return round(100.0 * float(cv2.norm(lit.image, lit.other, cv2.NORM_L1)) / (lit.image.size * 255.0), 3)

    def light(self) -> npt.NDArray[np.float32] | None:
        """The environment, latlong linear RGB, as it was a moment ago."""
        return self._light

    def dial_message(self) -> dict[str, Any]:
        """What budgets buy."""
        return self._dial.record()

    def close(self) -> None:
        """Let the source, the pipelines and all temporary files go."""
        self._stopped = True
        self._dial.stop()
        with self._lock, contextlib.suppress(WarpArError):
            self._stop_recording()
        for feed in (self._feed, self._next):
            if feed is not None:
                feed.source.close()
        self._main.close()
        self._second.close()
        self._builder.shutdown()
        self._folder.cleanup()
