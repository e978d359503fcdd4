"""Time budget of the page: the methods with the smallest error within a time per frame on this device.

Errors come from the cost table, costs from measurements on this device, as for ``--quality auto``. Here one method is
measured at a time between other work, so that frames and edits continue.
"""

from __future__ import annotations

import collections
import dataclasses
import statistics
import time
from collections.abc import Generator
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from warp_ar.accuracy.controller import Controller
from warp_ar.accuracy.cost_table import Setting, chosen, load_errors, load_presets, relevant_settings, turn
from warp_ar.accuracy.costs import BASE, Costs, cost_key, measure_steps, read_costs, write_costs
from warp_ar.cache_folder import cache_folder
from warp_ar.engine.graph import make_plan
from warp_ar.engine.pipeline import TRACK, Pipeline
from warp_ar.scene import Pose
from warp_ar.stages.quality import AUTO, DEFAULT_BUDGET_MS, PRESETS, Quality
from warp_ar.viewer.protocol import Notify, begin, failure

START: Final = dataclasses.replace(BASE, name=AUTO)
"""Quality under a budget until the costs are known."""
_COST_FRAMES: Final = 30
"""Number of newest frames whose median time is a preset's cost."""
_TOLD: Final = 0.03
"""Fraction of the measurements after which the remaining time is estimated."""
_SETTLED: Final = 10
"""Number of first frames of a new pipeline that are ignored."""


