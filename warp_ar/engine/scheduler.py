"""Execution of a plan: skips stages with unchanged inputs, splits CPU passes into bands of rows, times every stage.

On CUDA the stages that must run are captured once as a graph and replayed; each set of stages has its own graph. In the
graph a stage waits only for the stages whose output it reads. Short kernels, which leave most of the device idle,
therefore run concurrently with others. On CPU, native threads (see ``cpu_threads``) take rows of any stage whose inputs
are ready, in the order of the plan. Therefore no thread waits for a pass that cannot be split, or for the last rows of
a pass that can.
"""

from __future__ import annotations

import dataclasses
import itertools
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import warp as wp

from warp_ar.device import capturing, exclusive, translating, usable_cores
from warp_ar.engine.cpu_threads import CpuThreads
from warp_ar.engine.environment_history import LIGHT_ARRAYS
from warp_ar.engine.frame_culling import FrameCulling
from warp_ar.engine.graph import Plan
from warp_ar.engine.modules import Progress, load_modules
from warp_ar.kernels.bands import serve_kernel
from warp_ar.kernels.launch import Note, noting
from warp_ar.stages.base import Arrays, ArraySpec, Pass, Reach, Rows, Stage

Step = tuple[Stage, list[Pass]]
"""Stage with those of its passes that are launched."""


@dataclasses.dataclass(frozen=True)
class StageTiming:
    """Time of one stage in one frame."""

    milliseconds: float
    """On CPU, the frame's time multiplied by the stage's share of the threads' time. On CUDA, the stage's time on the
    device if the pipeline profiles; else the host's launch time divided by the number of stages."""
    skipped: bool
    """True if the stage's inputs were unchanged, or it was left out of this frame."""
    left_out: str | None = None
    """Reason for which the stage cannot change a pixel of this frame; None if it can."""


