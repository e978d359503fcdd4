"""Pipelines of the page: one renders the frames, another the comparison picture; both follow the wanted state.

The reference of a held frame is path-traced in slices of samples, with the light, pose and scene of the last lit frame.
Any change (new frames, an edit, another plan) drops the reference, and the next held frame starts a new one.
"""

from __future__ import annotations

import contextlib
import dataclasses
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Final

import cv2
import numpy as np

from warp_ar.accuracy.known_frame import known_frame
from warp_ar.accuracy.path_tracer import PathTracer, TracedPicture
from warp_ar.device import resolve_device
from warp_ar.engine.graph import Plan, make_plan
from warp_ar.engine.pipeline import Pipeline, Result
from warp_ar.engine.switcher import PipelineSwitcher, Target
from warp_ar.errors import WarpArError
from warp_ar.output.report import left_out, stage_names
from warp_ar.sources.exposures import plan_bracket
from warp_ar.sources.source import Frame
from warp_ar.stages import STAGES
from warp_ar.stages.quality import PRESETS
from warp_ar.stages.request import Request
from warp_ar.tracking.tracking import given_pose
from warp_ar.viewer.controls import CAMERA, Controls, Feed, Image
from warp_ar.viewer.edits import Wanted
from warp_ar.viewer.protocol import Notify, failure, notice

FIRST: Final = dataclasses.replace(
    PRESETS["low"].with_methods(recover="white_card", environment_shadow="none"), name="the first picture"
)
"""Quality until the wanted plan is built: ``low`` without the methods that take long to compile."""
_AS_QUICK: Final = ("low", "paper")
"""Presets that are built directly, as they take no longer than ``FIRST``."""


def make_target(wanted: Wanted, feed: Feed) -> Target:
    """Return the scene, quality, size, outputs and exposures for which a pipeline is built."""
    scene = dataclasses.replace(wanted.shown_scene(), camera=feed.camera_for(wanted))
    # The page draws handles on objects and lights, which needs the pose even if no stage does.
    outputs = ("image", "pose") if wanted.scene.objects or wanted.scene.lights else ("image",)
    return Target(scene, wanted.shown_quality(), feed.source.size, outputs, feed.source.exposures)


