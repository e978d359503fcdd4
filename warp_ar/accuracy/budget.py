"""``--quality auto``: the methods that err least within a time budget, and a change of them when the load changes.

**Costs.** Errors come from the cost table that is part of the package. Costs depend on the device and on the scene,
so they are measured here (``warp_ar.accuracy.costs``), on the first frame that shows the marker.

**Load.** A frame should take what its settings cost times a load, which is what frames took over what they should have
taken. What newly shown settings take too much is theirs; all else that differs is the load's.

**Choice.** The settings are the best of the Pareto front whose cost times the load is at most ``AIM`` budget. Settings
that were timed cost what they took; others what the costs say, times the ratio in which the timed settings that are
most like them departed from it.

**Steadiness.** Frames shall take ``LEAST`` to 1 budget. The median of the last frames counts, of as many of them as
take the same (``WINDOWS``), once it is off by ``SURE`` of its standard errors: a great change is sure within nine
frames, a small one within hundreds, and noise moves nothing. Frames that surely take more have the choice made anew,
and so have those that surely take less, where something errs less for it; between the two nothing changes. Settings
are held for ``HELD_SECONDS``. A setting moves by one method at a time, and all move until they are where they were to
go, or the budget is exceeded; of a mixed move that would not fit, what saves goes first.

**Switching.** Each set of methods has a pipeline of its own (``warp_ar.engine.switcher``). A new one lights a few
frames that nobody sees: that loads its kernels, and tells what it costs. If that fits, it lights the next frame; if
not, the choice is made anew.
"""

from __future__ import annotations

import collections
import dataclasses
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import warp as wp

from warp_ar.accuracy.cost_table import (
    Choice,
    chosen,
    load_errors,
    pareto_front,
    pareto_optimal,
    relevant_settings,
    turn,
)
from warp_ar.accuracy.costs import (
    BASE,
    Costs,
    cost_key,
    make_method_costs,
    measure_costs,
    read_costs,
    time_alone,
    write_costs,
)
from warp_ar.cache_folder import cache_folder
from warp_ar.closing import Closing
from warp_ar.engine.modules import Progress
from warp_ar.engine.pipeline import Pipeline, Result
from warp_ar.engine.switcher import PipelineSwitcher, Target
from warp_ar.errors import UsageError
from warp_ar.scene import Pose, Scene
from warp_ar.stages.quality import DEFAULT_BUDGET_MS, Quality
from warp_ar.stages.request import Estimates

AIM = 0.95
"""Share of the budget that is planned for."""
RAISE = 0.94
"""Share that what errs less must fit into before it is tried: what noise kept from being chosen is not chosen later."""
LEAST = 0.92
"""Share that frames take at least, where something errs less for it; two hundredths of it are noise."""
TRIAL = 0.98
"""Share that new settings may take by their trial."""
WINDOWS = (9, 27, 81, 243)
"""Frames whose medians tell what a frame takes."""
FIRST_WINDOW, RAISE_WINDOW = 27, 81
"""Frames at least before the first choice, and before what errs less is tried."""
SURE, SURE_AT_LAST = 5.0, 1.0
"""Standard errors of a median by which it must be off; of the longest window's, to be over the budget."""
HELD_SECONDS = 0.5
"""Shortest time for which settings are held."""
SETTLE = 2
"""Frames after a change that are not counted."""
SURPRISE = 1.2
"""Ratio of what new settings take to what they took alone, up to which the difference may be theirs."""
MEMORY = 60.0
"""Seconds for which what settings took when they were shown is held against them, twice as long each time that they
were left for it: a moment's load may have been in it. What they took alone is known for good."""
MOST_LEFT = 6
"""Times of which that is counted: an hour."""
_KEPT_PIPELINES = 6

T = TypeVar("T")


# ----------------------------------------------------------------------------------------------------------- the choice


@dataclasses.dataclass
class _Timed:
    """What settings took, without the load."""

    alone: float | None = None
    """Milliseconds, timed beside other frames."""
    shown: float | None = None
    """Milliseconds, when they were shown last."""
    until: float = 0.0
    """When that is forgotten, seconds."""
    left: int = 0
    """How often they were left for taking too much."""

    @property
    def milliseconds(self) -> float | None:
        """What is known best."""
        return self.alone if self.shown is None else self.shown


