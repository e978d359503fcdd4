"""What every method costs: the times of the cost table, on ``desk`` at its own size, all else on ``medium``.

``python -m bench costs --device cpu > bench/results/cpu_costs.jsonl``, then ``python -m bench.write_cost_tables`` puts
these lines and the errors of ``warp_ar/accuracy/cost_table.json`` into ``docs/accuracy.md``.

Rows: ``method SETTING METHOD``, the stages that a setting turns, at each of its methods; ``preset SCENE NAME``, whole
frames of the presets in turn. On CUDA a frame is the sum of its stages, each alone: stages that run side by side take
less.
"""

from __future__ import annotations

import os
import time
from typing import Any

import warp as wp

from bench.common import report
from warp_ar.accuracy.cases import Case, open_scene, sized_light
from warp_ar.accuracy.cost_table import Setting, chosen, light_only, relevant_settings, turn
from warp_ar.accuracy.costs import BASE, NOW_AND_THEN, WORK
from warp_ar.accuracy.runs import run, run_in_turn
from warp_ar.accuracy.sweep import count_work
from warp_ar.scene import bundled_scenes
from warp_ar.stages.quality import PRESETS

FRAMES = 12
TIMED = 6
RUNS = ("paper", "low", "medium", "high")


def main(device: str) -> None:
    # Other programs: who works on a busy machine says so, and counts processor time.
    by_work = os.environ.get("WARP_AR_CLOCK") == "processor"
    clock = WORK if by_work else time.perf_counter
    more = {"clock": "processor" if by_work else "wall", "load": round(os.getloadavg()[0], 1)}
    part = os.environ.get("WARP_AR_BENCH")
    if part != "presets":
        method_costs(device, clock, more)
    for scene in () if part == "methods" else bundled_scenes():
        case = open_scene(scene, FRAMES)
        times, _ = run_in_turn(case, {name: PRESETS[name] for name in RUNS}, device, clock)
        for name in RUNS:
            report(f"preset {scene} {name}", times[name], device, scene=scene, preset=name, **more)


def method_costs(device: str, clock: Any, more: dict[str, Any]) -> None:
    """One line per method of every setting."""
    desk, darken, screen = (open_scene(name, FRAMES) for name in ("desk", "darken", "screen"))
    lamp = sized_light(desk)
    shows = {"light_shadow": lamp, "area_light": screen}
    for setting in (*settings_of(lamp), *(setting for setting in settings_of(screen) if setting.name == "area_light")):
        method_cost(shows.get(setting.name, desk), setting, device, clock, more)
    expose = next(setting for setting in settings_of(darken) if setting.name == "expose")
    method_cost(darken, expose, device, clock, more)


def settings_of(case: Case) -> tuple[Setting, ...]:
    return relevant_settings(case.scene, (case.scene.camera.width, case.scene.camera.height))


def method_cost(case: Case, setting: Setting, device: str, clock: Any, more: dict[str, Any]) -> None:
    """One line per method: its own stages, and those that run only for it."""
    outcomes = {}
    for method in setting.methods:
        quality = turn(BASE, {setting.name: method})
        timed = 1 if method == "brute_force" else TIMED
        outcomes[method] = run(case, quality, device, setting, between=light_only(quality), timed=timed, clock=clock)
    if setting.name == NOW_AND_THEN and wp.get_device(device).is_cpu:
        count_work(case, outcomes, device, clock)
    common = set.intersection(*(set(outcome.stages) for outcome in outcomes.values())) - set(setting.stages)
    base = outcomes[chosen(BASE, setting)]
    for method, outcome in outcomes.items():
        own = sum(ms for name, ms in outcome.stages.items() if name not in common)
        frame = {"frame_ms": round(outcome.milliseconds, 4), "base_ms": round(base.milliseconds, 4)}
        report(
            f"method {setting.name} {method}",
            [own],
            device,
            scene=case.name,
            setting=setting.name,
            method=method,
            **frame,
            **more,
        )
