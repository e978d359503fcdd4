"""The page's pipelines: one lights the frames, one more what they are compared with; both follow what is wanted."""

from __future__ import annotations

import contextlib
import dataclasses
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

from warp_ar.device import resolve_device
from warp_ar.engine.graph import Plan, make_plan
from warp_ar.engine.pipeline import Pipeline
from warp_ar.engine.switcher import PipelineSwitcher, Target
from warp_ar.errors import WarpArError
from warp_ar.output.report import left_out, stage_names
from warp_ar.sources.exposures import plan_bracket
from warp_ar.sources.sources import Frame
from warp_ar.stages import STAGES
from warp_ar.stages.quality import PRESETS
from warp_ar.stages.request import Request
from warp_ar.viewer.camera import Image
from warp_ar.viewer.controls import CAMERA, Controls, Feed
from warp_ar.viewer.edits import Wanted
from warp_ar.viewer.messages import Notify, failure, notice

FIRST: Final = dataclasses.replace(
    PRESETS["low"].with_methods(recover="white_card", environment_shadow="none"), name="the first picture"
)
"""What lights a scene until the wanted plan is built: ``low`` without what takes long to compile."""
_AS_QUICK: Final = ("low", "paper")
"""Presets that are not worth waiting for in two steps."""


def make_target(wanted: Wanted, feed: Feed) -> Target:
    """What a pipeline is built for."""
    camera = wanted.camera_of(feed.source.size) or feed.camera or wanted.scene.camera
    scene = dataclasses.replace(wanted.shown_scene(), camera=camera)
    # The page draws handles where parts are: that takes the pose, even where no stage does.
    outputs = ("image", "pose") if wanted.scene.objects or wanted.scene.lights else ("image",)
    return Target(scene, wanted.shown_quality(), feed.source.size, outputs, feed.source.exposures)


class Lighting:
    """Follows what is wanted. The thread of the frames calls it; properties may be read by any."""

    def __init__(self, controls: Controls, device: str, notify: Notify, give_up: Callable[[], None]) -> None:
        """Start without a pipeline.

        Args:
            controls: What is wanted.
            device: ``auto``, ``cpu`` or ``cuda:N``.
            notify: Takes what viewers should know.
            give_up: Called when what is wanted cannot be built, before what was good is wanted again.

        Raises:
            UsageError: There is no such device.
            SceneError: The scene does not fit the source.
        """
        self._controls, self._notify, self._give_up = controls, notify, give_up
        self.device = str(resolve_device(device))
        # What no plan can be made for is refused before anything is shown.
        target = make_target(controls.wanted, controls.feed)
        assert target.size is not None
        camera = target.scene.camera.scaled_to(*target.size)
        scene = dataclasses.replace(target.scene, camera=camera)
        ratios = plan_bracket(target.exposures, target.shown).ratios
        make_plan(Request(scene, target.quality, target.size, target.outputs, ratios))
        self.builder = ThreadPoolExecutor(1, "warp-ar-build")
        """Builds pipelines and does other work beside the frames."""
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
        """What lights the frames."""

    @property
    def swaps(self) -> int:
        """Number of the plan: grows whenever stages or quality change."""
        return self._main.swaps

    @property
    def busy(self) -> bool:
        """Whether a pipeline is being built."""
        return self.changing or self._second.busy

    @property
    def changing(self) -> bool:
        """Whether the frames are about to be lit by another pipeline."""
        followed = self._followed
        return not self._settled or followed is None or followed[0] is not self._controls.wanted

    @property
    def compare_ready(self) -> bool:
        """Whether what the picture is compared with is there."""
        return self._controls.compare in ("", CAMERA) or self._second.pipeline is not None

    def doing(self) -> dict[str, Any] | None:
        """What is being built, for a line on the page; None while nothing is."""
        if not self.busy:
            return None
        then = self._then  # once: the thread of the frames sets it
        target = then if then is not None and not self.changing else self._first or self._now
        name, done, count = self._progress or (target.quality.name, 0, 0)
        return {"quality": name, "done": done, "count": count}

    def _aim(self, wanted: Wanted, compare: str, feed: Feed) -> None:
        """Note what is to be built from now on."""
        self._followed, self._settled = (wanted, compare, feed), False
        now = self._now = make_target(wanted, feed)
        self._then = dataclasses.replace(now, quality=PRESETS[compare]) if compare in PRESETS else None
        elsewhere = self._place != _place(now) and now.quality.name not in _AS_QUICK
        self._first = dataclasses.replace(now, quality=FIRST) if elsewhere else None

    def follow(self) -> Pipeline | None:
        """The pipeline for the next frame; None where none is built that shows this scene.

        What cannot be built is undone and told.
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
                self._first = None  # what is wanted itself may do
            else:
                self._first, self._settled = None, True
                self._notify(failure(error, "what was shown before stays"))
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
        """Say what of the source's exposures is not merged, once."""
        if notes != self._bracket_notes:
            self._bracket_notes = notes
            for note in notes:
                self._notify(notice(note))

    def note_lit(self) -> None:
        """Note that a frame was lit: what it shows is good, and is gone back to where a later edit fails."""
        if self._settled and self._followed is not None:
            self._good = self._followed[0]

    def take_back(self) -> bool:
        """Want again what was good, after a failure of what is followed now.

        Returns:
            True if something else was wanted; False if what was good has failed itself.
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
        """Load the kernels of a new pipeline; viewers are told how far that is."""
        name = pipeline.quality.name

        def tell(done: int, count: int) -> None:
            self._progress = (name, done, count)

        tell(0, 0)
        try:
            pipeline.warm_up(tell)
        finally:
            self._progress = None

    def other(self, frame: Frame, now: float) -> Image | None:
        """What the picture is compared with; None without a comparison, or until it is built."""
        if self._controls.compare == CAMERA:
            return frame.image
        pipeline = self._second.pipeline
        if pipeline is None or pipeline.size != (frame.image.shape[1], frame.image.shape[0]):
            return None
        with contextlib.suppress(WarpArError):
            return pipeline(frame.image, time_seconds=now, exposure_time=frame.exposure_time).image
        return None

    def plan_message(self) -> dict[str, Any]:
        """Return the message of the stages that run, and of those left out with the reason."""
        told = {"type": "plan", "plan": self.swaps, "device": self.device, "quality": None, "run": [], "left_out": []}
        if self.plan is None:
            return told
        quality = self.plan.request.quality
        summaries = {kind.name: kind.summary for kind in STAGES} | {"track": "finds the marker and the camera's pose"}
        methods = {kind.name: list(kind.methods) for kind in STAGES if len(kind.methods) > 1}
        run = [
            {
                "stage": name,
                "method": quality.method(name),
                "methods": methods.get(name, []),
                "summary": summaries[name],
            }
            for name in stage_names(self.plan)
        ]
        out = [
            {"stage": name, "reason": reason, "methods": methods.get(name, [])} for name, reason in left_out(self.plan)
        ]
        return {**told, "quality": quality.name, "run": run, "left_out": out}

    def close(self, wait_seconds: float | None = None) -> bool:
        """Let the pipelines go; what is being built is waited for, at most so many seconds. Whether it has ended."""
        self._main.close(wait=False)
        self._second.close(wait=False)
        done = threading.Event()
        self.builder.submit(done.set)  # after all that was submitted before
        ended = done.wait(wait_seconds)
        self.builder.shutdown(wait=ended, cancel_futures=not ended)
        return ended


def _place(target: Target) -> Any:
    """What a picture is of, whatever its quality: a pipeline of another place would show nonsense."""
    scene = target.scene
    return scene.name, scene.path, scene.marker, target.size
