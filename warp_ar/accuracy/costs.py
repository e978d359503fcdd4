"""Costs of all methods on this device, measured on one frame and stored in the user's cache folder.

Costs depend on the device and on the scene. In the measurement, one setting at a time differs from a base preset.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import statistics
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import warp as wp

from warp_ar.accuracy.cost_table import MethodCost, Setting, chosen, light_only, turn
from warp_ar.device import usable_cores
from warp_ar.engine.graph import Plan
from warp_ar.engine.pipeline import DEFAULT_FRAME_INTERVAL, TRACK, Pipeline, Result
from warp_ar.engine.switcher import let_go
from warp_ar.errors import say
from warp_ar.files import write_whole
from warp_ar.scene import Pose, Scene
from warp_ar.signature import installed_version
from warp_ar.stages.quality import PRESETS, Quality
from warp_ar.stages.recover import EVERY_FRAME
from warp_ar.tracking.tracking import Tracker

BASE = PRESETS["medium"]
"""Preset relative to which costs are measured, and which runs until settings are chosen."""
MEASURED_FRAMES = 6
"""Largest number of frames over which a method is timed."""
_WARM_UP = 1
"""Number of frames before a measurement."""
NOW_AND_THEN = "recover"
"""Name of the stage that runs only a few times per second, on a separate thread. Its cost is measured by the processor
time of the whole process."""
_SPREAD_FRAMES = 12
"""Number of frames over which the stage ``NOW_AND_THEN`` is measured; it runs twice in them."""
_ENOUGH_MS = 200.0
"""Total milliseconds after which a measurement ends. Expensive methods are timed over fewer frames, because their
relative noise is small."""
WORK = time.thread_time
"""Clock of a thread's processor time, on which other programs have little effect."""
_CACHE_FILE = "costs.json"
"""Name of the file with the costs of all devices and scenes."""


@dataclasses.dataclass(frozen=True)
class Costs:
    """Times of a scene's methods on a device."""

    base: float
    """Milliseconds per frame of the base preset, tracking included."""
    methods: Mapping[str, Mapping[str, float]]
    """Milliseconds per frame above the base, by setting and method."""
    track: float = 0.0
    """Milliseconds of ``base`` that tracking takes."""

    def excess(self, settings: Mapping[str, str]) -> float:
        """Return the expected milliseconds per frame of methods, by setting, in excess of the base."""
        return sum(self.methods[setting][method] for setting, method in settings.items())


def make_method_costs(costs: Costs, errors: Mapping[str, Mapping[str, float]]) -> list[MethodCost]:
    """Return the costs on a device together with the errors, one entry per method of each setting."""
    return [
        MethodCost(setting, method, milliseconds, errors[setting][method])
        for setting, own in costs.methods.items()
        for method, milliseconds in own.items()
    ]


def measure_costs(*arguments: Any, tell: Callable[[float], object] = lambda share: None, **options: Any) -> Costs:
    """Run all steps of ``measure_steps`` and return the costs.

    Args:
        arguments: Arguments of ``measure_steps``.
        tell: Function to which the completed share, 0 to 1, is passed after each step.
        options: Keyword arguments of ``measure_steps``.
    """
    steps = measure_steps(*arguments, **options)
    while True:
        try:
            tell(next(steps)[0])
        except StopIteration as end:
            return cast(Costs, end.value)


