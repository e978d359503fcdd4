"""``--quality auto``: the rungs that err least within a time budget, and a change of them when the load changes.

**Prices.** Errors come from the price list that is part of the package. Costs depend on the device and on the scene,
so they are measured here, on the first frame that shows the marker, and kept in the user's cache folder until the
device, a version or the scene changes.

**Choice.** With base cost b, relative prices c and a load factor f (measured over predicted time), the settings are the
best of the frontier with f (b + sum c) <= ``AIM`` budget, to go up ``RAISE`` budget.

**Steadiness.** Nothing is decided before ``WINDOW`` frames ran as they are; their median counts. Over the budget, the
choice is made anew at once. Under it, only what errs less by ``GAIN`` is worth a change, and only after a patience that
doubles whenever a step up had to be taken back within ``REGRET`` seconds, and halves when one lasted. A knob moves at
most one rung in ``KNOB_SECONDS``; of a mixed move that would not fit, what saves goes first.

**Switching.** Each set of rungs has a pipeline of its own. It is built on a thread of its own, and loads its kernels
there, while frames go on; then it takes over the light, the clock and the track of the marker between two frames.
"""

from __future__ import annotations

import collections
import dataclasses
import hashlib
import importlib.metadata
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any, cast

import warp as wp

from warp_ar.errors import UsageError
from warp_ar.graph import Plan
from warp_ar.ladder import (
    Choice,
    Knob,
    Price,
    choose,
    frontier,
    light_only,
    load_errors,
    relevant_knobs,
    setting,
    turn,
    undominated,
)
from warp_ar.pipeline import DEFAULT_FRAME_INTERVAL, TRACK, Pipeline, Result
from warp_ar.quality import PRESETS, Quality
from warp_ar.scene import Scene
from warp_ar.stages.recover import EVERY_FRAME
from warp_ar.tracking import Pose

AUTO = "auto"
"""Name of the quality that this file is about."""
DEFAULT_BUDGET_MS = 33.0
"""Thirty frames per second."""

AIM = 0.9
"""Share of the budget that is planned for at first, and when there is too much to do."""
RAISE = 0.8
"""Share that what errs less must fit into before it is tried: apart from ``AIM``, so that noise moves nothing."""
WINDOW = 9
"""Frames whose median is what a frame costs."""
SETTLE = 2
"""Frames after a change that are not counted."""
GAIN = 0.03
"""Share of the predicted error that a change must save."""
PATIENCE = 2.0
"""Seconds within the budget before more is tried, at first."""
MOST_PATIENCE = 32.0
REGRET = 5.0
"""Seconds within which taking a step up back means that it was too early."""
KNOB_SECONDS = 0.5
"""Shortest time between two rungs of one knob."""

BASE = PRESETS["medium"]
"""What costs are measured from, and what runs until something is chosen."""
_MEASURED_FRAMES = 6
_WARM_UP = 1
NOW_AND_THEN = "recover"
"""Stage that works some times a second on a thread of its own: what it takes is shown by all that the process works."""
_SPREAD_FRAMES = 12
"""Frames over which that is taken: two of its turns."""
_ENOUGH_MS = 200.0
"""Of a rung: dear ones are measured on fewer frames, for their noise is small beside what they cost."""
WORK = time.thread_time
"""Clock that counts what a thread works: other programs that are busy at the same time then hardly matter."""
_KEPT_PIPELINES = 6
_CACHE_FILE = "costs.json"


@dataclasses.dataclass(frozen=True)
class Costs:
    """What a device takes for a scene."""

    base: float
    """Milliseconds per frame of the preset that rungs were measured from, tracking included."""
    rungs: Mapping[str, Mapping[str, float]]
    """By knob and rung: milliseconds per frame more than the base takes."""


def make_prices(costs: Costs, errors: Mapping[str, Mapping[str, float]]) -> list[Price]:
    """Costs measured on a device beside errors by knob and rung."""
    return [
        Price(knob, rung, milliseconds, errors[knob][rung])
        for knob, own in costs.rungs.items()
        for rung, milliseconds in own.items()
    ]


# ----------------------------------------------------------------------------------------------------------- the choice