class Lighting:
    """Pipelines that follow the wanted state.

    Methods are called by the thread of the frames; properties may be read by any thread.
    """

    def __init__(self, controls: Controls, device: str, notify: Notify, give_up: Callable[[], None]) -> None:
        """Start without a pipeline.

        Args:
            controls: State that viewers want to see.
            device: ``auto``, ``cpu`` or ``cuda:N``.
            notify: Receiver of messages for viewers.
            give_up: Function called when the wanted pipeline cannot be built, before the last good state is restored.

        Raises:
            UsageError: The device does not exist.
            SceneError: The scene does not fit the source.
        """
        self._controls, self._notify, self._give_up = controls, notify, give_up
        resolve_device(device)
        # A plan is made at once, so that an impossible request fails before anything is shown.
        target = make_target(controls.wanted, controls.feed)
        assert target.size is not None
        camera = target.scene.camera.scaled_to(*target.size)
        scene = dataclasses.replace(target.scene, camera=camera)
        ratios = plan_bracket(target.exposures, target.shown).ratios
        make_plan(Request(scene, target.quality, target.size, target.outputs, ratios))
        self.builder = ThreadPoolExecutor(1, "warp-ar-build")
        """Executor that builds pipelines and does other work in the background."""
        self._main = PipelineSwitcher(builder=self.builder, device=device, estimates="real_time")
        self._second = PipelineSwitcher(builder=self.builder, device=device, estimates="real_time")
        self._good = controls.wanted
        self._followed: tuple[Wanted, str, Feed] | None = None
        self._now = target
        self._first: Target | None = None
        self._then: Target | None = None
        self._place: Any = None
        self._settled = False
        self._bracket_notes: tuple[str, ...] = ()
        self._progress: tuple[str, int, int] | None = None
        self.plan: Plan | None = None
        """Plan of the pipeline that lights the frames."""

    @property
    def swaps(self) -> int:
        """Number of the plan, which grows with every change of pipeline."""
        return self._main.swaps

    @property
    def busy(self) -> bool:
        """True while a pipeline is being built."""
        return self.changing or self._second.busy

    @property
    def changing(self) -> bool:
        """True while a new pipeline for the frames is requested or being built."""
        followed = self._followed
        return not self._settled or followed is None or followed[0] is not self._controls.wanted

    @property
    def compare_ready(self) -> bool:
        """True if the pipeline of the picture to compare with is ready, or none is needed."""
        return self._controls.compare in ("", CAMERA) or self._second.pipeline is not None

    def doing(self) -> dict[str, Any] | None:
        """Return the quality being built and its count of loaded kernels, for the page; None while none is built."""
        if not self.busy:
            return None
        then = self._then  # read once, as the thread of the frames sets it
        target = then if then is not None and not self.changing else self._first or self._now
        name, done, count = self._progress or (target.quality.name, 0, 0)
        return {"quality": name, "done": done, "count": count}

    def _aim(self, wanted: Wanted, compare: str, feed: Feed) -> None:
        """Set the targets that are built from now on."""
        self._followed, self._settled = (wanted, compare, feed), False
        now = self._now = make_target(wanted, feed)
        self._then = dataclasses.replace(now, quality=PRESETS[compare]) if compare in PRESETS else None
        elsewhere = self._place != _place(now) and now.quality.name not in _AS_QUICK
        self._first = dataclasses.replace(now, quality=FIRST) if elsewhere else None

    def follow(self) -> Pipeline | None:
        """Return the pipeline for the next frame; None until one for the present scene and size is built.

        An edit whose pipeline cannot be built is undone, and viewers are notified.
        """
        controls = self._controls
        with controls.changed:
            wanted, compare, feed = controls.wanted, controls.compare, controls.feed
        followed = self._followed
        if followed is None or followed[0] is not wanted or followed[1] != compare or followed[2] is not feed:
            self._aim(wanted, compare, feed)
        before = self._main.swaps
        try:
            self._follow_main()
        except Exception as error:
            if self._first is not None and isinstance(error, WarpArError):
                self._first = None  # the wanted quality itself may still work
            else:
                self._first, self._settled = None, True
                self._notify(failure(error, "the state before stays"))
                self.take_back()
        if self._main.swaps != before:
            assert self._main.pipeline is not None
            self.plan = self._main.pipeline.plan
            self._tell_bracket(self._main.pipeline.bracket.notes)
            self._notify(self.plan_message())
        if self._then is None:
            if self._second.pipeline is not None or self._second.busy:
                self._second.close(wait=False)
        elif not self.changing:
            try:
                self._second.follow(self._then, prepare=self._warm_up)
            except Exception as error:
                self._notify(failure(error))
        return self._main.pipeline if self._place == _place(self._now) else None

    def _tell_bracket(self, notes: tuple[str, ...]) -> None:
        """Notify viewers, once, of exposures of the source that are not merged."""
        if notes != self._bracket_notes:
            self._bracket_notes = notes
            for note in notes:
                self._notify(notice(note))

    def note_lit(self) -> None:
        """Record the present state as good after a lit frame, to return to it if a later edit fails."""
        if self._settled and self._followed is not None:
            self._good = self._followed[0]

    def take_back(self) -> bool:
        """Restore the last good state after a failure of the present state.

        Returns:
            True if the state was restored; False if the failed state is the last good one.
        """
        if self._followed is None or self._followed[0] is self._good:
            return False
        self._give_up()
        self._controls.give_back(self._good, self._followed[0])
        return True

    def _follow_main(self) -> None:
        target = self._first or self._now
        self._main.follow(target, prepare=self._warm_up)
        if self._main.shows(target):
            self._place = _place(target)
            if self._first is not None:
                self._first = None
            else:
                self._settled = True

    def _warm_up(self, pipeline: Pipeline) -> None:
        """Load the kernels of a new pipeline and record the progress for viewers."""
        name = pipeline.quality.name

        def tell(done: int, count: int) -> None:
            self._progress = (name, done, count)

        tell(0, 0)
        try:
            pipeline.warm_up(tell)
        finally:
            self._progress = None

    def other(self, frame: Frame, now: float) -> Image | None:
        """Return the picture to compare with; None without a comparison, or until its pipeline is built."""
        if self._controls.compare == CAMERA:
            return frame.image
        pipeline = self._second.pipeline
        if pipeline is None or pipeline.size != (frame.image.shape[1], frame.image.shape[0]):
            return None
        with contextlib.suppress(WarpArError):
            pose = given_pose(pipeline.scene.pose, frame)
            return pipeline(frame.image, time_seconds=now, pose=pose, exposure_time=frame.exposure_time).image
        return None

    def plan_message(self) -> dict[str, Any]:
        """Return the message of the running stages, and of the omitted stages with the reason for each."""
        told = {"type": "plan", "plan": self.swaps, "quality": None, "run": [], "left_out": []}
        if self.plan is None:
            return told
        quality = self.plan.request.quality
        summaries = {kind.name: kind.summary for kind in STAGES} | {"track": "finds the marker and the camera's pose"}
        methods = {kind.name: list(kind.methods) for kind in STAGES if len(kind.methods) > 1}

        def record(name: str, **more: str) -> dict[str, Any]:
            return {"stage": name, "methods": methods.get(name, []), **more}

        run = [record(name, method=quality.method(name), summary=summaries[name]) for name in stage_names(self.plan)]
        out = [record(name, reason=reason) for name, reason in left_out(self.plan)]
        return {**told, "quality": quality.name, "run": run, "left_out": out}

    def close(self, wait_seconds: float | None = None) -> bool:
        """Close the pipelines.

        Args:
            wait_seconds: Longest wait for pipelines that are being built; None sets no limit.

        Returns:
            True if all building has ended.
        """
        self._main.close(wait=False)
        self._second.close(wait=False)
        done = threading.Event()
        self.builder.submit(done.set)  # runs after all tasks submitted before
        ended = done.wait(wait_seconds)
        self.builder.shutdown(wait=ended, cancel_futures=not ended)
        return ended


