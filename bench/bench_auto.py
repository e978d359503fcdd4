"""``--quality auto`` on this machine: what share of a budget frames take in the end, also when load and scene change.

    python -m bench auto [--scene NAME] [--budgets A,B] [--seconds N] [--parts headless,page] [--processor-time]

Real frames through the real pipelines, one after another, where ``python -m bench budget`` pretends machines. Give it
cores of its own (``taskset -c 0,1``): on them other work is what this bench starts. One JSON line per budget and phase:

  headless  as ``live --headless`` lights frames: ``steady``; ``busy``, beside a program that keeps one core busy;
            ``alone``, after it has ended
  page      as the page's host lights them: ``steady``; ``grown``, after GROWN objects were added, one a second;
            ``shrunk``, after they were taken away again

  settles   median of the frames of the last LAST seconds over the budget
  within    whether that is 0.9 to 1, or nothing errs less (``top``), or nothing costs less (``bottom``)
  after     seconds from which on medians over a second stay where they end, within a tenth of the budget
  changes   of settings in the phase, and ``error`` what the cost table expects of the last ones
  next      what the cheapest choice that errs less is expected to take, over the budget; null: nothing errs less

With ``--processor-time`` (headless only) frames are timed by what one thread works, and a load of LOAD multiplies that:
other programs then hardly matter. Costs are measured first, in a folder of their own; kernels are compiled meanwhile.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import itertools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from bench.common import commit
from warp_ar.accuracy.budget import AutoPipeline
from warp_ar.accuracy.cases import Case, open_scene
from warp_ar.accuracy.controller import Controller
from warp_ar.accuracy.cost_table import relevant_settings
from warp_ar.accuracy.costs import WORK, Costs, measure_costs
from warp_ar.scene import load_scene
from warp_ar.viewer.frames import Lit
from warp_ar.viewer.host import Host
from warp_ar.viewer.protocol import parse_text

LAST = 5.0
LOAD = 1.5
"""By which a busy core multiplies frames, where processor time is counted."""
GROWN = 4
FRAMES = 12
"""Of the clip, shown to and fro."""
PATIENCE = 600.0
"""Seconds in which costs must be known."""
WITHIN = (0.9, 1.0)

Note = tuple[float, float, float]
"""When a frame ended, what it took in milliseconds, the expected error of its settings."""


def told(part: str, phase: str, budget: float, notes: list[Note], begun: float, **more: Any) -> None:
    """Print what a phase came to."""
    end = notes[-1][0]
    late = [ms for now, ms, _ in notes if now > end - LAST]
    share = statistics.median(late) / budget
    seconds: dict[int, list[float]] = {}
    for now, ms, _ in notes:
        seconds.setdefault(int(now - begun), []).append(ms / budget)
    off = [second for second, own in seconds.items() if abs(statistics.median(own) - share) > 0.1]
    changes = sum(a[2] != b[2] for a, b in itertools.pairwise(notes))
    at_an_end = bool(more["top"] and share < WITHIN[0]) or bool(more["bottom"] and share > WITHIN[1])
    line = {"bench": "auto", "part": part, "phase": phase, "budget_ms": budget, "settles": round(share, 3)}
    line |= {"within": WITHIN[0] <= share <= WITHIN[1] or at_an_end, "after": max(off, default=-1) + 1}
    line |= {"changes": changes, "error": notes[-1][2], "frames": len(notes), **more}
    print(json.dumps({**line, "cores": len(os.sched_getaffinity(0)), "commit": commit()}), flush=True)


def ends(controller: Controller) -> dict[str, Any]:
    """Whether the controller runs what errs least, or what costs least, and what the next choice would take."""
    errors = [choice.error for choice in controller.choices]
    better = [choice for choice in controller.choices if choice.error < controller.expected_error - 1e-9]
    next_ms = min((controller.expected(dict(choice.settings)) for choice in better), default=None)
    return {
        "next": None if next_ms is None else round(next_ms / controller.budget_ms, 3),
        "top": controller.expected_error <= min(errors) + 1e-9,
        "bottom": controller.expected_error >= max(errors) - 1e-9,
    }


@contextlib.contextmanager
def busy_core() -> Iterator[None]:
    """A program that keeps one of this process's cores busy."""
    burner = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        yield
    finally:
        burner.kill()
        burner.wait()