class Controller:
    """Decides, frame by frame, what to run. Knows nothing of pipelines: times go in, settings come out."""

    def __init__(self, costs: Costs, errors: Mapping[str, Mapping[str, float]], budget_ms: float) -> None:
        """Choose for an idle machine.

        Args:
            costs: Measured on this device.
            errors: By knob and rung.
            budget_ms: Milliseconds per frame.
        """
        self.budget_ms = budget_ms
        self._base = costs.base
        prices = make_prices(costs, errors)
        self._prices = {(price.knob, price.rung): price for price in prices}
        self._ladders = {
            knob: [price.rung for price in undominated([price for price in prices if price.knob == knob])]
            for knob in costs.rungs
        }
        self._front = frontier(prices)
        self._factor = 1.0
        self._times: collections.deque[float] = collections.deque(maxlen=WINDOW)
        self._skip = SETTLE
        self._moved: dict[str, float] = {}
        self._patience = PATIENCE
        self._calm_since: float | None = None
        self._raised: float | None = None
        self.settings: dict[str, str] = dict(self._best(AIM).settings)

    def set_budget(self, budget_ms: float) -> None:
        """Choose anew for another budget; what is known of the load stays."""
        self.budget_ms = budget_ms
        self.settings = dict(self._best(AIM).settings)
        self._calm_since = self._raised = None
        self.restart()

    @property
    def choices(self) -> list[Choice]:
        """All that a budget may buy, cheapest first; milliseconds are relative to the base."""
        return self._front

    @property
    def factor(self) -> float:
        """Measured time over predicted time: the load."""
        return self._factor

    def _best(self, share: float) -> Choice:
        return choose(self._front, share * self.budget_ms / self._factor - self._base)

    def _sum(self, settings: Mapping[str, str], what: str) -> float:
        return float(sum(getattr(self._prices[pair], what) for pair in settings.items()))

    @property
    def expected_ms(self) -> float:
        """Milliseconds per frame that the present settings should take under the present load."""
        return self._factor * (self._base + self._sum(self.settings, "milliseconds"))

    @property
    def expected_error(self) -> float:
        """FLIP above that of the best rungs that the price list expects of the present settings."""
        return self._sum(self.settings, "error")

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
        if len(self._times) < WINDOW:
            return False
        measured = statistics.median(self._times)
        predicted = self._base + self._sum(self.settings, "milliseconds")
        self._factor = measured / max(predicted, 1e-3)
        over = measured > self.budget_ms
        if over:
            self._calm_since = None
        elif self._calm_since is None:
            self._calm_since = now
        if self._raised is not None and now - self._raised > REGRET:
            self._raised, self._patience = None, max(0.5 * self._patience, PATIENCE)
        target = self._best(AIM if over else RAISE)
        worth = target.error < (1.0 - GAIN) * self.expected_error
        calm = self._calm_since is not None and now - self._calm_since >= self._patience
        if not over and not (worth and calm):
            return False
        step = self._step(dict(target.settings), now)
        if step == self.settings:
            return False
        if over and self._raised is not None:
            self._raised, self._patience = None, min(2.0 * self._patience, MOST_PATIENCE)
        elif not over:
            self._raised = now
        for knob, rung in step.items():
            if rung != self.settings[knob]:
                self._moved[knob] = now
        self.settings = step
        self.restart()
        return True

    def restart(self) -> None:
        """Forget the frames so far: what they took says nothing of those to come."""
        self._times.clear()
        self._skip = SETTLE

    def _step(self, target: Mapping[str, str], now: float) -> dict[str, str]:
        """At most one rung of every knob toward the target."""
        step, savings = dict(self.settings), dict(self.settings)
        for knob, rung in target.items():
            ladder = self._ladders[knob]
            place, aim = ladder.index(self.settings[knob]), ladder.index(rung)
            if place == aim or now - self._moved.get(knob, -KNOB_SECONDS) < KNOB_SECONDS:
                continue
            step[knob] = ladder[place + (1 if aim > place else -1)]
            if aim < place:
                savings[knob] = step[knob]
        fits = self._factor * (self._base + self._sum(step, "milliseconds")) <= AIM * self.budget_ms
        return step if fits else savings