class Scheduler:
    """Executor of the stages of one plan on one device."""

    def __init__(
        self,
        plan: Plan,
        arrays: Arrays,
        device: Any,
        *,
        bands: int | None = None,
        profile: bool = False,
        culling: bool = True,
        spare: Mapping[str, Any] | None = None,
    ) -> None:
        """Allocate the arrays that the stages declare, and build their passes.

        Args:
            plan: Stages to run.
            arrays: Resources by name; the pipeline's inputs must be present.
            device: Warp device.
            bands: Bands per CPU pass; None means one or two per core that this process may use.
            profile: On CUDA, wait for every frame and time each stage on the device; stages then run one by one.
            culling: True to leave out, in each frame, the stages that can change none of its pixels.
            spare: Former arrays by name, which are reused where shape and type fit.
        """
        self.plan = plan
        self.arrays = arrays
        self.device, self._on_cpu = device, bool(device.is_cpu)
        cores = usable_cores()
        self.bands = bands
        self._threads = min(cores, bands or cores)
        if bands is not None and bands > 1:
            self._threads = max(self._threads, 2)  # bands run concurrently even on one core
        self._cpu_threads: CpuThreads | None = None
        self._prepared = False
        self._stages: list[Step] = []
        self._first_launches: list[Note] = []
        self._fills: dict[str, Any] = {}
        self._seen: dict[str, Any] = {}
        self._translated: set[int] = set()
        self._patterns: dict[tuple[int, ...], list[Segment]] = {}
        self._graphs: dict[tuple[int, ...], Any] = {}
        self._stream: Any = None if self._on_cpu else wp.get_stream(device)
        self._streams: list[Any] = []
        self._marks: dict[tuple[int, ...], tuple[Any, Any]] | None = {} if profile and not self._on_cpu else None
        self.clock = time.perf_counter
        """Clock, in seconds, that times stages on the host."""
        self._build(spare or {})
        self._culling = culling
        self._frame_culling = FrameCulling([stage for stage, _ in self._stages], plan.request.resources)

    def _build(self, spare: Mapping[str, Any]) -> None:
        """Allocate the arrays of the plan's stages and build their passes."""
        with wp.ScopedDevice(self.device), translating(self.device):
            for kind, wiring in self.plan.stages:
                stage = kind(self.plan.features, wiring)
                for name, spec in stage.arrays().items():
                    self.arrays.add(name, self._array(spec, spare.get(name)))
                    self._fills[name] = spec.fill
                with noting() as notes:
                    self._stages.append((stage, stage.build(self.arrays, self.device)))
                self._first_launches += notes

    def _array(self, spec: ArraySpec, spare: Any) -> Any:
        """Return an array with its initial values: the spare array if it fits, else a new one."""
        if spare is None or (spare.shape, spare.dtype) != (spec.shape, spec.dtype):
            return wp.full(spec.shape, spec.fill, dtype=spec.dtype, device=self.device)
        spare.fill_(spec.fill)
        return spare

    def launch_first(self, notes: Iterable[Note]) -> None:
        """Add recorded launches that run once, before the first launch of any stage."""
        self._first_launches += notes

    def close(self) -> None:
        """Stop the worker threads."""
        if self._cpu_threads is not None:
            self._cpu_threads.close()
            self._cpu_threads = None
        for stage, _ in self._stages:
            stage.close()

    def let_go(self) -> None:
        """Free the arrays of a closed scheduler at once; it cannot be used again.

        Arrays and stages refer to each other, so only the garbage collector would free them. It runs after a number of
        new objects, and these are few although they hold many megabytes. Arrays that results refer to stay.
        """
        with exclusive(self.device):
            self.arrays.clear()
            for owner in (self.arrays, self):
                vars(owner).clear()

    def stage(self, name: str) -> Stage | None:
        """Return the stage of that name; None if it is not part of the plan."""
        return next((stage for stage, _ in self._stages if stage.name == name), None)

    def forget(self) -> None:
        """Make every stage run again in the next frame."""
        self._seen.clear()

    def restart(self) -> None:
        """Make every stage run again in the next frame, without the state that it keeps between frames."""
        self.forget()
        with wp.ScopedDevice(self.device), exclusive(self.device):
            for stage, _ in self._stages:
                for name in self._remembered(stage):
                    self.arrays[name].fill_(self._fills[name])
                    self.arrays.touch(name)

    def continue_from(self, other: Scheduler) -> None:
        """Copy the state that stages keep between frames from another scheduler's stages.

        A stage is continued if the other scheduler has a stage of its name with arrays of equal shapes.
        """
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

    def constants(self) -> dict[Any, Any]:
        """Return the arrays of constants, such as tables, for the next pipeline to share; empty before ``prepare``."""
        return self.arrays.constants if self._prepared else {}

    def spare(self) -> dict[str, Any]:
        """Return arrays, by name, that neither a result nor the next pipeline needs, so that they can be overwritten.

        The result is empty on CUDA, where a memory pool makes reuse unnecessary.
        """
        if not self._on_cpu:
            return {}
        needed = {*self.plan.request.resources, *LIGHT_ARRAYS}
        needed.update(*(stage.remembers for stage, _ in self._stages))
        return {name: array for name, array in self.arrays.items() if name in self._fills and name not in needed}

    def _remembered(self, stage: Stage) -> list[str]:
        """Return the names of the existing arrays in which a stage keeps state between frames."""
        return [name for name in stage.remembers if name in self.arrays]

    def prepare(self, progress: Progress | None = None) -> None:
        """Compile and load every kernel in parallel, and compute the stages' tables; a second call does nothing.

        Args:
            progress: Function to which the numbers of compiled modules, first 0, and of all modules to compile are
                passed; not called if there are none to compile.
        """
        if self._prepared:
            return
        notes: dict[int, list[Note]] = {}
        host_kernels: list[wp.Kernel] = []
        with wp.ScopedDevice(self.device), translating(self.device):
            for stage, passes in self._stages:
                host_kernels += stage.host_kernels()
                for step in passes:
                    if not step.on_host:
                        with noting() as noted:
                            step.launch(None if step.rows is None else (0, step.rows))
                        if noted:  # a pass without a recorded launch is run by Python in each frame
                            notes[id(step)] = noted
        found = [*(note for each in notes.values() for note in each), *self._first_launches]
        launched = [(note.kernel, note.block_dim) for note in found if note.kernel is not None]
        # Modules are loaded for their own block size; other block sizes on CUDA must be listed.
        blocks = [one for one in launched if not self._on_cpu and one[1] != one[0].module.options["block_dim"]]
        kernels = [one[0] for one in launched if one not in blocks]
        own = [serve_kernel] if self._threads > 1 and self._on_cpu else []
        load_modules([*own, *kernels, *host_kernels], self.device, progress, blocks=blocks)
        with wp.ScopedDevice(self.device), translating(self.device):
            for note in self._first_launches:
                note.do()
            self._first_launches.clear()
            if own:
                readers = _find_readers([stage for stage, _ in self._stages])
                self._cpu_threads = CpuThreads(
                    self._stages, notes, readers, threads=self._threads, bands_per_pass=self.bands
                )
        self._prepared = True

    def warm_up(self, progress: Progress | None = None) -> None:
        """Compile and load every kernel; on CUDA also launch every pass once, on the arrays' current values.

        Passes on the host are not run. The launches are on a separate stream, and frames of other pipelines can run
        between them.

        Args:
            progress: Function to which the numbers of compiled modules, first 0, and of all modules to compile are
                passed.
        """
        self.prepare(progress)
        self._frame_culling.forget()
        if self._on_cpu:
            return
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
        with exclusive(self.device):
            wp.synchronize_stream(stream)

    def run(self, receive: Callable[[], None] | None = None) -> Mapping[str, StageTiming]:
        """Run the stages that this frame needs and whose inputs have changed; return the time of every stage by name.

        Args:
            receive: Function that is called when the stages to run are known, before anything is launched.
        """
        self.prepare()
        try:
            due, timings = self._choose()
            if receive is not None:
                receive()
            if not due:
                times: Mapping[str, float] = {}
            elif not self._on_cpu:
                times = self._run_captured(due)
            elif self._cpu_threads is None or sys.gettrace() is not None:
                times = self._run_eager(due)  # a debugger (a trace function) then stops at breakpoints in launchers
            else:
                times = self._run_side_by_side(due)
        except BaseException:
            self.forget()  # some of the stages may not have run
            raise
        return timings | {name: StageTiming(milliseconds, False) for name, milliseconds in times.items()}

    def _choose(self) -> tuple[list[Step], dict[str, StageTiming]]:
        """Return the stages that run in this frame, with their passes, and the timings of the stages that do not."""
        reach = self.arrays["reach"]() if "reach" in self.arrays else Reach()
        unneeded, clearing = self._frame_culling.look(reach)
        for name in clearing:
            self._seen.pop(name, None)
        due: list[Step] = []
        skipped: dict[str, StageTiming] = {}
        for stage, passes in self._stages:
            reason = unneeded.get(stage.name)
            if reason is not None:
                stage.rest()
            left_out = reason if self._culling else None
            versions = [self.arrays.version(name) for name in stage.wiring.reads]
            if left_out is not None or self._seen.get(stage.name) == versions:
                skipped[stage.name] = StageTiming(0.0, True, left_out)
                continue
            if reason is None:
                stage.begin()
            due.append((stage, [step for step in passes if step.enabled is None or step.enabled()]))
            self._seen[stage.name] = versions
            self.arrays.touch(*stage.wiring.writes)
        return due, skipped

    def _run_eager(self, due: list[Step]) -> dict[str, float]:
        """Run one stage after another on this thread; return milliseconds by stage."""
        times: dict[str, float] = {}
        for stage, passes in due:
            start = self.clock()
            for step in passes:
                self._launch(step, None if step.extent is None else step.extent())
            times[stage.name] = (self.clock() - start) * 1e3
        return times

    def _run_side_by_side(self, due: list[Step]) -> dict[str, float]:
        """Run stages on native threads by bands of rows; return milliseconds by stage."""
        assert self._cpu_threads is not None
        start = self.clock()
        times = self._cpu_threads.run(due)
        whole = (self.clock() - start) * 1e3
        busy = sum(times.values()) or 1.0
        return {stage.name: whole * times[stage.name] / busy for stage, _ in due}

    def _launch(self, step: Pass, rows: Rows | None) -> None:
        if step.on_host or id(step) in self._translated:
            step.launch(rows)
            return
        with translating(self.device):
            step.launch(rows)
        self._translated.add(id(step))

    def _run_captured(self, due: list[Step]) -> dict[str, float]:
        """Replay the CUDA graphs of these passes, first capturing new ones; return milliseconds by stage."""
        key = tuple(id(step) for _, steps in due for step in steps)
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
            return dict.fromkeys(names, (self.clock() - start) * 1e3 / len(due))
        times = dict.fromkeys(names, 0.0)
        for segment in self._patterns[key]:
            for stage, steps in segment.part:
                if not segment.on_host:
                    times[stage.name] += wp.get_event_elapsed_time(*self._marks[_ids(steps)])
        return times

    def _replay(self, segment: Segment) -> None:
        graph = self._graphs.get(segment.key)
        if graph is not None:
            wp.capture_launch(graph, stream=self._stream)
            return
        with exclusive(self.device), wp.ScopedStream(self._stream, sync_enter=False):
            # The first launch is not captured, because it may load modules, which is not allowed in a capture.
            self._launch_in_turn(segment.part)
            with capturing(), wp.ScopedCapture(device=self.device) as capture:
                if self._marks is None:
                    self._launch_side_by_side(segment.part)
                else:
                    self._launch_in_turn(segment.part)
        self._graphs[segment.key] = capture.graph

    def _launch_in_turn(self, part: list[Step]) -> None:
        """Launch stages one after another; if the pipeline profiles, each between two events."""
        for _stage, steps in part:
            if self._marks is not None:
                begin, end = self._marks.setdefault(_ids(steps), _make_marks(self.device))
                wp.record_event(begin)
            for step in steps:
                step.launch(None)
            if self._marks is not None:
                wp.record_event(end)

    def _launch_side_by_side(self, part: list[Step]) -> None:
        """Launch each stage on a stream of its own; a pass waits for the stages that write its inputs."""
        stream = self._stream
        begun = stream.record_event()
        written: dict[str, Any] = {}
        self._streams += [wp.Stream(self.device) for _ in range(len(part) - len(self._streams))]
        for index, (stage, passes) in enumerate(_in_launch_order(part)):
            own = self._streams[index]
            own.wait_event(begun)
            awaited = [name for name in stage.wiring.reads if name in written]
            for step in passes:
                reads = stage.wiring.reads if step.reads is None else step.reads
                for name in [name for name in awaited if name in reads]:
                    own.wait_event(written[name])
                    awaited.remove(name)
                with wp.ScopedStream(own, sync_enter=False):
                    step.launch(None)
            done = own.record_event()
            written.update(dict.fromkeys(stage.wiring.writes, done))
            stream.wait_event(done)