def _place(target: Target) -> Any:
    """Return a key of scene, marker and frame size. Pipelines of another key cannot show the present frames."""
    scene = target.scene
    return scene.name, scene.path, scene.marker, target.size


FULL_SCALE: Final = 0.2
"""Difference that gets the last colour of the scale, as a fraction of the largest code."""
SLICE_SECONDS: Final = 0.04
"""Length of one slice of sampling, between which viewers' requests are handled, seconds."""
SHOWN_SECONDS: Final = 0.3
"""Shortest time between two pictures of the reference, seconds."""
LIGHT_SAMPLES: Final = 8
"""Samples per pixel that estimate the reflectance of proxies; fewer than offline, to start sooner."""
LEAST_SAMPLES: Final = 16
"""Smallest number of samples per pixel at which the estimated error is used."""
GOAL: Final = 0.002
"""Relative standard error at which sampling ends."""
MOST_SAMPLES: Final = 4096
"""Number of samples per pixel at which sampling ends."""


def false_colors(image: Image, reference: Image) -> Image:
    """Return the largest difference of the channels in false colours: black at 0, light yellow from FULL_SCALE on."""
    off = np.abs(image.astype(np.int16) - reference.astype(np.int16)).max(axis=2)
    share = np.clip(off / (255.0 * FULL_SCALE), 0.0, 1.0)
    colors = cv2.applyColorMap(np.round(255.0 * share).astype(np.uint8), cv2.COLORMAP_INFERNO)
    return np.ascontiguousarray(colors[..., ::-1])


