"""The cost of every method on this device: measured on one frame, and kept in the user's cache folder.

Costs depend on the device and on the scene. They are measured one setting at a time from a base, and hold together by
what settings share: a method's milliseconds more than the base's are multiplied where another setting gives its stage
more to do, by as much as that setting multiplies the stage's time at the base.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.metadata
import json
import math
import os
import statistics
import sys
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import warp as wp

from warp_ar.accuracy.cost_table import BETWEEN, MethodCost, Scales, Setting, chosen, light_only, turn
from warp_ar.engine.graph import Plan
from warp_ar.engine.pipeline import DEFAULT_FRAME_INTERVAL, TRACK, Pipeline, Result
from warp_ar.engine.switcher import let_go
from warp_ar.files import write_whole
from warp_ar.scene import Pose, Scene
from warp_ar.stages.quality import PRESETS, Quality
from warp_ar.stages.recover import EVERY_FRAME
from warp_ar.tracking.tracking import Tracker

BASE = PRESETS["medium"]
"""Preset that costs are measured from, and that runs until something is chosen."""
MEASURED_FRAMES = 6
"""Frames that tell what a method costs."""
_WARM_UP = 1
NOW_AND_THEN = "recover"
"""Stage that works some times a second on a thread of its own: what it takes is shown by all that the process works."""
_SPREAD_FRAMES = 12
"""Frames over which that is taken: two of its turns."""
_ENOUGH_MS = 200.0
"""Expensive methods use fewer frames: their relative noise is small."""
WORK = time.thread_time
"""Clock that counts what a thread works: other programs that are busy at the same time then hardly matter."""
_CACHE_FILE = "costs.json"


@dataclasses.dataclass(frozen=True)
class Costs:
    """The times of a device for a scene."""

    base: float
    """Milliseconds per frame of the preset that methods were measured from, tracking included."""
    methods: Mapping[str, Mapping[str, float]]
    """By setting and method: milliseconds per frame more than the base takes."""
    scales: Scales = dataclasses.field(default_factory=dict)
    """Factors by which settings that stages share multiply the excess costs of methods of those stages."""
    track: float = 0.0
    """Milliseconds of ``base`` that tracking takes."""

    def excess(self, settings: Mapping[str, str]) -> float:
        """Milliseconds per frame that settings should take more than the base."""
        shared = [
            self.scales[setting].get(method, {}) for setting, method in settings.items() if setting in self.scales
        ]
        return sum(
            self.methods[setting][method] * math.prod(scale.get(setting, 1.0) for scale in shared)
            for setting, method in settings.items()
        )


def make_method_costs(costs: Costs, errors: Mapping[str, Mapping[str, float]]) -> list[MethodCost]:
    """Costs measured on a device beside errors by setting and method."""
    return [
        MethodCost(setting, method, milliseconds, errors[setting][method])
        for setting, own in costs.methods.items()
        for method, milliseconds in own.items()
    ]


def measure_costs(
    scene: Scene,
    image: Any,
    pose: Pose | None,
    device: str,
    size: tuple[int, int],
    settings: Sequence[Setting],
    clock: Callable[[], float] | None = None,
) -> Costs:
    """Time every method but brute force on one frame that is shown again and again.

    Args:
        scene: What is shown.
        image: uint8 RGB (height, width, 3).
        pose: Of the camera in that frame, if the scene needs it.
        device: ``cpu`` or ``cuda:N``.
        size: Width and height.
        settings: What may be turned.
        clock: Seconds, on CPU. None counts processor time, so that other programs matter little, and takes it by the
            ratio in which the base's stands to the time that passes.
    """
    return finish_steps(measure_steps(scene, image, pose, device, size, settings, clock))


def finish_steps(steps: Generator[float, None, Costs], advance: Callable[[float], None] = lambda share: None) -> Costs:
    """Take all steps of ``measure_steps``; ``advance`` is told the share of the work that each was."""
    done = 0.0
    while True:
        try:
            share = next(steps)
        except StopIteration as end:
            advance(1.0 - done)
            return cast(Costs, end.value)
        advance(share - done)
        done = share


def measure_steps(
    scene: Scene,
    image: Any,
    pose: Pose | None,
    device: str,
    size: tuple[int, int],
    settings: Sequence[Setting],
    clock: Callable[[], float] | None = None,
    *,
    frames: int = MEASURED_FRAMES,
) -> Generator[float, None, Costs]:
    """``measure_costs`` in small steps, for whoever has other objects to do; yields the share that is done."""
    count, done = sum(len(setting.measured) for setting in settings) + 2, 2
    timed = WORK if clock is None else clock
    passed = _time_stages(scene, image, pose, device, size, BASE, time.perf_counter)
    track = passed.pop(TRACK, 0.0)
    yield 1 / count
    base = _time_stages(scene, image, pose, device, size, BASE, timed, frames=frames)
    base.pop(TRACK, None)
    yield done / count
    work = sum(base.values())
    pace = sum(passed.values()) / work if clock is None and work > 0.0 else 1.0
    methods: dict[str, dict[str, float]] = {}
    scales: dict[str, dict[str, dict[str, float]]] = {}
    shares: dict[str, float] = {}
    for setting in settings:
        start = chosen(BASE, setting)
        times: dict[str, dict[str, float]] = {}
        spread = setting.name == NOW_AND_THEN
        for method in setting.measured:
            quality = turn(BASE, {setting.name: method})
            known = method == start and not spread
            if known:
                times[method] = base
            else:
                times[method] = _time_stages(scene, image, pose, device, size, quality, timed, spread, frames)
            times[method].pop(TRACK, None)
            done += 1
            yield done / count
        # Stages that run whatever the method is cost the same: what was measured of them is noise.
        common = set.intersection(*(set(own) for own in times.values())) - set(setting.stages)
        own = {method: sum(ms for name, ms in stages.items() if name not in common) for method, stages in times.items()}
        methods[setting.name] = {method: pace * (ms - own[start]) for method, ms in own.items()}
        # A method may bring another stage along; what is shared scales the setting's own stage.
        most = max(own, key=lambda method: abs(own[method] - own[start]))
        part = times[most].get(setting.name, 0.0) - times[start].get(setting.name, 0.0)
        shares[setting.name] = min(max(part / (own[most] - own[start]), 0.0), 1.0) if own[most] != own[start] else 1.0
        if others := _scale_others(setting, settings, times, base):
            scales[setting.name] = others
    for table in scales.values():
        for scale in table.values():
            scale.update({name: 1.0 + shares[name] * (ratio - 1.0) for name, ratio in scale.items()})
    return fill_between(Costs(track + pace * work, methods, scales, track))


def _scale_others(
    setting: Setting, settings: Sequence[Setting], times: dict[str, dict[str, float]], base: dict[str, float]
) -> dict[str, dict[str, float]]:
    """By how much each method of a setting scales the stages of other settings; empty where it has none of them."""
    # What recovery does on its own thread is the same for a map of any size.
    others = [
        other.name
        for other in settings
        if other.name in setting.stages and other.name not in (setting.name, NOW_AND_THEN)
    ]
    if not others:
        return {}
    return {
        method: {name: stages[name] / base[name] for name in others if base.get(name) and stages.get(name)}
        for method, stages in times.items()
    }


def fill_between(costs: Costs) -> Costs:
    """``costs`` with methods of which others tell what they cost; a measured one stays."""

    def filled(known: Mapping[str, Any], between: Mapping[str, tuple[str, str, float]], mix: Callable[..., Any]) -> Any:
        found = {
            method: mix(known[low], known[high], share)
            for method, (low, high, share) in between.items()
            if low in known and high in known
        }
        return {**found, **known}

    def mix_scales(low: Mapping[str, float], high: Mapping[str, float], share: float) -> dict[str, float]:
        return {name: _mix(low[name], high[name], share) for name in low if name in high}

    methods = {name: filled(own, BETWEEN.get(name, {}), _mix) for name, own in costs.methods.items()}
    scales = {name: filled(own, BETWEEN.get(name, {}), mix_scales) for name, own in costs.scales.items()}
    return dataclasses.replace(costs, methods=methods, scales=scales)


def _mix(low: float, high: float, share: float) -> float:
    return low + share * (high - low)


def _time_stages(
    scene: Scene,
    image: Any,
    pose: Pose | None,
    device: str,
    size: tuple[int, int],
    quality: Quality,
    clock: Callable[[], float],
    spread: bool = False,
    frames: int = MEASURED_FRAMES,
) -> dict[str, float]:
    """Milliseconds by stage, tracking among them where the clock is that of the time that passes."""
    times: dict[str, list[float]] = {}
    spent = 0.0
    warm_up, count = (EVERY_FRAME, _SPREAD_FRAMES) if spread else (_WARM_UP, frames)
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
    """Light one picture as the ``index``-th frame, a little darker every other time, with every stage at work."""
    pipeline.scheduler.forget()
    shown = image - image // 8 if index % 2 else image
    return pipeline(shown, time_seconds=index * DEFAULT_FRAME_INTERVAL, pose=pose)


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


def cost_key(plan: Plan, device: Any, settings: Sequence[Setting]) -> str:
    """Return a digest of all that costs depend on: device, versions, stages, scene, the frames' size, the methods."""
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
        [(setting.name, setting.methods) for setting in settings],
    ]
    return hashlib.sha256(json.dumps(parts, default=str).encode()).hexdigest()[:24]


def package_version() -> str:
    """Of this package; a checkout that is not installed has none."""
    try:
        return importlib.metadata.version("warp-ar")
    except importlib.metadata.PackageNotFoundError:
        return "checkout"


def read_costs(folder: Path, key: str, settings: Sequence[Setting]) -> Costs | None:
    """Kept costs, or None where there are none that can be used."""
    try:
        kept = json.loads((folder / _CACHE_FILE).read_text(encoding="utf-8"))[key]
        methods = {
            setting.name: {str(method): float(ms) for method, ms in kept["methods"][setting.name].items()}
            for setting in settings
        }
        known = all(
            set(methods[setting.name]) <= set(setting.methods) and methods[setting.name] for setting in settings
        )
        scales = {
            str(setting): {
                str(method): {str(name): float(x) for name, x in own.items()} for method, own in table.items()
            }
            for setting, table in kept["scales"].items()
        }
        return Costs(float(kept["base"]), methods, scales, float(kept["track"])) if known else None
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
    everything[key] = dataclasses.asdict(costs)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(path, json.dumps(everything, indent=1).encode())
    except OSError as error:
        print(f"warp_ar: cannot keep measured costs in {folder}: {error.strerror}", file=sys.stderr)