# ----------------------------------------------------------------------------------------------------------- the costs


def measure_costs(
    scene: Scene,
    image: Any,
    pose: Pose | None,
    device: str,
    size: tuple[int, int],
    knobs: Sequence[Knob],
    clock: Callable[[], float] = time.perf_counter,
) -> Costs:
    """Time every rung but brute force on one frame that is shown again and again.

    Args:
        scene: What is shown.
        image: uint8 RGB (height, width, 3).
        pose: Of the camera in that frame, if the scene needs it.
        device: ``cpu`` or ``cuda:N``.
        size: Width and height.
        knobs: What may be turned.
        clock: Seconds, on CPU.
    """
    steps = measure_steps(scene, image, pose, device, size, knobs, clock)
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return cast(Costs, end.value)


def measure_steps(
    scene: Scene,
    image: Any,
    pose: Pose | None,
    device: str,
    size: tuple[int, int],
    knobs: Sequence[Knob],
    clock: Callable[[], float] = time.perf_counter,
) -> Generator[float, None, Costs]:
    """``measure_costs`` in small steps, for whoever has other things to do; yields the share that is done."""
    count, done = sum(len(knob.rungs) for knob in knobs) + 1, 1
    base = _time_stages(scene, image, pose, device, size, BASE, clock)
    yield done / count
    rungs: dict[str, dict[str, float]] = {}
    for knob in knobs:
        start = setting(BASE, knob)
        times: dict[str, dict[str, float]] = {}
        spread = knob.name == NOW_AND_THEN
        for rung in knob.rungs:
            if rung != "brute_force":
                quality = turn(BASE, {knob.name: rung})
                known = rung == start and not spread
                times[rung] = base if known else _time_stages(scene, image, pose, device, size, quality, clock, spread)
            done += 1
            yield done / count
        # Stages that run whatever the rung is cost the same: what was measured of them is noise.
        common = set.intersection(*(set(own) for own in times.values())) - set(knob.stages)
        own = {rung: sum(ms for name, ms in stages.items() if name not in common) for rung, stages in times.items()}
        rungs[knob.name] = {rung: ms - own[start] for rung, ms in own.items()}
    return Costs(sum(base.values()), rungs)


def _time_stages(
    scene: Scene,
    image: Any,
    pose: Pose | None,
    device: str,
    size: tuple[int, int],
    quality: Quality,
    clock: Callable[[], float],
    spread: bool = False,
) -> dict[str, float]:
    times: dict[str, list[float]] = {}
    spent = 0.0
    warm_up, count = (EVERY_FRAME, _SPREAD_FRAMES) if spread else (_WARM_UP, _MEASURED_FRAMES)
    shown_at = light_only(quality) if spread else quality
    with open_profiled(scene, device, shown_at, size, clock) as pipeline:
        begun = 0.0
        for index in range(warm_up + count):
            # Brighter and darker by an eighth, else stages would be skipped.
            shown = image if index % 2 == 0 else image - image // 8
            if index == warm_up:
                begun = time.process_time()
            result = pipeline(shown, time_seconds=index * DEFAULT_FRAME_INTERVAL, pose=pose)
            if index < warm_up:
                continue
            for name, timing in result.stages.items():
                times.setdefault(name, []).extend([] if timing.skipped else [timing.milliseconds])
            spent += sum(timing.milliseconds for timing in result.stages.values())
            if spent > _ENOUGH_MS and not spread:
                break
        worked = time.process_time() - begun
        on_cpu = pipeline.device.is_cpu
    times.pop(TRACK, None)
    if spread and on_cpu:
        return {NOW_AND_THEN: worked_ms(worked / count, clock)}
    return {name: statistics.median(own or [0.0]) for name, own in times.items()}


def open_profiled(
    scene: Scene, device: str, quality: Quality, size: tuple[int, int] | None, clock: Callable[[], float]
) -> Pipeline:
    """A pipeline whose stages are timed by a clock; by ``WORK`` one thread does them, one after another."""
    bands = 1 if clock is WORK else None
    pipeline = Pipeline(scene, device=device, quality=quality, size=size, bands=bands, profile=True)
    pipeline.scheduler.clock = clock
    return pipeline