class BudgetSetting:
    """Budget and resulting choice of methods. Methods are called by the frames' thread, unless stated otherwise."""

    def __init__(self, notify: Notify, folder: Path | None = None) -> None:
        """Start without a budget.

        Args:
            notify: Receiver of ``record``'s result after every change, called on any thread.
            folder: Folder of stored costs; None means the user's cache folder.
        """
        self._notify, self._folder = notify, folder or cache_folder()
        self._errors = load_errors()
        self.budget: float | None = None
        """Milliseconds per frame; None while switched off."""
        self.last_budget = DEFAULT_BUDGET_MS
        """Budget that was set last, or the default, milliseconds per frame."""
        self.stopped = False
        """True ends all measuring. Set from any thread."""
        self._controller: Controller | None = None
        self._key: str | None = None
        self._costs: Costs | None = None
        self._offer: dict[str, Any] = {}
        self._progress: float | None = None
        self._began = 0.0
        self._failed: str | None = None
        self._settings: tuple[Setting, ...] = ()
        self._preset_errors: dict[str, float] = {}
        self._table: dict[str, float] = {}
        self._preset_ms: dict[str, collections.deque[float]] = {}
        self._since_restart = 0

    @property
    def measuring(self) -> bool:
        """True while costs are being measured. The frames should then pause, as they would disturb the timing."""
        return self._progress is not None

    def switch(self, budget: float | None) -> None:
        """Set the budget, milliseconds per frame; None switches it off. From any thread."""
        self.last_budget = budget or self.last_budget
        self.budget = budget

    def look(self, pipeline: Pipeline, image: npt.NDArray[np.uint8], pose: Pose | None, helper: Executor) -> None:
        """Get the costs of methods for a pipeline's scene and size, from the cache or else by measuring.

        Measuring begins once a budget is set.

        Args:
            pipeline: Pipeline of the frames, with the edited scene.
            image: Frame that shows the marker and the mirror ball, as far as the scene uses them.
            pose: ``camera_from_world`` of that frame.
            helper: Executor of the measurements, one step per task.
        """
        if self.measuring or self.stopped:
            return
        scene, size = pipeline.scene, pipeline.size
        # An edit changes costs no more than load on the machine does. Only another scene or frame size needs new costs.
        key = f"{scene.name} {size}"
        if key != self._key:
            self._key = key
            self._preset_errors, self._table = load_presets(scene.name), load_presets(scene.name, "ms")
            self._settings = relevant_settings(scene, size)
            plan = make_plan(dataclasses.replace(pipeline.plan.request, quality=BASE))
            self._cache_key = cost_key(plan, pipeline.device, self._settings)
            self._adopt(read_costs(self._folder, self._cache_key, self._settings))
            self._notify(self.record())
        if self._costs is None and self.budget is not None and key != self._failed:
            self._progress, self._began = 0.0, time.monotonic()
            self._notify(self.record())
            steps = measure_steps(scene, image.copy(), pose, str(pipeline.device), size, self._settings)
            begin(helper, self._notify, self._step, helper, steps, key)

    def _step(self, helper: Executor, steps: Generator[tuple[float, Costs | None], None, Costs], key: str) -> None:
        progress = None
        try:
            if not self.stopped:
                progress, costs = next(steps)
                self._offer = self._list(Controller(costs, self._errors, self.last_budget), costs) if costs else {}
        except StopIteration as end:
            write_costs(self._folder, self._cache_key, end.value)
            self._adopt(end.value)
        except Exception as error:
            self._failed, self._offer = key, {}  # otherwise the next frame would start the same measurement again
            self._notify(failure(error, "the costs of methods stay unknown"))
        finally:
            self._progress = progress
        self._notify(self.record())
        if progress is not None and not self.stopped:
            begin(helper, self._notify, self._step, helper, steps, key)

    def _adopt(self, costs: Costs | None) -> None:
        self._costs = costs
        if costs is None:
            self._controller, self._offer = None, {}
            return
        controller = Controller(costs, self._errors, self.last_budget)
        self._controller, self._offer = controller, self._list(controller, costs)

    def choose(self, milliseconds: float | None, now: float) -> Quality | None:
        """Return the quality under the budget; None without a budget or while costs are unknown.

        Args:
            milliseconds: Time of the last frame; None if another choice of methods lit it.
            now: Time on a monotonic clock, seconds.
        """
        controller, budget = self._controller, self.budget
        if controller is None or budget is None:
            return None
        if controller.budget_ms != budget:
            controller.set_budget(budget)
        elif milliseconds is not None:
            controller.observe(milliseconds, now)
        return dataclasses.replace(turn(BASE, controller.settings), name=AUTO)

    def observe(self, preset: str, milliseconds: float | None, tracking: float) -> Quality | None:
        """Record the time of a frame and return the quality for the next frames, as ``choose`` does.

        Args:
            preset: Name of the quality that lit the frame.
            milliseconds: Time of the frame; None if that quality did not light all of it.
            tracking: Milliseconds of the frame in which the marker was tracked.
        """
        self._since_restart += 1
        if self.measuring:
            milliseconds = None
        if milliseconds is not None and self._since_restart > _SETTLED:
            self.note(preset, milliseconds)
            self.note(TRACK, tracking)
        return self.choose(milliseconds, time.monotonic())

    def note(self, name: str, milliseconds: float) -> None:
        """Record the time of a frame under a preset's name, or that of its tracking under ``TRACK``."""
        self._preset_ms.setdefault(name, collections.deque(maxlen=_COST_FRAMES)).append(milliseconds)

    def costs(self) -> dict[str, dict[str, Any]]:
        """Return each preset's milliseconds per frame and the number of measured frames.

        A preset that has run gets the median of its frames; the base otherwise gets its measured cost. Others get the
        cost table's value, scaled by the ratio of measured to tabulated times, and the time of tracking, which the
        table leaves out. A preset that has not run and is not in the table is left out. Callable from any thread.
        """
        offer = self._offer  # read once, as measuring sets it
        ran = {BASE.name: (offer["base"], 0)} if offer else {}
        ran |= {name: (statistics.median(ms), len(ms)) for name, ms in list(self._preset_ms.items()) if ms}
        tracking, _ = ran.pop(TRACK, (0.0, 0))
        known = {name: ms for name, ms in self._table.items() if name in ran}
        # Sums: the ratio of a cheap preset alone would tell more of the page's own work than of the stages'.
        ratio = sum(ran[name][0] - tracking for name in known) / sum(known.values()) if known else 1.0
        scaled = {name: (ms * ratio + tracking, 0) for name, ms in self._table.items()}
        return {name: {"ms": round(ms, 2), "frames": count} for name, (ms, count) in (scaled | ran).items()}

    def forget_costs(self, preset: str | None = None) -> None:
        """Forget the times of a preset; None forgets all, as for a new scene. From any thread."""
        for name in [preset] if preset is not None else list(self._preset_ms):
            self._preset_ms.pop(name, None)

    def restart(self) -> None:
        """Restart the frame count and the controller after a change of pipeline."""
        self._since_restart = 0
        if self._controller is not None:
            self._controller.restart()

    @property
    def load(self) -> float | None:
        """Ratio of measured to expected frame times; None while no methods are chosen. From any thread."""
        controller = self._controller
        return None if controller is None or self.budget is None else round(controller.factor, 4)

    def record(self) -> dict[str, Any]:
        """Return all choices of methods as a message for the page. From any thread."""
        told = {"measuring": self._progress, "remaining": self._remaining(), "known": self._controller is not None}
        errors = {name: round(error, 3) for name, error in self._preset_errors.items()}
        return {"type": "budget", **told, "errors": errors, **self._offer}

    def _whole_error(self, error: float) -> float:
        """Convert a sum of methods' errors to the error of a whole picture, which is no plain sum.

        Both are known for the presets. Other values are interpolated between the presets.
        """
        sums = {
            name: sum(self._errors[setting.name][chosen(PRESETS[name], setting)] for setting in self._settings)
            for name in self._preset_errors
        }
        known = sorted((total, self._preset_errors[name]) for name, total in sums.items())
        return round(float(np.interp(error, *np.transpose(known))), 3) if known else error

    def _remaining(self) -> float | None:
        """Estimate the seconds that the measurements still take; None during their first ``_TOLD``."""
        progress = self._progress
        if progress is None or progress < _TOLD:
            return None
        return round((time.monotonic() - self._began) * (1.0 - progress) / progress, 1)

    def _list(self, controller: Controller, costs: Costs) -> dict[str, Any]:
        names = [setting.name for setting in self._settings]
        methods = {setting.name: list(setting.methods) for setting in self._settings}
        return {
            "base": costs.base,
            "settings": methods,
            "choices": [
                {
                    "ms": round(choice.milliseconds, 3),
                    "error": self._whole_error(choice.error),
                    "methods": [methods[name].index(dict(choice.settings)[name]) for name in names],
                }
                for choice in controller.choices
            ],
        }
