"""``--quality auto``: the methods of least error within a time budget, adapted to the load.

**Errors** of methods are those of the package's cost table.

**Costs** depend on device and scene, so they are measured on the first frame that shows the marker
(``warp_ar.accuracy.costs``).

**Choice.** ``warp_ar.accuracy.controller`` chooses a method for each setting from measured frame times.

**Switching.** Each set of methods has its own pipeline (``warp_ar.engine.switcher``). It lights frames once it is built
and its kernels are loaded.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import warp as wp

from warp_ar.accuracy.controller import Controller
from warp_ar.accuracy.cost_table import chosen, load_errors, relevant_settings, turn
from warp_ar.accuracy.costs import BASE, Costs, cost_key, measure_costs, read_costs, write_costs
from warp_ar.cache_folder import cache_folder
from warp_ar.closing import Closing
from warp_ar.engine.modules import Progress
from warp_ar.engine.pipeline import Pipeline, Result
from warp_ar.engine.switcher import PipelineSwitcher, Target
from warp_ar.errors import UsageError, WarpArError, say
from warp_ar.scene import Pose, Scene
from warp_ar.stages.quality import DEFAULT_BUDGET_MS, Quality
from warp_ar.stages.request import Estimates

_KEPT_PIPELINES = 6
"""Largest number of pipelines that are kept, the running one included."""


class AutoPipeline(Closing):
    """Pipeline that changes its quality to keep a time budget; it is called like ``Pipeline``."""

    def __init__(
        self,
        scene: Scene,
        *,
        budget_ms: float = DEFAULT_BUDGET_MS,
        device: str = "auto",
        size: tuple[int, int] | None = None,
        outputs: tuple[str, ...] = ("image",),
        exposures: Sequence[float] = (),
        shown: float | None = None,
        estimates: Estimates = "delayed",
        costs: Costs | None = None,
        folder: Path | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Start at the base quality; settings are chosen at the first frame that shows the marker.

        Args:
            scene: Scene to show.
            budget_ms: Milliseconds per frame, the marker's tracking included.
            device: ``auto``, ``cpu`` or ``cuda:N``.
            size: Width and height of the frames; None means the scene's.
            outputs: Names of the outputs of ``Pipeline``.
            exposures: Exposure times in seconds between which the frames alternate.
            shown: Exposure time in seconds of the frames that are shown; None means the longest.
            estimates: Frame in which light estimated from a frame takes effect: ``synchronous``, ``delayed`` or
                ``real_time``.
            costs: Known costs; None: they are read from the cache, or measured.
            folder: Folder in which costs are stored; None means the user's cache folder.
            clock: Clock in seconds.

        Raises:
            UsageError: An argument cannot be used.
            SceneError: The scene's camera does not fit ``size``.
        """
        if not budget_ms > 0.0:
            raise UsageError(f"budget {budget_ms} ms: expected a number above 0")
        self.budget_ms = budget_ms
        self._given, self._folder, self._clock = scene, folder or cache_folder(), clock
        self._errors = load_errors()
        self.settings = relevant_settings(scene, size or (scene.camera.width, scene.camera.height))
        self._base = {setting.name: chosen(BASE, setting) for setting in self.settings}
        self._switcher = PipelineSwitcher(device=device, estimates=estimates, keep=_KEPT_PIPELINES - 1)
        self._target = Target(scene, turn(BASE, self._base), size, outputs, tuple(exposures), shown)
        self.pipeline = self._switcher.open(self._target)
        """Pipeline that lights the next frame."""
        self._costs = costs
        self._controller: Controller | None = None
        self._changes: list[dict[str, Any]] = []
        self._rejected: list[dict[str, Any]] = []
        self._frames = 0
        self._told = False

    def warm_up(self, progress: Progress | None = None) -> None:
        """Load the kernels of the base quality, with which the first frame is lit.

        Args:
            progress: Function to which the numbers of compiled modules, first 0, and of all modules to compile are
                passed.
        """
        self.pipeline.warm_up(progress)

    def close(self) -> None:
        """Stop the threads. Arrays are freed once no result refers to them."""
        self._switcher.close()

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the pipeline that lights the next frame: its plan, quality, arrays or device."""
        if name == "pipeline":  # the constructor has not built it yet
            raise AttributeError(name)
        return getattr(self.pipeline, name)

    def __call__(
        self,
        image: Any,
        *,
        time_seconds: float | None = None,
        pose: Pose | None = None,
        exposure_time: float | None = None,
    ) -> Result:
        """Light one frame; arguments, result and errors are those of ``Pipeline``."""
        self._swap()
        result = self.pipeline(image, time_seconds=time_seconds, pose=pose, exposure_time=exposure_time)
        found = pose if pose is not None else result.pose
        self._frames += 1
        if not result.shown or (self.plan.needs("pose") and found is None):
            return result
        if self._controller is None:
            self._controller = self._start(image, found)
        elif not self._switcher.busy and self._wanted() == self.quality:
            first = not self._changes
            spent = sum(timing.milliseconds for timing in result.stages.values())
            changed = self._controller.observe(spent, self._clock())
            if changed or (first and self._controller.chosen):
                self._want()
            self._tell()
        return result

    submit = __call__
    """Light one frame and wait for it, because its time must be known before the next frame."""

    def _start(self, image: Any, pose: Pose | None) -> Controller:
        """Read or measure the costs, and return a controller that keeps the base settings until the load is known."""
        if self._costs is None and self.settings:
            key = cost_key(self.plan, self.device, self.settings)
            self._costs = read_costs(self._folder, key, self.settings)
            if self._costs is None:
                say("measuring the cost of each method on this machine; this is done once")
                shown = image.numpy() if isinstance(image, wp.array) else image
                self._costs = measure_costs(self._given, shown, pose, str(self.device), self.size, self.settings)
                write_costs(self._folder, key, self._costs)
        costs = self._costs or Costs(0.0, {})
        return Controller(costs, self._errors, self.budget_ms, self._base)

    def _wanted(self) -> Quality:
        return turn(BASE, self._base if self._controller is None else self._controller.settings)

    def _want(self) -> None:
        """Request a pipeline for the controller's settings."""
        self._target = dataclasses.replace(self._target, quality=self._wanted())
        if self._switcher.want(self._target, Pipeline.warm_up):
            self._changes.append(self._record())

    def _record(self) -> dict[str, Any]:
        """Return a record of the controller's settings, with the number of frames so far."""
        assert self._controller is not None
        return {
            "frame": self._frames,
            "settings": dict(self._controller.settings),
            "expected_ms": round(self._controller.expected_ms, 3),
            "expected_error": round(self._controller.expected_error, 5),
        }

    def _swap(self) -> None:
        """Switch to the requested pipeline if it is ready; if it cannot be built, say so and choose other methods."""
        controller = self._controller
        if controller is None:
            return
        try:
            latest = self._switcher.take(self._admit)
        except WarpArError as error:
            say(f"{error}; others are used")
            self._rejected.append(self._record())
            controller.reject()
            self._want()
            return
        assert latest is not None
        if latest is not self.pipeline:
            self.pipeline = latest
            controller.shown(self._clock())

    def _admit(self, _pipeline: Pipeline, _timing: Any) -> bool:
        """Record and accept a newly built pipeline for the next frame."""
        self._changes.append(self._record())
        return True

    def _tell(self) -> None:
        """Print once that the budget is too small."""
        controller = self._controller
        if controller is not None and not controller.fits and not self._told:
            self._told = True
            least = f"the cheapest methods, which are used, take {controller.measured_ms:.3g} ms"
            say(f"{self.budget_ms:g} ms cannot be kept: {least}")

    def status(self) -> dict[str, Any]:
        """Return the chosen methods, their expected cost and error, and every change so far, as data for JSON."""
        controller = self._controller
        if controller is None:
            return {"budget_ms": self.budget_ms, "changes": []}
        return {
            "budget_ms": self.budget_ms,
            "fits": controller.fits,
            "settings": dict(controller.settings),
            "expected_ms": round(controller.expected_ms, 3),
            "measured_ms": None if controller.measured_ms is None else round(controller.measured_ms, 3),
            "expected_error": round(controller.expected_error, 5),
            "load": round(controller.factor, 4),
            "changes": self._changes,
            "rejected": self._rejected,
        }