def worked_ms(seconds: float, clock: Callable[[], float]) -> float:
    """Milliseconds that the process's work takes: by ``WORK`` all of it, by the time its share on every core."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return seconds * 1e3 / (1 if clock is WORK else cores)


def cache_folder() -> Path:
    """Where this user's programs keep what they can make again."""
    if os.environ.get("XDG_CACHE_HOME"):
        return Path(os.environ["XDG_CACHE_HOME"]) / "warp_ar"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home())) / "warp_ar" / "cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "warp_ar"
    return Path.home() / ".cache" / "warp_ar"


def cost_key(plan: Plan, device: Any, knobs: Sequence[Knob]) -> str:
    """What costs depend on: device and cores, versions, what the scene calls for, the frames' size, the rungs."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    scene = plan.request.scene
    parts = [
        device.name,
        cores if device.is_cpu else None,
        wp.__version__,
        package_version(),
        plan.request.size,
        [stage.name for stage, _ in plan.stages],
        [(item.shape, str(item.file), type(item.material).__name__) for item in scene.objects],
        [(proxy.shape, str(proxy.file)) for proxy in scene.proxies],
        [light.kind for light in scene.lights],
        [(knob.name, knob.rungs) for knob in knobs],
    ]
    return hashlib.sha256(json.dumps(parts, default=str).encode()).hexdigest()[:24]


def package_version() -> str:
    """Of this package; a checkout that is not installed has none."""
    try:
        return importlib.metadata.version("warp-ar")
    except importlib.metadata.PackageNotFoundError:
        return "checkout"


def read_costs(folder: Path, key: str, knobs: Sequence[Knob]) -> Costs | None:
    """Kept costs, or None where there are none that can be used."""
    try:
        kept = json.loads((folder / _CACHE_FILE).read_text(encoding="utf-8"))[key]
        rungs = {knob.name: {str(rung): float(ms) for rung, ms in kept["rungs"][knob.name].items()} for knob in knobs}
        known = all(set(rungs[knob.name]) <= set(knob.rungs) and rungs[knob.name] for knob in knobs)
        return Costs(float(kept["base"]), rungs) if known else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None  # not there, or not ours: it is measured anew


def write_costs(folder: Path, key: str, costs: Costs) -> None:
    """Keep costs beside those of other devices and scenes; where nothing can be written, they are measured again."""
    path = folder / _CACHE_FILE
    try:
        everything = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        everything = {}
    if not isinstance(everything, dict):
        everything = {}
    everything[key] = {"base": costs.base, "rungs": costs.rungs}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        fresh = path.with_name(f"{path.name}.{os.getpid()}")
        fresh.write_text(json.dumps(everything, indent=1), encoding="utf-8")
        fresh.replace(path)
    except OSError as error:
        print(f"warp_ar: cannot keep measured costs in {folder}: {error.strerror}", file=sys.stderr)


# -------------------------------------------------------------------------------------------------------- the pipelines


class AutoPipeline:
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
        bands: int | None = None,
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
            bands: Bands of rows per CPU pass; None means one per core.
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
        self._arguments: dict[str, Any] = {
            "device": device,
            "size": size,
            "outputs": outputs,
            "exposures": tuple(exposures),
            "bands": bands,
        }
        self._given, self._folder, self._clock = scene, folder or cache_folder(), clock
        self._errors = load_errors()
        self._builder = ThreadPoolExecutor(1, "warp_ar-build")
        self._building: Future[Pipeline] | None = None
        self._kept: dict[Quality, Pipeline] = {}
        self._now = self._open(BASE)
        self._kept[BASE] = self._now
        self.knobs = relevant_knobs(self._now.scene, self._now.size)
        self._costs = costs
        self._controller: Controller | None = None
        self._changes: list[dict[str, Any]] = []
        self._frames = 0

    def _open(self, quality: Quality) -> Pipeline:
        # On CUDA only a pipeline that profiles knows what the device takes.
        return Pipeline(self._given, quality=quality, profile=True, **self._arguments)

    def __enter__(self) -> AutoPipeline:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop the threads; arrays go when the last result that refers to them does."""
        self._builder.shutdown(wait=True, cancel_futures=True)
        if self._building is not None and not self._building.cancelled() and self._building.exception() is None:
            self._building.result().close()
        for pipeline in self._kept.values():
            pipeline.close()

    @property
    def pipeline(self) -> Pipeline:
        """The one that lights the next frame."""
        return self._now

    @property
    def plan(self) -> Plan:
        """Of the present quality."""
        return self._now.plan

    @property
    def quality(self) -> Quality:
        """The present one."""
        return self._now.quality

    @property
    def scene(self) -> Scene:
        """What is shown, its camera scaled to the frames."""
        return self._now.scene

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frames."""
        return self._now.size

    @property
    def device(self) -> Any:
        """Where kernels run."""
        return self._now.device

    @property
    def arrays(self) -> Any:
        """Named arrays of the pipeline that lit the last frame."""
        return self._now.arrays

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
        result = self._now(image, time_seconds=time_seconds, pose=pose, exposure_time=exposure_time)
        found = pose if pose is not None else result.pose
        self._frames += 1
        if not result.shown:
            return result
        if self._now.plan.needs("pose") and found is None:
            return result
        if self._controller is None:
            self._start(image, found)
        elif self._building is None:
            spent = sum(timing.milliseconds for timing in result.stages.values())
            if self._controller.observe(spent, self._clock()):
                self._want()
        return result

    submit = __call__
    """Frames are not sent ahead: their times must be known before the next one."""

    def _start(self, image: Any, pose: Pose | None) -> None:
        """Get the costs and make the first choice."""
        if self._costs is None and self.knobs:
            device = self._now.device
            key = cost_key(self._now.plan, device, self.knobs)
            self._costs = read_costs(self._folder, key, self.knobs)
            if self._costs is None:
                print("warp_ar: measuring what each rung costs here; this is done once", file=sys.stderr)
                picture = image.numpy() if isinstance(image, wp.array) else image
                scene, size = self._given, self._now.size
                self._costs = measure_costs(scene, picture, pose, str(device), size, self.knobs)
                write_costs(self._folder, key, self._costs)
        self._controller = Controller(self._costs or Costs(0.0, {}), self._errors, self.budget_ms)
        self._want()

    def _wanted(self) -> Quality:
        assert self._controller is not None
        return turn(BASE, self._controller.settings)

    def _want(self) -> None:
        quality = self._wanted()
        assert self._controller is not None
        self._changes.append(
            {
                "frame": self._frames,
                "settings": dict(self._controller.settings),
                "expected_ms": round(self._controller.expected_ms, 3),
                "expected_error": round(self._controller.expected_error, 5),
            }
        )
        if quality not in self._kept:
            self._building = self._builder.submit(self._build, quality)

    def _build(self, quality: Quality) -> Pipeline:
        pipeline = self._open(quality)
        pipeline.warm_up()
        return pipeline

    def _swap(self) -> None:
        """Go over to the wanted pipeline if it is ready."""
        if self._controller is None:
            return
        if self._building is not None and self._building.done():
            building, self._building = self._building, None
            built = building.result()
            self._kept[built.quality] = built
            self._controller.restart()
        wanted = self._kept.get(self._wanted())
        if wanted is None or wanted is self._now:
            return
        wanted.continue_from(self._now)
        self._now = wanted
        # Latest last; the oldest goes.
        self._kept[wanted.quality] = self._kept.pop(wanted.quality)
        while len(self._kept) > _KEPT_PIPELINES:
            self._kept.pop(next(iter(self._kept))).close()

    def status(self) -> dict[str, Any]:
        """What was chosen, what it should cost and err, and every change, as plain data."""
        controller = self._controller
        if controller is None:
            return {"budget_ms": self.budget_ms, "changes": []}
        return {
            "budget_ms": self.budget_ms,
            "settings": dict(controller.settings),
            "expected_ms": round(controller.expected_ms, 3),
            "expected_error": round(controller.expected_error, 5),
            "changes": self._changes,
        }