def _is_done(picture: TracedPicture) -> bool:
    """Return True if no more samples are added."""
    if picture.samples < LEAST_SAMPLES:
        return False
    return picture.samples >= MOST_SAMPLES or picture.relative_error <= GOAL


class Convergence:
    """Progressive path tracing of one held frame.

    Methods are called by the thread of the frames; ``status`` may be read by any thread.
    """

    def __init__(self) -> None:
        self._key: Any = None
        self._made: Future[PathTracer] | None = None
        self._picture: TracedPicture | None = None
        self._lit: Image | None = None
        self._shown = 0.0
        self.status: dict[str, float] | None = None
        """Samples, errors and difference, for viewers; None while there is no picture."""

    def begin(
        self,
        key: Any,
        pipeline: Pipeline,
        frame: Image,
        result: Result,
        seconds: float,
        builder: ThreadPoolExecutor,
    ) -> None:
        """Start to trace a frame that was just lit, unless it is being traced already.

        Args:
            key: Key of the picture; a new key starts a new reference.
            pipeline: Pipeline that lit the frame.
            frame: Picture of the camera.
            result: The pipeline's result for the frame.
            seconds: Time of the frame on the pipeline's clock, which sets the pose of animations.
            builder: Executor that compiles, uploads and takes the first sample in the background.
        """
        if key == self._key:
            return
        assert result.pose is not None
        self.drop()
        known = known_frame(pipeline, frame, result, seconds)
        self._key, self._lit = key, result.image

        def make() -> PathTracer:
            tracer = known.tracer(device=str(pipeline.device), light_samples=LIGHT_SAMPLES)
            # All kernels are compiled here, so that no slice waits for compilation. A dropped picture ends the loop.
            while self._key is key and not tracer.sample_for(SLICE_SECONDS):
                pass
            if tracer.samples > 0:
                tracer.picture()
            return tracer

        self._made = builder.submit(make)

    def drop(self) -> None:
        """Drop the reference, as the picture that it belongs to is no longer shown."""
        if self._made is not None:
            self._made.cancel()
        self._key = self._made = self._picture = self._lit = self.status = None

    def progress(self, key: Any) -> str:
        """Return "running" or "done" for the reference of ``key``; empty if there is none."""
        if key != self._key or (self._made is None and self._picture is None):
            return ""
        if self._picture is not None and _is_done(self._picture):
            return "done"
        return "running" if self._made is not None else ""

    def step(self) -> bool:
        """Add a slice of samples; return True if there is a new picture to show.

        Raises:
            Exception: The frame cannot be traced, for example without free device memory; it is not tried again.
        """
        made = self._made
        if made is None or not made.done():
            time.sleep(0.5 * SLICE_SECONDS)
            return False
        try:
            tracer = made.result()
            tracer.sample_for(SLICE_SECONDS)
        except Exception:
            self._made = None  # the picture goes on without a reference
            raise
        now = time.monotonic()
        if tracer.samples < 1 or now - self._shown < SHOWN_SECONDS:
            return False
        picture, lit = tracer.picture(), self._lit
        if lit is None:
            return False
        self._shown, self._picture, self.status = now, picture, self._told(picture, lit)
        return True

    def other(self, key: Any, compare: str) -> Image | None:
        """Return the reference, or the difference to it in false colours; None until the first samples are done."""
        picture, lit = self._picture, self._lit
        if key != self._key or picture is None or lit is None:
            return None
        return picture.image if compare == "traced" else false_colors(lit, picture.image)

    def _told(self, picture: TracedPicture, lit: Image) -> dict[str, float]:
        """Return the status for viewers: samples per pixel, and errors and differences in per cent."""
        off = float(cv2.norm(lit, picture.image, cv2.NORM_L1)) / lit.size
        return {
            "samples": picture.samples,
            "error": round(100.0 * picture.relative_error, 2),
            "goal": 100.0 * GOAL,
            "done": _is_done(picture),
            "difference": round(100.0 * off / 255.0, 3),
            "scale": 100.0 * FULL_SCALE,
        }
