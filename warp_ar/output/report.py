"""Records of a run: the report and the table of stages."""

from __future__ import annotations

import statistics
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import warp as wp
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from warp_ar.engine.graph import Plan
from warp_ar.engine.pipeline import TRACK, Result
from warp_ar.errors import printable
from warp_ar.stages import STAGES

# Frames left out of medians, because caches fill and modules load.
WARM_UP = 3


class RunLog:
    """Log of poses and timings, frame by frame."""

    def __init__(self, pipeline: Any) -> None:
        """Begin a log without frames.

        Args:
            pipeline: ``Pipeline`` that lights the frames, or ``AutoPipeline``. The report also contains the latter's
                ``status``: the methods that it chose, with expected and measured times.
        """
        self._pipeline = pipeline
        self._frames: list[dict[str, Any]] = []
        self._skipped: Counter[str] = Counter()
        self._left_out: dict[str, Counter[str]] = {}
        self._steps: list[dict[str, float]] = []
        self._times: list[float] = []
        self.never_posed = pipeline.plan.needs("pose")
        """True while a pose was needed and none has been found."""

    @property
    def count(self) -> int:
        """Return the number of frames so far."""
        return len(self._frames)

    @property
    def fps(self) -> float:
        """Return frames per second since the first frame was done; 0 before the second."""
        passed = self._times[-1] - self._times[0] if self._times else 0.0
        return (self.count - 1) / passed if passed > 0.0 else 0.0

    def add(self, result: Result, *, decode_ms: float | None = None, encode_ms: float | None = None) -> None:
        """Add one frame's result.

        Args:
            result: Result of the frame.
            decode_ms: Time of the source, milliseconds.
            encode_ms: Time of the sink, milliseconds.
        """
        around = {"decode": decode_ms, **result.steps, "encode": encode_ms}
        self._steps.append({name: value for name, value in around.items() if value is not None})
        self._times = [*self._times[:1], time.perf_counter()]
        self.never_posed = self.never_posed and result.pose is None
        stages, left_out = {}, {}
        for name, timing in result.stages.items():
            if timing.left_out is not None:
                left_out[name] = timing.left_out
                self._left_out.setdefault(name, Counter())[timing.left_out] += 1
            elif timing.skipped:
                self._skipped[name] += 1
            if not timing.skipped:
                stages[name] = round(timing.milliseconds, 4)
        pose = result.pose and {"R": result.pose.rotation.tolist(), "t": result.pose.translation.tolist()}
        frame = {"index": self.count, "pose": pose, "stages": stages}
        self._frames.append({**frame, "left_out_of_this_frame": left_out} if left_out else frame)

    def median_ms(self, stage: str) -> float | None:
        """Return the median milliseconds of ``stage`` over the frames in which it ran, without warm-up if possible."""
        return _medians([frame["stages"] for frame in self._frames]).get(stage)

    def skipped(self, stage: str) -> int:
        """Return the number of frames in which ``stage`` was skipped because its inputs had not changed."""
        return self._skipped[stage]

    def left_out(self, stage: str) -> Mapping[str, int]:
        """Return the number of frames without ``stage`` because it could change no pixel, by reason."""
        return self._left_out.get(stage, {})

    def steps(self) -> dict[str, float]:
        """Return median milliseconds of each step of a frame; steps of different frames run in parallel."""
        return _medians(self._steps)

    def report(self) -> dict[str, Any]:
        """Return the run's record as plain data for JSON."""
        plan, steps = self._pipeline.plan, self.steps()
        chooses = getattr(self._pipeline, "status", None)
        recovered = self._pipeline.arrays.get("recover_status")
        return {
            "device": str(self._pipeline.device),
            "warp": wp.__version__,
            "quality": self._pipeline.quality.name if chooses is None else "auto",
            "fps": round(self.fps, 3),
            **({} if chooses is None else {"auto": chooses()}),
            "steps_ms": {name: round(milliseconds, 3) for name, milliseconds in steps.items()},
            "critical_path": max(steps, key=steps.__getitem__, default=None),
            "frames": self._frames,
            "stages_run": stage_names(plan),
            "recovered": None if recovered is None else recovered(),
            "stages_left_out": [{"stage": stage, "reason": reason} for stage, reason in left_out(plan)],
        }


def _medians(frames: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return medians by name, without warm-up frames if there are enough frames."""
    frames = frames[WARM_UP:] if len(frames) > 2 * WARM_UP else frames
    names = dict.fromkeys(name for frame in frames for name in frame)
    return {name: statistics.median(frame[name] for frame in frames if name in frame) for name in names}


def stage_names(plan: Plan) -> list[str]:
    """Return the names of all running stages, including the host's tracking, in order."""
    return [TRACK] * plan.needs("pose") + [stage.name for stage, _ in plan.stages]


def left_out(plan: Plan) -> list[tuple[str, str]]:
    """Return (stage, reason) of all stages that do not run, including the host's tracking."""
    tracking = [] if plan.needs("pose") else [(TRACK, "nothing reads the camera's pose")]
    return [*tracking, *plan.left_out]


def _state(stage: str, log: RunLog | None) -> str:
    """Return a description of how often a stage of the plan ran."""
    if log is None:
        return "runs"
    skipped, left_out = log.skipped(stage), sum(log.left_out(stage).values())
    words = [f"skipped {skipped}x"] * bool(skipped) + [f"left out {left_out}x"] * bool(left_out)
    if log.count in (skipped, left_out) and len(words) == 1:
        return words[0].split()[0] if skipped else "left out"
    return ", ".join(words) or "runs"


def print_plan(plan: Plan, log: RunLog | None = None) -> None:
    """Print the table of stages: running ones, with ``log`` their median times, and stages left out with the reason."""
    request = plan.request
    name = escape(printable(request.scene.name))
    table = Table(title=f"{name}, quality {request.quality.name}, {request.size[0]}x{request.size[1]}")
    table.add_column("stage")
    table.add_column("method")
    table.add_column("state")
    table.add_column("median ms", justify="right")
    table.add_column("what it does, or why it is left out")
    summaries = {stage.name: stage.summary for stage in STAGES} | {TRACK: "finds the marker and the camera's pose"}
    methods = {stage.name: stage.method_for(plan.features) for stage, _ in plan.stages} | {TRACK: "default"}
    for name in stage_names(plan):
        milliseconds = log.median_ms(name) if log is not None else None
        time_text = "" if milliseconds is None else f"{milliseconds:.2f}"
        table.add_row(name, methods[name], _state(name, log), time_text, summaries[name])
        for reason, frames in (log.left_out(name) if log is not None else {}).items():
            table.add_row("", "", "", "", f"left out of {frames} frames: {reason}", style="dim")
    for name, reason in left_out(plan):
        table.add_row(name, "", "left out", "", reason, style="dim")
    if plan.features.balls:
        table.caption = f"{plan.features.balls[0].upper()}{plan.features.balls[1:]}."
    Console().print(table)