@dataclasses.dataclass(frozen=True)
class Segment:
    """Stages of a frame that run on the host, or that are captured together as one graph."""

    on_host: bool
    """True if the passes run on the host."""
    part: list[Step]
    """Stages with their passes in this segment."""
    key: tuple[int, ...]
    """Ids of its passes."""


def _make_marks(device: Any) -> tuple[Any, Any]:
    return wp.Event(device, enable_timing=True), wp.Event(device, enable_timing=True)


def _ids(steps: list[Pass]) -> tuple[int, ...]:
    return tuple(map(id, steps))


def _in_launch_order(part: list[Step]) -> list[Step]:
    """Return the stages in launch order: each after those named by its ``runs_after``, but before its own readers."""
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
    """Return the stages in order, divided into segments that are captured as graphs and segments on the host."""
    steps = [(step.on_host, stage, step) for stage, passes in due for step in passes]
    steps.sort(key=lambda one: not one[2].beforehand)
    parts = [
        (on_host, [(stage, [step for _, _, step in own]) for stage, own in itertools.groupby(stretch, lambda s: s[1])])
        for on_host, stretch in itertools.groupby(steps, lambda s: s[0])
    ]
    return [Segment(on_host, part, _ids([step for _, own in part for step in own])) for on_host, part in parts]


def _find_readers(stages: list[Stage]) -> dict[str, list[str]]:
    """Return, for each stage, the names of the stages that read its output."""
    return {
        stage.name: [
            later.name for later in stages[index + 1 :] if not set(stage.wiring.writes).isdisjoint(later.wiring.reads)
        ]
        for index, stage in enumerate(stages)
    }