def measure_steps(
    scene: Scene,
    image: Any,
    pose: Pose | None,
    device: str,
    size: tuple[int, int],
    settings: Sequence[Setting],
    clock: Callable[[], float] | None = None,
    *,
    all_methods: bool = False,
) -> Generator[tuple[float, Costs | None], None, Costs]:
    """Time methods on one frame, which is lit repeatedly, in small steps.

    Args:
        scene: Scene that is shown.
        image: uint8 RGB (height, width, 3).
        pose: Camera pose of that frame, if the scene needs it.
        device: ``cpu`` or ``cuda:N``.
        size: Width and height.
        settings: Settings to vary.
        clock: Clock in seconds, on CPU. None: processor time is measured, on which other programs have little effect.
            It is scaled by the ratio of elapsed time to processor time of the base.
        all_methods: True to time brute force too.

    Yields:
        The completed share, 0 to 1, with the costs so far, None after the first step.

    Returns:
        All costs.
    """
    methods = {setting: setting.methods if all_methods else setting.measured for setting in settings}
    count, done = sum(map(len, methods.values())) + 2, 2
    timed = WORK if clock is None else clock
    passed = _time_stages(scene, image, pose, device, size, BASE, time.perf_counter)
    track = passed.pop(TRACK, 0.0)
    yield 1 / count, None
    base = _time_stages(scene, image, pose, device, size, BASE, timed)
    base.pop(TRACK, None)
    work = sum(base.values())
    pace = sum(passed.values()) / work if clock is None and work > 0.0 else 1.0
    costs = {setting.name: {chosen(BASE, setting): 0.0} for setting in methods}
    known = Costs(track + pace * work, costs, track)
    yield done / count, known
    for setting, names in methods.items():
        start, spread = chosen(BASE, setting), setting.name == NOW_AND_THEN
        times: dict[str, dict[str, float]] = {}
        for method in sorted(names, key=lambda name: name != start):
            times[method] = base
            if method != start or spread:
                quality = turn(BASE, {setting.name: method})
                times[method] = _time_stages(scene, image, pose, device, size, quality, timed, spread)
                times[method].pop(TRACK, None)
            done += 1
            # Other stages than the setting's cost equally with all of its methods; measured differences are noise.
            common = set.intersection(*map(set, times.values())) - set(setting.stages)
            own = {one: sum(ms for name, ms in stages.items() if name not in common) for one, stages in times.items()}
            costs[setting.name] = {one: pace * (own[one] - own[start]) for one in names if one in own}
            yield done / count, known
    return known


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
    """Return the milliseconds of each stage at a quality; with a clock of elapsed time also those of tracking.

    With ``spread``, only the cost of the stage ``NOW_AND_THEN`` is measured on CPU.
    """
    times: dict[str, list[float]] = {}
    spent = 0.0
    warm_up, count = (EVERY_FRAME, _SPREAD_FRAMES) if spread else (_WARM_UP, MEASURED_FRAMES)
    shown_at = light_only(quality) if spread else quality
    with open_profiled(scene, device, shown_at, size, clock) as pipeline:
        begun = 0.0
        if pose is not None and clock is time.perf_counter:
            tracker = Tracker(pipeline.scene.marker, pipeline.camera)
            for index in range(warm_up + count):
                start = clock()
                tracker.track(image, index * DEFAULT_FRAME_INTERVAL)
                times.setdefault(TRACK, []).extend([(clock() - start) * 1e3] if index >= warm_up else [])
        for index in range(warm_up + count):
            if index == warm_up:
                begun = time.process_time()
            result = show_again(pipeline, image, pose, index)
            if index < warm_up:
                continue
            for name, timing in result.stages.items():
                times.setdefault(name, []).append(timing.milliseconds)
            spent += sum(timing.milliseconds for timing in result.stages.values())
            if spent > _ENOUGH_MS and not spread:
                break
        worked = time.process_time() - begun
        on_cpu = pipeline.device.is_cpu
    let_go(pipeline)
    if spread and on_cpu:
        return {NOW_AND_THEN: worked_ms(worked / count, clock)}
    return {name: statistics.median(own) for name, own in times.items()}


def show_again(pipeline: Pipeline, image: Any, pose: Pose | None, index: int) -> Result:
    """Light a picture as frame ``index``; it is darkened in every second frame, so that no stage is skipped."""
    pipeline.scheduler.forget()
    shown = image - image // 8 if index % 2 else image
    return pipeline(shown, time_seconds=index * DEFAULT_FRAME_INTERVAL, pose=pose)


def open_profiled(
    scene: Scene, device: str, quality: Quality, size: tuple[int, int] | None, clock: Callable[[], float]
) -> Pipeline:
    """Return a pipeline whose stages are timed by a clock; for the clock ``WORK``, one thread runs all stages."""
    bands = 1 if clock is WORK else None
    pipeline = Pipeline(scene, device=device, quality=quality, size=size, bands=bands, profile=True)
    pipeline.scheduler.clock = clock
    return pipeline


def worked_ms(seconds: float, clock: Callable[[], float]) -> float:
    """Return processor time of the process in milliseconds; for other clocks than ``WORK`` divided by all cores."""
    return seconds * 1e3 / (1 if clock is WORK else usable_cores())


def cost_key(plan: Plan, device: Any, settings: Sequence[Setting]) -> str:
    """Return a digest of all that costs depend on: device, versions, stages, scene, frame size and methods."""
    scene = plan.request.scene
    parts = [
        device.name,
        usable_cores() if device.is_cpu else None,
        wp.__version__,
        installed_version("warp-ar"),
        plan.request.size,
        [stage.name for stage, _ in plan.stages],
        [(item.shape, str(item.file), type(item.material).__name__) for item in scene.objects],
        [(proxy.shape, str(proxy.file)) for proxy in scene.proxies],
        [light.kind for light in scene.lights],
        [(setting.name, setting.methods) for setting in settings],
    ]
    return hashlib.sha256(json.dumps(parts, default=str).encode()).hexdigest()[:24]


def read_costs(folder: Path, key: str, settings: Sequence[Setting]) -> Costs | None:
    """Return stored costs; None if there are none or they cannot be used.

    Args:
        folder: Folder of the file.
        key: Result of ``cost_key``.
        settings: Settings that the costs must contain.
    """
    try:
        kept = json.loads((folder / _CACHE_FILE).read_text(encoding="utf-8"))[key]
        methods = {
            setting.name: {str(method): float(ms) for method, ms in kept["methods"][setting.name].items()}
            for setting in settings
        }
        known = all(
            set(methods[setting.name]) <= set(setting.methods) and methods[setting.name] for setting in settings
        )
        return Costs(float(kept["base"]), methods, float(kept["track"])) if known else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None  # there is no file, or another program has written it: costs are measured again


def write_costs(folder: Path, key: str, costs: Costs) -> None:
    """Store costs with those of other devices and scenes; a failure is reported, and costs are measured again later."""
    path = folder / _CACHE_FILE
    try:
        everything = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        everything = {}
    if not isinstance(everything, dict):
        everything = {}
    everything[key] = dataclasses.asdict(costs)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(path, json.dumps(everything, indent=1).encode())
    except OSError as error:
        say(f"cannot store measured costs in {folder}: {error.strerror}")