class Controller:
    """Decides, frame by frame, what to run. Knows nothing of pipelines: times go in, settings come out."""

    def __init__(
        self,
        costs: Costs,
        errors: Mapping[str, Mapping[str, float]],
        budget_ms: float,
        running: Mapping[str, str] | None = None,
    ) -> None:
        """Choose for an idle machine, or wait for frames that tell the load.

        Args:
            costs: Measured on this device.
            errors: By setting and method.
            budget_ms: Milliseconds per frame.
            running: Settings of the frames to come; the first choice is made from what they take. None chooses now.
        """
        self.budget_ms = budget_ms
        self._costs = costs
        method_costs = make_method_costs(costs, errors)
        self._errors = {(method_cost.setting, method_cost.method): method_cost.error for method_cost in method_costs}
        self._methods = {
            setting: [
                method_cost.method
                for method_cost in pareto_optimal(
                    [method_cost for method_cost in method_costs if method_cost.setting == setting]
                )
            ]
            for setting in costs.methods
        }
        self._front = pareto_front(method_costs, costs.scales)
        self._timed: dict[frozenset[tuple[str, str]], _Timed] = {}
        self._predicted: list[float] | None = None
        self._factor: float | None = None
        self._times: collections.deque[float] = collections.deque(maxlen=WINDOWS[-1])
        self._skip = SETTLE
        self._entry_factor: float | None = None
        self._held_since = -HELD_SECONDS
        self._chosen = running is None
        self.fits = True
        """False: frames take longer than the budget, and no settings are known to take less."""
        self.measured_ms: float | None = None
        """Median of the last frames, once there were enough of them."""
        self.settings: dict[str, str] = dict(self._best(AIM).settings if running is None else running)
        self._before = self._target = self.settings

    def set_budget(self, budget_ms: float) -> None:
        """Choose anew for another budget; what is known of the load stays."""
        self.budget_ms = budget_ms
        self._target = dict(self._best(AIM).settings)
        self._change(self._target)

    @property
    def choices(self) -> list[Choice]:
        """All that a budget may buy, cheapest first; milliseconds are relative to the base, as the costs have them."""
        return self._front

    @property
    def chosen(self) -> bool:
        """Whether the first choice has been made."""
        return self._chosen

    @property
    def factor(self) -> float:
        """Measured time over predicted time: the load."""
        return 1.0 if self._factor is None else self._factor

    def expected(self, settings: Mapping[str, str]) -> float:
        """Milliseconds per frame that settings should take under the present load."""
        return self.factor * self._cost(settings)

    @property
    def expected_ms(self) -> float:
        """Of the present settings."""
        return self.expected(self.settings)

    @property
    def expected_error(self) -> float:
        """FLIP above that of the best methods that the cost table expects of the present settings."""
        return sum(self._errors[pair] for pair in self.settings.items())

    def _cost(self, settings: Mapping[str, str]) -> float:
        """Milliseconds without the load."""
        timed = self._timed.get(frozenset(settings.items()))
        if timed is not None and timed.milliseconds is not None:
            return timed.milliseconds
        return (self._costs.base + self._costs.excess(settings)) * self._departure(settings)

    def _departure(self, settings: Mapping[str, str]) -> float:
        """What the timed settings that are most like these took, over what the costs say."""
        # By the milliseconds of what differs; the base itself differs by what it costs less or more, and departs not.
        nearest = sum(abs(self._costs.methods[setting][method]) for setting, method in settings.items())
        found = 1.0
        for key, timed in self._timed.items():
            if timed.milliseconds is None:
                continue
            methods = self._costs.methods
            distance = sum(
                abs(methods[setting][method] - methods[setting][settings[setting]]) for setting, method in key
            )
            if distance < nearest:
                nearest, found = distance, timed.milliseconds / (self._costs.base + self._costs.excess(dict(key)))
        return found

    def _best(self, share: float) -> Choice:
        """Least error within a share of the budget; the cheapest if none fits."""
        if self._predicted is None:
            self._predicted = [self._cost(dict(choice.settings)) for choice in self._front]
        limit = share * self.budget_ms / self.factor
        fitting = [choice for choice, cost in zip(self._front, self._predicted, strict=True) if cost <= limit]
        # The Pareto front's errors fall.
        return fitting[-1] if fitting else self._front[self._predicted.index(min(self._predicted))]

    def learn(self, settings: Mapping[str, str], milliseconds: float) -> None:
        """Note what settings take alone, without the load."""
        timed = self._timed.setdefault(frozenset(settings.items()), _Timed())
        timed.alone, timed.shown, self._predicted = milliseconds, None, None

    def confirm(self) -> bool:
        """Whether the present settings may be shown, now that they have been timed; if not, those before are back."""
        # The first choice may be any: it must be the best still. Later ones lead to it by way of what saves something.
        fits = self.expected_ms <= TRIAL * self.budget_ms
        saves = self.expected_ms < self.expected(self._before)
        if fits or (saves if self._chosen else dict(self._best(AIM).settings) == self.settings):
            self._chosen = True
            return True
        self.settings = self._target = self._before
        self._entry_factor = None
        self.restart()
        return False

    def shown(self, now: float) -> None:
        """Frames are lit by the present settings from now on."""
        if self.settings != self._before:
            self._held_since = now
        self._before = self.settings
        self._chosen = True
        self.restart()

    def observe(self, milliseconds: float, now: float) -> bool:
        """Note what a frame took.

        Args:
            milliseconds: Of the whole frame.
            now: Seconds on any clock that does not jump.

        Returns:
            Whether ``settings`` changed.
        """
        if self._skip > 0:
            self._skip -= 1
            return False
        self._times.append(milliseconds)
        verdict = self._judge()
        if verdict is None:
            return False
        self.measured_ms, over, under = verdict
        self._tell_apart(self.measured_ms, now, over)
        self.fits = not over
        if over or not self._chosen:
            self._target = dict(self._best(AIM).settings)
            self.fits = not over or self._saves(self._target)
        elif under and self._target == self.settings and (better := self._best(RAISE)).error < self.expected_error:
            self._target = dict(better.settings)
        if self._chosen and now - self._held_since < HELD_SECONDS:
            return False
        step = self._step() if self._chosen else self._target
        self._chosen = self._chosen or step == self.settings
        if step == self.settings:
            self._target = self.settings  # no way there fits
            return False
        self._held_since = now
        self._change(dict(step))
        return True

    def _judge(self) -> tuple[float, bool, bool] | None:
        """What a frame takes in milliseconds, whether surely too much, whether surely too little; None: not known."""
        times = np.array(self._times)
        counts = [count for count in WINDOWS if count <= len(times)]
        if not counts:
            return None
        # Of one frame, from its neighbours: 0.954 standard deviations lie between two of a normal distribution, in the
        # median; a median's own is 1.253 / sqrt(n) of it.
        scatter = float(np.median(np.abs(np.diff(times)))) / 0.954
        count, median, doubt = 0, 0.0, math.inf
        for longer in counts:
            # The longest window that agrees with all shorter ones: a load that has just changed is not averaged away.
            found = float(np.median(times[-longer:]))
            if count and abs(found - median) > doubt:
                break
            count, median, doubt = longer, found, SURE * 1.253 * scatter / math.sqrt(longer)
        over = median - (doubt if count < WINDOWS[-1] else doubt * SURE_AT_LAST / SURE) > self.budget_ms
        if count < FIRST_WINDOW:
            return (median, True, False) if over else None
        return median, over, count >= RAISE_WINDOW and median + doubt < LEAST * self.budget_ms

    def _tell_apart(self, measured: float, now: float, over: bool) -> None:
        """What frames took is what the settings cost times the load: find which of the two is not as it was thought."""
        for timed in self._timed.values():
            if timed.shown is not None and now > timed.until:
                timed.shown, self._predicted = None, None
        timed = self._timed.setdefault(frozenset(self.settings.items()), _Timed())
        before, cost = self._entry_factor, max(self._cost(self.settings), 1e-3)
        if (
            over
            and before is not None
            and (timed.alone is None or measured < SURPRISE * before * cost)
            and len(self._times) < WINDOWS[-1]
        ):
            timed.shown, timed.until = measured / before, now + MEMORY * 2.0**timed.left
            timed.left = min(timed.left + 1, MOST_LEFT)
            self._factor, self._predicted = before, None
        else:
            self._factor = max(measured, 1e-3) / cost

    def _change(self, settings: dict[str, str]) -> None:
        self._before, self.settings = self.settings, settings
        self._entry_factor = self._factor
        self.restart()

    def restart(self) -> None:
        """Forget the frames so far: what they took says nothing of those to come."""
        self._times.clear()
        self._skip = SETTLE

    def _saves(self, settings: Mapping[str, str]) -> bool:
        """Whether settings should take less than the present ones."""
        return self._cost(settings) < self._cost(self.settings)

    def _step(self) -> dict[str, str]:
        """At most one method of every setting toward the target."""
        moves: dict[str, str] = {}
        savings: dict[str, str] = {}
        for setting, method in self._target.items():
            methods = self._methods[setting]
            place, aim = methods.index(self.settings[setting]), methods.index(method)
            if place == aim:
                continue
            moves[setting] = methods[place + (1 if aim > place else -1)]
            if aim < place:
                savings[setting] = moves[setting]
        # Where neither fits, what saves most goes first: not all that should save is known to.
        steps = [{**self.settings, **some} for some in (moves, savings)]
        steps += [{**self.settings, setting: method} for setting, method in savings.items()]
        fitting = [step for step in steps[:2] if self.expected(step) <= TRIAL * self.budget_ms]
        best = fitting[0] if fitting else min(steps[1:], key=self._cost)
        return best if fitting or self._saves(best) else self.settings


