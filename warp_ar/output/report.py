"""What happened while frames ran: the report and the table of stages."""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import warp as wp
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from warp_ar.engine.graph import Plan
from warp_ar.engine.pipeline import TRACK, Result
from warp_ar.errors import printable
from warp_ar.scene import Pose
from warp_ar.stages import STAGES

# Frames left out of medians: caches fill and modules load.
WARM_UP = 3


@runtime_checkable
class Choosing(Protocol):
    """One that changes its quality while frames run, to keep a budget."""

    def status(self) -> Mapping[str, Any]:
        """What it chose, and why."""


class RunLog:
    """Collects poses and timings, frame by frame."""

    def __init__(self, pipeline: Any) -> None:
        """``pipeline`` is a ``Pipeline``, or what holds one and changes it (``Choosing``)."""
        self._pipeline = pipeline
        self._frames: list[dict[str, Any]] = []
        self._skipped: dict[str, int] = {}
        self._left_out: dict[str, dict[str, int]] = {}
        self._steps: list[dict[str, float]] = []
        self._first = 0.0
        self._last = 0.0
        self.never_posed = pipeline.plan.needs("pose")
        """True while a pose was needed and none has been found."""

    @property
    def count(self) -> int:
        """Frames so far."""
        return len(self._frames)

    @property
    def fps(self) -> float:
        """Frames per second since the first frame was done; 0 before the second."""
        return (self.count - 1) / (self._last - self._first) if self.count > 1 and self._last > self._first else 0.0

    def add(self, result: Result, *, decode_ms: float | None = None, encode_ms: float | None = None) -> None:
        """Note one frame's result.

        Args:
            result: What it became.
            decode_ms: What its source took.
            encode_ms: What its sink took.
        """
        around = {"decode": decode_ms, **result.steps, "encode": encode_ms}
        self._steps.append({name: value for name, value in around.items() if value is not None})
        self._last = time.perf_counter()
        if not self._frames:
            self._first = self._last
        if result.pose is not None:
            self.never_posed = False
        stages = {name: round(timing.milliseconds, 4) for name, timing in result.stages.items() if not timing.skipped}
        for name, timing in result.stages.items():
            self._skipped[name] = self._skipped.get(name, 0) + (timing.skipped and timing.left_out is None)
            if timing.left_out is not None:
                reasons = self._left_out.setdefault(name, {})
                reasons[timing.left_out] = reasons.get(timing.left_out, 0) + 1
        frame = {"index": self.count, "pose": _pose_record(result.pose), "stages": stages}
        left_out = {name: timing.left_out for name, timing in result.stages.items() if timing.left_out is not None}
        self._frames.append({**frame, "left_out_of_this_frame": left_out} if left_out else frame)

    def median_ms(self, stage: str) -> float | None:
        """Median milliseconds of ``stage`` over the frames in which it ran, warm-up excluded where there is enough."""
        frames = self._frames[WARM_UP:] if self.count > 2 * WARM_UP else self._frames
        times = [frame["stages"][stage] for frame in frames if stage in frame["stages"]]
        return statistics.median(times) if times else None

    def skipped(self, stage: str) -> int:
        """Frames in which ``stage`` was skipped because nothing that it reads had changed."""
        return self._skipped.get(stage, 0)

    def left_out(self, stage: str) -> dict[str, int]:
        """Frames of which ``stage`` was left out because it could change no pixel of them, by reason."""
        return self._left_out.get(stage, {})

    def steps(self) -> dict[str, float]:
        """Median milliseconds of each step of a frame's way; different frames take different steps side by side."""
        frames = self._steps[WARM_UP:] if len(self._steps) > 2 * WARM_UP else self._steps
        names = dict.fromkeys(name for frame in frames for name in frame)
        return {name: statistics.median(frame[name] for frame in frames if name in frame) for name in names}

    def _recovered(self) -> Any:
        """What the light's last estimate rests on; None where the plan has none."""
        status = self._pipeline.arrays.get("recover_status")
        return None if status is None else status()

    def report(self) -> dict[str, Any]:
        """The run as plain data, ready for JSON."""
        plan = self._pipeline.plan
        return {
            "device": str(self._pipeline.device),
            "warp": wp.__version__,
            "quality": "auto" if isinstance(self._pipeline, Choosing) else self._pipeline.quality.name,
            "fps": round(self.fps, 3),
            **({"auto": self._pipeline.status()} if isinstance(self._pipeline, Choosing) else {}),
            "steps_ms": {name: round(milliseconds, 3) for name, milliseconds in self.steps().items()},
            "critical_path": max(self.steps(), key=self.steps().__getitem__, default=None),
            "frames": self._frames,
            "stages_run": stage_names(plan),
            "recovered": self._recovered(),
            "stages_left_out": [{"stage": stage, "reason": reason} for stage, reason in left_out(plan)],
        }


def _pose_record(pose: Pose | None) -> dict[str, Any] | None:
    return None if pose is None else {"R": pose.rotation.tolist(), "t": pose.translation.tolist()}


def stage_names(plan: Plan) -> list[str]:
    """Names of what runs, the host's tracking included, in order."""
    return [TRACK] * plan.needs("pose") + [stage.name for stage, _ in plan.stages]


def left_out(plan: Plan) -> list[tuple[str, str]]:
    """(stage, reason) of all that does not run, the host's tracking included."""
    tracking = [] if plan.needs("pose") else [(TRACK, "nothing reads the camera's pose")]
    return [*tracking, *plan.left_out]


def _state(stage: str, log: RunLog | None) -> str:
    """Whether a stage of the plan ran in all frames."""
    if log is None:
        return "runs"
    skipped, left_out = log.skipped(stage), sum(log.left_out(stage).values())
    words = [f"skipped {skipped}x"] * bool(skipped) + [f"left out {left_out}x"] * bool(left_out)
    if log.count in (skipped, left_out) and len(words) == 1:
        return words[0].split()[0] if skipped else "left out"
    return ", ".join(words) or "runs"


def print_plan(plan: Plan, log: RunLog | None = None) -> None:
    """Print the table of stages: what runs, with ``log`` its median times too, and what is left out and why."""
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
