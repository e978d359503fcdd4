"""Runs a plan: skips what has not changed, splits CPU passes into bands of rows, times every stage.

On CUDA the stages that must run are captured once as a graph and replayed; a different set of stages is a different
graph. In the graph a stage waits only for those whose output it reads, and for those that it runs after, so that
short kernels, which leave most of the device idle, run beside others. On CPU it is the same: threads take bands of
whatever stage has its inputs, the first in order first, so that nobody waits for a pass that cannot be split, or for
the last band of one that can.
"""

from __future__ import annotations

import bisect
import collections
import contextlib
import dataclasses
import itertools
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

from warp_ar.device import capturing, exclusive, translating
from warp_ar.engine.demand import Demand
from warp_ar.engine.graph import Plan
from warp_ar.stages.base import Arrays, Pass, Reach, Rows, Stage

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
    """On CPU the stage's share of the time that all took, by the time that its bands took; on CUDA, unless the pipeline
    profiles, an equal share of the time that launching took the host."""
    skipped: bool
    """True: nothing that it reads had changed, or it was left out of this frame."""
    left_out: str | None = None
    """Why it could change no pixel of this frame; None where that was not so."""


SKIPPED = StageTiming(0.0, True)


class Scheduler:
    """Runs the stages of one plan on one device."""

    def __init__(
        self,
        plan: Plan,
        arrays: Arrays,
        device: Any,
        *,
        bands: int | None = None,
        profile: bool = False,
        culling: bool = True,
    ) -> None:
        """Allocate what the stages declared and build their passes.

        Args:
            plan: What runs.
            arrays: Resources; the pipeline's inputs must be there already.
            device: Warp device.
            bands: Bands per CPU pass; None means one or two per core that this process may use.
            profile: On CUDA wait for every frame and time each stage on the device; stages then run one by one.
            culling: Whether stages that can change no pixel of a frame are left out of it.
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
        self._translated: set[int] = set()
        self._patterns: dict[Any, list[Segment]] = {}
        self._graphs: dict[tuple[int, ...], Any] = {}
        self._stream: Any = wp.get_stream(device) if device.is_cuda else None
        self._streams: list[Any] = []
        self._marks: dict[tuple[int, ...], tuple[Any, Any]] | None = {} if profile and device.is_cuda else None
        self.clock = time.perf_counter
        """Seconds by which stages are timed on the host."""
        with wp.ScopedDevice(device), translating(device):
            for kind, wiring in plan.stages:
                stage = kind(plan.features, wiring)
                for name, spec in stage.arrays().items():
                    arrays.add(name, wp.full(spec.shape, spec.fill, dtype=spec.dtype, device=device))
                    self._fills[name] = spec.fill
                self._stages.append((stage, stage.build(arrays, device)))
        self._culling = culling
        self._demand = Demand([stage for stage, _ in self._stages], plan.request.outputs)
        self._unneeded: Mapping[str, str] = {}
        """Why stages can change no pixel of this frame."""
        self._readers = _find_readers([stage for stage, _ in self._stages])
        self._order = {stage.name: index for index, (stage, _) in enumerate(self._stages)}
        # Stages that decide per frame what they do: their passes are part of a frame's pattern.
        self._changing = {stage.name for stage, passes in self._stages if any(step.enabled for step in passes)}

    def close(self) -> None:
        """Stop the worker threads."""
        if self._pool is not None:
            self._pool.shutdown()
        for stage, _ in self._stages:
            stage.close()

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
                    self.arrays.touch(name)
                stage.resume(others[stage.name])

    def _remembered(self, stage: Stage) -> list[str]:
        """Arrays of a stage that carry over; a method need not have all of them."""
        return [name for name in stage.remembers if name in self.arrays]

    def warm_up(self) -> None:
        """Launch everything once on whatever the arrays hold, so that the first frame finds its kernels loaded.

        The host's own steps are left out. On CUDA it runs on a stream of its own, and frames of others come between
        its steps.
        """
        stream = None
        self._demand.forget()
        if self.device.is_cuda:
            with exclusive(self.device):
                stream = wp.Stream(self.device)
        for stage, passes in self._stages:
            for step in passes:
                if not step.on_host:
                    with translating(self.device), wp.ScopedStream(stream):
                        step.launch(None)
                    self._translated.add(id(step))
            with exclusive(self.device), wp.ScopedStream(stream):
                for name in self._remembered(stage):
                    self.arrays[name].fill_(self._fills[name])
        if stream is not None:
            with exclusive(self.device):
                wp.synchronize_stream(stream)

    @contextlib.contextmanager
    def alone(self, clock: Callable[[], float]) -> Iterator[None]:
        """On CPU run stages one after another on the caller's thread, timed by its clock."""
        before = self._pool, self.clock
        self._pool, self.clock = None, clock
        try:
            yield
        finally:
            self._pool, self.clock = before

    def run(self) -> Mapping[str, StageTiming]:
        """Run the stages that this frame needs and whose inputs changed since they ran; returns the time of each."""
        self._look()
        if self.device.is_cpu:
            return self._run_eager()
        return self._run_captured()

    def _look(self) -> None:
        """Find out what this frame needs."""
        reach = self.arrays["reach"]() if "reach" in self.arrays else Reach()
        self._unneeded, clearing = self._demand.look(reach)
        for stage, _ in self._stages:
            if stage.name in self._unneeded:
                stage.rest()
        for name in clearing:
            self._seen.pop(name, None)

    def _timing_of_skipped(self, stage: Stage) -> StageTiming:
        reason = self._unneeded.get(stage.name) if self._culling else None
        return SKIPPED if reason is None else StageTiming(0.0, True, reason)

    def _due(self, stage: Stage) -> tuple[int, ...] | None:
        """Versions of what ``stage`` reads, or None if it has already seen them or this frame does not need it."""
        if self._culling and stage.name in self._unneeded:
            return None
        versions = self.arrays.versions(stage.wiring.reads)
        return None if self._seen.get(stage.name) == versions else versions

    def _begin(self, stage: Stage, passes: list[Pass]) -> list[Pass]:
        """Passes of a stage that take part in this frame."""
        if stage.name not in self._unneeded:
            stage.begin()
        return [step for step in passes if step.enabled is None or step.enabled()]

    def _publish(self, stage: Stage) -> None:
        if stage.name in self._unneeded and type(stage).changed is not Stage.changed:
            return  # what readers may miss is decided in frames that have readers, whether others are left out or not
        for name in stage.wiring.writes:
            if stage.changed(name) or self.arrays.version(name) == 0:
                self.arrays.touch(name)

    def _run_eager(self) -> dict[str, StageTiming]:
        """Stage after stage, or side by side where there are threads for it."""
        if self._pool is not None:
            return SideBySide(self, self._pool, self._threads).run()
        timings: dict[str, StageTiming] = {}
        for stage, passes in self._stages:
            versions = self._due(stage)
            if versions is None:
                timings[stage.name] = self._timing_of_skipped(stage)
                continue
            start = self.clock()
            for step in self._begin(stage, passes):
                # Extents are a saving of the CPU's; elsewhere a pass runs whole, as a captured graph replays it.
                self._launch_band(step, step.extent() if step.extent is not None and self.device.is_cpu else None)
            self._seen[stage.name] = versions
            self._publish(stage)
            timings[stage.name] = StageTiming((self.clock() - start) * 1e3, False)
        return timings

    def _split(self, step: Pass) -> list[Rows | None]:
        """Bands of a pass in this frame."""
        if step.rows is None:
            return [step.extent() if step.extent is not None else None]
        start, stop = step.extent() if step.extent is not None else (0, step.rows)
        if stop <= start:
            return []
        if id(step) not in self._translated:
            return [(start, stop)]
        wanted = self.bands or self._threads * (2 if stop - start >= UNEVEN_ROWS else 1)
        bands = min(wanted, max(1, (stop - start) // MIN_BAND_ROWS))
        return list(itertools.pairwise(start + (stop - start) * band // bands for band in range(bands + 1)))

    def _launch_band(self, step: Pass, rows: Rows | None) -> None:
        if step.on_host or id(step) in self._translated:
            step.launch(rows)
            return
        with translating(self.device):
            step.launch(rows)
        self._translated.add(id(step))

    def _run_captured(self) -> dict[str, StageTiming]:
        due: list[Step] = []
        pattern: list[Any] = []
        timings: dict[str, StageTiming] = {}
        for stage, passes in self._stages:
            versions = self._due(stage)
            if versions is None:
                timings[stage.name] = self._timing_of_skipped(stage)
                continue
            chosen = self._begin(stage, passes)
            due.append((stage, chosen))
            pattern.append((stage.name, *map(id, chosen)) if stage.name in self._changing else stage.name)
            self._seen[stage.name] = versions
            self._publish(stage)
        if not due:
            return timings
        key = tuple(pattern)
        if key not in self._patterns:
            self._patterns[key] = _segments(due)
        start = self.clock()
        for segment in self._patterns[key]:
            if segment.on_host:
                for _, steps in segment.part:
                    for step in steps:
                        step.launch(None)
            else:
                self._replay(segment)
        names = [stage.name for stage, _ in due]
        if self._marks is None:
            share = StageTiming((self.clock() - start) * 1e3 / len(due), False)
            return timings | dict.fromkeys(names, share)
        times = dict.fromkeys(names, 0.0)
        for segment in self._patterns[key]:
            for stage, steps in segment.part:
                if not segment.on_host:
                    times[stage.name] += wp.get_event_elapsed_time(*self._marks[_ids(steps)])
        return timings | {name: StageTiming(milliseconds, False) for name, milliseconds in times.items()}

    def _replay(self, segment: Segment) -> None:
        graph = self._graphs.get(segment.key)
        if graph is not None:
            wp.capture_launch(graph, stream=self._stream)
            return
        with exclusive(self.device), wp.ScopedStream(self._stream, sync_enter=False):
            # Launched once outside the capture: that loads every module, which a capture must not do.
            self._launch_in_turn(segment.part)
            with capturing(), wp.ScopedCapture(device=self.device) as capture:
                if self._marks is None:
                    self._launch_side_by_side(segment.part)
                else:
                    self._launch_in_turn(segment.part)
        self._graphs[segment.key] = capture.graph

    def _launch_in_turn(self, part: list[Step]) -> None:
        """Launch stages one after another; if profiling, between two marks each."""
        for _stage, steps in part:
            if self._marks is not None:
                begin, end = self._marks.setdefault(_ids(steps), _make_marks(self.device))
                wp.record_event(begin)
            for step in steps:
                step.launch(None)
            if self._marks is not None:
                wp.record_event(end)

    def _launch_side_by_side(self, part: list[Step]) -> None:
        """Launch each stage on a stream of its own that waits for the writers of what it reads."""
        stream = self._stream
        self._streams += [wp.Stream(self.device) for _ in range(len(part) - len(self._streams))]
        begun = stream.record_event()
        written: dict[str, Any] = {}
        ends: dict[str, Any] = {}
        for own, (stage, passes) in zip(self._streams, _in_launch_order(part), strict=False):
            own.wait_event(begun)
            for name in stage.wiring.reads:
                if name in written:
                    own.wait_event(written[name])
            for name in stage.runs_after():
                if name in ends:
                    own.wait_event(ends[name])
            with wp.ScopedStream(own, sync_enter=False):
                for step in passes:
                    step.launch(None)
            done = ends[stage.name] = own.record_event()
            written.update(dict.fromkeys(stage.wiring.writes, done))
            stream.wait_event(done)


@dataclasses.dataclass(frozen=True)
class Segment:
    """A stretch of a frame: on the host, or captured as one graph."""

    on_host: bool
    part: list[Step]
    key: tuple[int, ...]
    """Of its passes."""


class _Running:
    """A stage in one frame on CPU."""

    def __init__(self, stage: Stage, steps: list[Pass], waits: int) -> None:
        self.stage, self.steps = stage, steps
        self.waits = waits
        """Stages whose output it reads and that are not done."""
        self.versions: tuple[int, ...] = ()
        self.left: collections.deque[Pass] = collections.deque()
        self.step: Pass | None = None
        self.bands: collections.deque[Rows | None] = collections.deque()
        self.out = 0
        """Bands under way."""
        self.seconds = 0.0


class SideBySide:
    """One frame on CPU: threads take the next band of the first stage that has one ready."""

    def __init__(self, scheduler: Scheduler, pool: ThreadPoolExecutor, threads: int) -> None:
        """Prepare; stages without unfinished inputs are ready at once."""
        self._scheduler, self._pool, self._threads = scheduler, pool, threads
        self._changed = threading.Condition()
        readers = scheduler._readers
        counts = collections.Counter(reader for found in readers.values() for reader in found)
        self._stages = {stage.name: _Running(stage, steps, counts[stage.name]) for stage, steps in scheduler._stages}
        self._timings: dict[str, StageTiming] = {}
        self._open = len(self._stages)
        self._ready: list[_Running] = []  # in the stages' order
        self._error: BaseException | None = None

    def run(self) -> dict[str, StageTiming]:
        """Run all; this thread works too. The first error ends it, once bands under way are done."""
        start = self._scheduler.clock()
        with self._changed:
            for running in [first for first in self._stages.values() if first.waits == 0]:
                self._begin(running)
        helpers = [self._pool.submit(self._work) for _ in range(self._threads - 1)] if self._open else []
        self._work()
        for helper in helpers:
            helper.result()
        if self._error is not None:
            raise self._error
        whole = (self._scheduler.clock() - start) * 1e3
        busy = sum(running.seconds for running in self._stages.values()) or 1.0
        for name, running in self._stages.items():
            if name not in self._timings:
                self._timings[name] = StageTiming(whole * running.seconds / busy, False)
        return {name: self._timings[name] for name in self._stages}

    def _begin(self, running: _Running) -> None:
        """All inputs are there: ready, or done at once where none of them changed."""
        versions = self._scheduler._due(running.stage)
        if versions is None:
            self._timings[running.stage.name] = self._scheduler._timing_of_skipped(running.stage)
            self._end(running)
            return
        running.versions = versions
        running.left.extend(self._scheduler._begin(running.stage, running.steps))
        order = self._scheduler._order
        bisect.insort(self._ready, running, key=lambda other: order[other.stage.name])
        self._advance(running)

    def _advance(self, running: _Running) -> None:
        """Go to the next pass that has rows, or to the end."""
        while running.left:
            running.step = running.left.popleft()
            running.bands.extend(self._scheduler._split(running.step))
            if running.bands:
                return
        self._ready.remove(running)
        self._scheduler._seen[running.stage.name] = running.versions
        self._scheduler._publish(running.stage)
        self._end(running)

    def _end(self, running: _Running) -> None:
        self._open -= 1
        for name in self._scheduler._readers[running.stage.name]:
            reader = self._stages[name]
            reader.waits -= 1
            if reader.waits == 0:
                self._begin(reader)

    def _work(self) -> None:
        """Take bands until no stage is left."""
        clock = self._scheduler.clock
        with self._changed:
            while self._error is None and self._open:
                chosen = next((running for running in self._ready if running.bands), None)
                if chosen is None:
                    self._changed.wait()
                    continue
                rows, step = chosen.bands.popleft(), chosen.step
                chosen.out += 1
                assert step is not None
                self._changed.release()
                start = clock()
                error: BaseException | None = None
                try:
                    self._scheduler._launch_band(step, rows)
                except BaseException as caught:  # handed to the thread that asked for the frame
                    error = caught
                spent = clock() - start
                self._changed.acquire()
                chosen.seconds += spent
                chosen.out -= 1
                if error is None and not chosen.bands and chosen.out == 0 and self._error is None:
                    try:
                        self._advance(chosen)
                    except BaseException as caught:
                        error = caught
                    self._changed.notify_all()
                if error is not None:
                    self._error = self._error or error
                    self._changed.notify_all()


def _make_marks(device: Any) -> tuple[Any, Any]:
    return wp.Event(device, enable_timing=True), wp.Event(device, enable_timing=True)


def _ids(steps: list[Pass]) -> tuple[int, ...]:
    return tuple(map(id, steps))


def _in_launch_order(part: list[Step]) -> list[Step]:
    """Stages in the order of their launch: after those that they run after, but before those that read them."""
    ordered = list(part)
    for step in part:
        stage = step[0]
        place = at = ordered.index(step)
        for behind in range(at + 1, len(ordered)):
            other = ordered[behind][0]
            if not set(stage.wiring.writes).isdisjoint(other.wiring.reads):
                break
            if other.name in stage.runs_after():
                place = behind
        ordered.insert(place, ordered.pop(at))
    return ordered


def _segments(due: list[Step]) -> list[Segment]:
    """Stages in order, cut into stretches that are captured as one and stretches that run on the host."""
    steps = [(step.on_host, stage, step) for stage, passes in due for step in passes]
    parts = [
        (on_host, [(stage, [step for _, _, step in own]) for stage, own in itertools.groupby(stretch, lambda s: s[1])])
        for on_host, stretch in itertools.groupby(steps, lambda s: s[0])
    ]
    return [Segment(on_host, part, _ids([step for _, own in part for step in own])) for on_host, part in parts]


def _find_readers(stages: list[Stage]) -> dict[str, list[str]]:
    """Stages that read what each stage writes."""
    return {
        stage.name: [
            later.name for later in stages[index + 1 :] if not set(stage.wiring.writes).isdisjoint(later.wiring.reads)
        ]
        for index, stage in enumerate(stages)
    }