class Headless:
    """A clip lit by ``AutoPipeline``, to and fro, without an end."""

    def __init__(self, case: Case, budget: float, costs: Costs, device: str, *, work: bool) -> None:
        self.case, self.budget, self.work, self.load = case, budget, work, 1.0
        self.auto = AutoPipeline(
            case.scene, budget_ms=budget, device=device, costs=costs, bands=1 if work else None, estimates="delayed"
        )
        self._order = itertools.cycle([*range(FRAMES), *range(FRAMES - 2, 0, -1)])
        self._shown = 0

    def _clock(self) -> float:
        return self.load * WORK()

    def run(self, seconds: float) -> list[Note]:
        """Light frames for so long."""
        notes, begun = [], time.monotonic()
        while time.monotonic() < begun + seconds:
            index = next(self._order)
            if self.work:
                self.auto.pipeline.scheduler.clock = self._clock
            # Processor time leaves tracking out: it runs before the stages.
            pose = self.case.poses[index] if self.work else None
            self._shown += 1
            result = self.auto(self.case.frames[index].image, time_seconds=self._shown / 30.0, pose=pose)
            spent = sum(timing.milliseconds for timing in result.stages.values())
            notes.append((time.monotonic(), spent, self.auto.status().get("expected_error", 0.0)))
        return notes

    def phase(self, name: str, seconds: float) -> None:
        """The same, and tell what it came to."""
        begun = time.monotonic()
        notes = self.run(seconds)
        controller = self.auto._controller
        assert controller is not None
        told("headless", name, self.budget, notes, begun, load=round(controller.factor, 3), **ends(controller))


def run_headless(case: Case, budgets: list[float], seconds: float, device: str, *, work: bool) -> None:
    """Every budget: a steady load, a busier machine, and alone again."""
    size = case.scene.camera.width, case.scene.camera.height
    start = time.perf_counter()
    settings = relevant_settings(case.scene, size)
    costs = measure_costs(
        case.scene, case.frames[-1].image, case.poses[-1], device, size, settings, WORK if work else None
    )
    if work:
        costs = dataclasses.replace(costs, base=costs.base - costs.track, track=0.0)
    print(json.dumps({"bench": "auto", "costs_seconds": round(time.perf_counter() - start, 1)}), flush=True)
    for budget in budgets:
        headless = Headless(case, budget, costs, device, work=work)
        with headless.auto:
            headless.phase("steady", 2.0 * seconds)
            if work:
                headless.load = LOAD
                headless.phase("busy", seconds)
                headless.load = 1.0
            else:
                with busy_core():
                    headless.phase("busy", seconds)
            headless.phase("alone", seconds)


class Page:
    """A scene lit by the page's host."""

    def __init__(self, scene: str, budget: float, device: str, folder: Path) -> None:
        self.budget, self.lit = budget, threading.Event()
        self.notes: list[Note] = []
        self.host = Host(
            load_scene(scene), quality="auto", budget_ms=budget, device=device, publish=self._publish, notify=self._note
        )
        self.host._budget._folder = folder  # what other runs measured, under another load, is not read
        self._thread = threading.Thread(target=self.host.run)

    def _note(self, message: dict[str, Any]) -> None:
        if message.get("type") == "notice" and message.get("bad"):
            print(json.dumps({"bench": "auto", "notice": message["text"]}), flush=True)

    def _publish(self, lit: Lit) -> None:
        state = self.host._budget.state()
        if lit.light_ms > 0.0 and state is not None:
            self.notes.append((time.monotonic(), lit.light_ms, state["expected_error"]))
            self.lit.set()

    def __enter__(self) -> Page:
        self.host.watch(1)
        self._thread.start()
        if not self.lit.wait(PATIENCE):
            raise SystemExit("bench auto: no frame was lit under the budget")
        return self

    def __exit__(self, *_: object) -> None:
        self.host.stop()
        self._thread.join()
        self.host.close()

    def phase(self, name: str, seconds: float, edits: list[dict[str, Any]]) -> None:
        """Make edits, one a second, and tell what the time after them came to."""
        for message in edits:
            self.host.edit(parse_text(json.dumps(message)), "bench")
            time.sleep(1.0)
        first, begun = len(self.notes), time.monotonic()
        time.sleep(seconds)
        controller = self.host._budget._controller
        assert controller is not None
        told("page", name, self.budget, self.notes[first:], begun, load=round(controller.factor, 3), **ends(controller))


def run_page(scene: str, budgets: list[float], seconds: float, device: str) -> None:
    """Every budget: as it is, with more objects, and without them again."""
    count = len(load_scene(scene).objects)
    with tempfile.TemporaryDirectory() as folder:
        for budget in budgets:
            with Page(scene, budget, device, Path(folder)) as page:
                page.phase("steady", 2.0 * seconds, [])
                page.phase("grown", seconds, [{"type": "add", "part": "object", "kind": "sphere"}] * GROWN)
                page.phase("shrunk", seconds, [{"type": "remove", "part": "object", "index": count}] * GROWN)


def main(device: str, arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m bench auto")
    parser.add_argument("--scene", default="desk")
    parser.add_argument("--budgets", default="20,40,100,400")
    parser.add_argument("--seconds", type=float, default=20.0, help="of a phase; the first takes twice as long")
    parser.add_argument("--parts", default="headless,page")
    parser.add_argument("--processor-time", action="store_true")
    options = parser.parse_args(arguments or [])
    budgets = [float(budget) for budget in options.budgets.split(",")]
    parts: dict[str, Callable[[], None]] = {
        "headless": lambda: run_headless(
            open_scene(options.scene, FRAMES), budgets, options.seconds, device, work=options.processor_time
        ),
        "page": lambda: run_page(options.scene, budgets, options.seconds, device),
    }
    for part in options.parts.split(","):
        parts[part]()