# -------------------------------------------------------------------------------------------------------- the pipelines


class _OfTheLatest(Generic[T]):
    """What the pipeline that lights the next frame says of itself."""

    def __init__(self, get: Callable[[Pipeline], T]) -> None:
        self._get = get

    def __get__(self, auto: AutoPipeline, owner: type[AutoPipeline]) -> T:
        return self._get(auto.pipeline)


class AutoPipeline(Closing):
    """A pipeline that changes its quality to keep to a budget; it is called as ``Pipeline`` is."""

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
        bands: int | None = None,
        estimates: Estimates = "delayed",
        costs: Costs | None = None,
        folder: Path | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Start at the base quality; the first frame that shows the marker brings the choice.

        Args:
            scene: What to show.
            budget_ms: Milliseconds per frame, the marker's tracking included.
            device: ``auto``, ``cpu`` or ``cuda:N``.
            size: Width and height of the frames; None means the scene's.
            outputs: What results shall hold.
            exposures: As for ``Pipeline``.
            shown: As for ``Pipeline``.
            bands: Bands of rows per CPU pass; None means one per core.
            estimates: As for ``Pipeline``.
            costs: Known costs; None reads or measures them.
            folder: Where costs are kept; None means the user's cache folder.
            clock: Seconds.

        Raises:
            UsageError: An argument that cannot be used.
            SceneError: The scene's camera does not fit ``size``.
        """
        if not budget_ms > 0.0:
            raise UsageError(f"a budget of {budget_ms} ms is none; expected a number above 0")
        self.budget_ms = budget_ms
        self._given, self._folder, self._clock = scene, folder or cache_folder(), clock
        self._errors = load_errors()
        self.settings = relevant_settings(scene, size or (scene.camera.width, scene.camera.height))
        self._base = {setting.name: chosen(BASE, setting) for setting in self.settings}
        self._switcher = PipelineSwitcher(device=device, bands=bands, estimates=estimates, keep=_KEPT_PIPELINES - 1)
        self._target = Target(scene, turn(BASE, self._base), size, outputs, tuple(exposures), shown)
        self.pipeline = self._switcher.open(self._target)
        """The one that lights the next frame."""
        self._costs = costs
        self._controller: Controller | None = None
        self._changes: list[dict[str, Any]] = []
        self._rejected: list[dict[str, Any]] = []
        self._frames = 0
        self._told = False

    def warm_up(self, progress: Progress | None = None) -> None:
        """As ``Pipeline.warm_up``, for the settings of the first frame."""
        self.pipeline.warm_up(progress)

    def close(self) -> None:
        """Stop the threads; arrays go when the last result that refers to them does."""
        self._switcher.close()

    plan = _OfTheLatest(lambda pipeline: pipeline.plan)
    quality = _OfTheLatest(lambda pipeline: pipeline.quality)
    scene = _OfTheLatest(lambda pipeline: pipeline.scene)
    size = _OfTheLatest(lambda pipeline: pipeline.size)
    device = _OfTheLatest(lambda pipeline: pipeline.device)
    arrays = _OfTheLatest(lambda pipeline: pipeline.arrays)

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
            changed = self._controller.observe(_spent_ms(result), self._clock())
            if changed or (first and self._controller.chosen):
                self._want(image, found)
            self._tell()
        return result

    submit = __call__
    """Frames are not sent ahead: their times must be known before the next one."""

    def _start(self, image: Any, pose: Pose | None) -> Controller:
        """Get the costs; the first choice waits for frames that tell the load."""
        if self._costs is None and self.settings:
            key = cost_key(self.plan, self.device, self.settings)
            self._costs = read_costs(self._folder, key, self.settings)
            if self._costs is None:
                print("warp_ar: measuring what each method costs here; this is done once", file=sys.stderr)
                self._costs = measure_costs(
                    self._given, _on_host(image), pose, str(self.device), self.size, self.settings
                )
                write_costs(self._folder, key, self._costs)
        costs = self._costs or Costs(0.0, {})
        return Controller(costs, self._errors, self.budget_ms, self._base)

    def _wanted(self) -> Quality:
        return turn(BASE, self._base if self._controller is None else self._controller.settings)

    def _want(self, image: Any, pose: Pose | None) -> None:
        """Go over to the controller's settings, as soon as there is a pipeline for them."""
        frame = np.array(_on_host(image))
        self._target = dataclasses.replace(self._target, quality=self._wanted())
        if self._switcher.want(self._target, lambda pipeline: self._time_alone(pipeline, frame, pose)):
            self._changes.append(self._record())

    def _record(self) -> dict[str, Any]:
        """The controller's settings as those of the next frame."""
        assert self._controller is not None
        return {
            "frame": self._frames,
            "settings": dict(self._controller.settings),
            "expected_ms": round(self._controller.expected_ms, 3),
            "expected_error": round(self._controller.expected_error, 5),
        }

    def _time_alone(self, pipeline: Pipeline, image: Any, pose: Pose | None) -> float | None:
        """Make a new pipeline ready to light frames; what it takes alone, if that can be told."""
        costs = self._costs
        if costs is None or costs.work <= 0.0:
            pipeline.warm_up()
            return None
        settings = {setting.name: chosen(pipeline.quality, setting) for setting in self.settings}
        return time_alone(pipeline, image, pose, costs, settings)

    def _admit(self, pipeline: Pipeline, alone: float | None) -> bool:
        """Whether a pipeline may light frames, now that it is known what it takes."""
        controller = self._controller
        assert controller is not None
        if alone is not None:
            controller.learn(controller.settings, alone)
        record = self._record()
        admitted = controller.confirm()
        (self._changes if admitted else self._rejected).append(record)
        return admitted

    def _swap(self) -> None:
        """Go over to the wanted pipeline if it is ready."""
        if self._controller is None:
            return
        latest = self._switcher.take(self._admit)
        assert latest is not None
        if latest is not self.pipeline:
            self.pipeline = latest
            self._controller.shown(self._clock())

    def _tell(self) -> None:
        """Say once that the budget is too small."""
        controller = self._controller
        if controller is not None and not controller.fits and not self._told:
            self._told = True
            print(
                f"warp_ar: nothing keeps to {self.budget_ms:g} ms here: the cheapest methods take "
                f"{controller.measured_ms:.1f} ms and are used",
                file=sys.stderr,
            )

    def status(self) -> dict[str, Any]:
        """What was chosen, what it should cost and err, and every change, as plain data."""
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


def _spent_ms(result: Result) -> float:
    return sum(timing.milliseconds for timing in result.stages.values())


def _on_host(image: Any) -> Any:
    return image.numpy() if isinstance(image, wp.array) else image
