"""Runs a plan: skips what has not changed, splits CPU passes into bands of rows, times every stage.

On CUDA the stages that must run are captured once as a graph and replayed; a different set of stages is a different
graph. In the graph a stage waits only for those whose output it reads, so that short kernels, which leave most of the
device idle, run beside others.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools
import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import warp as wp

from warp_ar.device import exclusive
from warp_ar.graph import INPUTS, Plan
from warp_ar.stages.base import Arrays, Pass, Rows, Stage

Step = tuple[Stage, list[Pass]]
"""A stage and those of its passes that are launched."""

# Bands shorter than this cost more in launching than they save.
MIN_BAND_ROWS = 8
# From this height on there are two bands per thread: rows are not alike, and who is done first takes what is left.
UNEVEN_ROWS = 96


@dataclasses.dataclass(frozen=True)
class StageTiming:
    """What one stage did in one frame."""

    milliseconds: float
    """On CUDA, unless the pipeline profiles, the stage's share of the time that launching took the host."""
    skipped: bool
    """True: nothing that it reads had changed."""


class Scheduler:
    """Runs the stages of one plan on one device."""

    def __init__(
        self, plan: Plan, arrays: Arrays, device: Any, *, bands: int | None = None, profile: bool = False
    ) -> None:
        """Allocate what the stages declared and build their passes.

        Args:
            plan: What runs.
            arrays: Resources; the pipeline's inputs must be there already.
            device: Warp device.
            bands: Bands per CPU pass; None means one or two per core that this process may use.
            profile: On CUDA wait for every frame and time each stage on the device; stages then run one by one.
        """
        self.plan = plan
        self.arrays = arrays
        self.device = device
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self.bands = bands
        self._threads = min(cores, bands or cores)
        helpers = max(self._threads - 1, 1)
        self._pool = ThreadPoolExecutor(helpers, "warp_ar") if device.is_cpu and (bands or cores) > 1 else None
        self._stages: list[Step] = []
        self._fills: dict[str, Any] = {}
        self._seen: dict[str, tuple[int, ...]] = {}
        self._translated: set[Pass] = set()
        self._graphs: dict[tuple[str, ...], Any] = {}
        self._streams: list[Any] = []
        self._marks: dict[str, tuple[Any, Any]] | None = {} if profile and device.is_cuda else None
        self.clock = time.perf_counter
        """Seconds by which stages are timed on the host."""
        with wp.ScopedDevice(device):
            for kind, wiring in plan.stages:
                stage = kind(plan.request, wiring)
                for name, spec in stage.arrays().items():
                    arrays.add(name, wp.full(spec.shape, spec.fill, dtype=spec.dtype, device=device))
                    self._fills[name] = spec.fill
                self._stages.append((stage, stage.build(arrays, device)))

    def close(self) -> None:
        """Stop the worker threads."""
        if self._pool is not None:
            self._pool.shutdown()

    def forget(self) -> None:
        """Make every stage run again in the next frame."""
        self._seen.clear()

    def continue_from(self, other: Scheduler) -> None:
        """Let stages go on from what the same stages of another plan remember, where it fits."""
        others = {stage.name: stage for stage, _ in other._stages}
        for stage, _ in self._stages:
            if stage.name not in others or others[stage.name] is stage:
                continue
            names = self._remembered(stage)
            if all(name in other.arrays and other.arrays[name].shape == self.arrays[name].shape for name in names):
                for name in names:
                    wp.copy(self.arrays[name], other.arrays[name])
                stage.resume(others[stage.name])

    def _remembered(self, stage: Stage) -> list[str]:
        """Arrays of a stage that carry over; a rung need not have all of them."""
        return [name for name in stage.remembers if name in self.arrays]

    def warm_up(self) -> None:
        """Launch everything once on whatever the arrays hold, so that the first frame finds its kernels loaded.

        The host's own steps are left out. On CUDA it runs on a stream of its own, and frames of others come between
        its steps.
        """
        stream = None
        if self.device.is_cuda:
            with exclusive(self.device):
                stream = wp.Stream(self.device)
        for stage, passes in self._stages:
            for step in passes:
                if not step.on_host:
                    with exclusive(self.device), wp.ScopedStream(stream):
                        step.launch(None)
                    self._translated.add(step)
            with exclusive(self.device), wp.ScopedStream(stream):
                for name in self._remembered(stage):
                    self.arrays[name].fill_(self._fills[name])
        if stream is not None:
            with exclusive(self.device):
                wp.synchronize_stream(stream)

    def run(self) -> Mapping[str, StageTiming]:
        """Run the stages whose inputs changed since they last ran; returns the time of each."""
        if self.device.is_cpu:
            return self._run_eager()
        return self._run_captured()

    def _due(self, stage: Stage) -> tuple[int, ...] | None:
        """Versions of what ``stage`` reads, or None if it has already seen them."""
        versions = tuple(self.arrays.version(name) for name in stage.wiring.reads)
        return None if self._seen.get(stage.name) == versions else versions

    def _publish(self, stage: Stage) -> None:
        for name in stage.wiring.writes:
            if self.arrays.version(name) == 0 or stage.changed(name):
                self.arrays.touch(name)

    def _run_eager(self) -> dict[str, StageTiming]:
        timings: dict[str, StageTiming] = {}
        for stage, passes in self._stages:
            versions = self._due(stage)
            if versions is None:
                timings[stage.name] = StageTiming(0.0, True)
                continue
            start = self.clock()
            for step in passes:
                self._run_pass(step)
            self._seen[stage.name] = versions
            self._publish(stage)
            timings[stage.name] = StageTiming((self.clock() - start) * 1e3, False)
        return timings

    def _run_pass(self, step: Pass) -> None:
        if self._pool is None or step.rows is None:
            # Extents are a saving of the CPU's; elsewhere a pass runs whole, as a captured graph replays it.
            step.launch(step.extent() if step.extent is not None and self.device.is_cpu else None)
            return
        start, stop = step.extent() if step.extent is not None else (0, step.rows)
        wanted = self.bands or self._threads * (2 if stop - start >= UNEVEN_ROWS else 1)
        bands = min(wanted, max(1, (stop - start) // MIN_BAND_ROWS))
        edges = [start + (stop - start) * band // bands for band in range(bands + 1)]
        waiting = collections.deque(itertools.pairwise(edges))
        # This thread works as well: one hand-over less per pass. It works alone at first, when kernels are translated:
        # Python 3.11's parser is not safe in two threads (seen: "AST constructor recursion depth mismatch").
        helpers = min(bands - 1, max(self._threads - 1, 1)) if step in self._translated else 0
        if stop > start:
            self._translated.add(step)
        futures: list[Future[None]] = [self._pool.submit(_drain, step.launch, waiting) for _ in range(helpers)]
        _drain(step.launch, waiting)
        for future in futures:
            future.result()

    def _run_captured(self) -> dict[str, StageTiming]:
        due: list[Step] = []
        timings: dict[str, StageTiming] = {}
        for stage, passes in self._stages:
            versions = self._due(stage)
            if versions is None:
                timings[stage.name] = StageTiming(0.0, True)
                continue
            due.append((stage, passes))
            self._seen[stage.name] = versions
            self._publish(stage)
        key = tuple(stage.name for stage, _ in due)
        if not key:
            return timings
        start = self.clock()
        for index, (on_host, part) in enumerate(_segments(due)):
            if on_host:
                self._launch_in_turn(part)
            else:
                self._replay((*key, str(index)), part)
        share = (self.clock() - start) * 1e3 / len(key)
        times = dict.fromkeys(key, share)
        if self._marks is not None:
            times = {name: wp.get_event_elapsed_time(*self._marks[name]) for name in key}
        timings.update({name: StageTiming(milliseconds, False) for name, milliseconds in times.items()})
        return timings

    def _replay(self, key: tuple[str, ...], part: list[Step]) -> None:
        graph = self._graphs.get(key)
        if graph is not None:
            wp.capture_launch(graph)
            return
        # Launched once outside the capture: that loads every module, which a capture must not do.
        self._launch_in_turn(part)
        with wp.ScopedCapture(device=self.device) as capture:
            if self._marks is None:
                self._launch_side_by_side(part)
            else:
                self._launch_in_turn(part)
        self._graphs[key] = capture.graph

    def _launch_in_turn(self, part: list[Step]) -> None:
        """Launch stages one after another; if profiling, between two marks each."""
        for stage, passes in part:
            if self._marks is not None:
                begin, end = self._marks.setdefault(stage.name, _make_marks(self.device))
                wp.record_event(begin)
            for step in passes:
                step.launch(None)
            if self._marks is not None:
                wp.record_event(end)

    def _launch_side_by_side(self, part: list[Step]) -> None:
        """Launch each stage on a stream of its own that waits for the writers of what it reads."""
        stream = wp.get_stream(self.device)
        self._streams += [wp.Stream(self.device) for _ in range(len(part) - len(self._streams))]
        begun = stream.record_event()
        written: dict[str, Any] = {}
        for own, (stage, passes) in zip(self._streams, part, strict=False):
            own.wait_event(begun)
            for name in stage.wiring.reads:
                if name in written:
                    own.wait_event(written[name])
            with wp.ScopedStream(own, sync_enter=False):
                for step in passes:
                    step.launch(None)
            done = own.record_event()
            written.update(dict.fromkeys(stage.wiring.writes, done))
            stream.wait_event(done)


def _make_marks(device: Any) -> tuple[Any, Any]:
    return wp.Event(device, enable_timing=True), wp.Event(device, enable_timing=True)


def _segments(due: list[Step]) -> list[tuple[bool, list[Step]]]:
    """Stages in order, cut into stretches that are captured as one and stretches that run on the host."""
    steps = [(step.on_host, stage, step) for stage, passes in due for step in passes]
    return [
        (on_host, [(stage, [step for _, _, step in own]) for stage, own in itertools.groupby(stretch, lambda s: s[1])])
        for on_host, stretch in itertools.groupby(steps, lambda s: s[0])
    ]


def _drain(launch: Callable[[Rows | None], None], waiting: collections.deque[Rows]) -> None:
    """Launch bands until none is waiting."""
    while True:
        try:
            rows = waiting.popleft()
        except IndexError:
            return
        launch(rows)


def add_inputs(arrays: Arrays, inputs: Mapping[str, Any]) -> None:
    """Add the pipeline's inputs, and the tables that stages share, to the resources."""
    for name, array in inputs.items():
        arrays.add(name, array)
    for name in INPUTS:
        if name not in arrays:
            arrays.add(name, None)
