"""What a farm of many GPUs would take, of a few figures that one GPU and its cores were measured by.

    rate of a GPU = min(1 / kernel, cores / processor)              frames a second; the smaller one is what bounds it
    job           = start + frames of a segment workers / rate      seconds of one of the workers that share a GPU
    lighting      = ceil(jobs / (GPUs workers)) job                 whole rounds: the last of equal jobs is waited for
    at once       = min(workers, ceil(clips / GPUs))                clips that are surveyed by the workers of a GPU
    survey        = ceil(clips / (GPUs workers)) frames max(survey, at once survey processor / cores)
                                                                    a clip is surveyed in order, by one worker

Nothing of a cluster's own is in it: no queue, no file system. What these would have to carry stands beside it: bytes a
second that are written, and jobs a second that the driver notes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from warp_ar.errors import UsageError
from warp_ar.files import parse_toml, read_text

GPUS: Final = (1, 8, 32, 128, 1000)
"""For how many a plan is made, unless others are asked for."""
_WORK_KEYS: Final = ("name", "clips", "frames", "variations", "segment_frames")


@dataclasses.dataclass(frozen=True)
class Figures:
    """What was measured, of frames of one kind."""

    kernel_ms: float
    """Milliseconds of a GPU for a frame."""
    processor_ms: float
    """Milliseconds of one core for a frame: all that a worker does there, encoding included."""
    survey_ms: float
    """Milliseconds of a frame of a survey, by the clock, where a worker has all cores."""
    survey_processor_ms: float
    """Milliseconds of one core for a frame of a survey."""
    job_s: float
    """Seconds of a job beside its frames: pipeline, kernels to load, files to open."""
    frame_bytes: float
    """That are written for a frame."""
    cores: float
    """Of a GPU."""
    workers: float
    """That share a GPU."""


@dataclasses.dataclass(frozen=True)
class Task:
    """What is to be lit."""

    name: str
    clips: int
    frames: int
    """Of a clip, or of each variation of it."""
    variations: int
    """Of a clip; 0: it is lit once, in segments."""
    segment_frames: int
    figures: Figures
    """The file's own, but for what the task says otherwise."""

    @property
    def jobs(self) -> int:
        """Segments or variations."""
        return self.clips * (self.variations or -(-self.frames // self.segment_frames))

    @property
    def lit(self) -> int:
        """Frames that are written."""
        return self.clips * self.frames * max(self.variations, 1)


@dataclasses.dataclass(frozen=True)
class Row:
    """What a number of GPUs would take."""

    gpus: int
    survey_s: float
    lighting_s: float
    bound: str
    """``GPU`` or ``cores``, whichever is busy while frames are lit; ``rounds`` where most workers have no job."""
    frames_per_s: float
    """While frames are lit."""
    bytes_per_s: float
    jobs_per_s: float

    @property
    def seconds(self) -> float:
        """Of the whole: segments wait for their clip's survey."""
        return self.survey_s + self.lighting_s


def read_figures(path: str | Path) -> tuple[str, list[Task]]:
    """Figures of a TOML file: where they come from, and the tasks that it names.

    Raises:
        UsageError: The file cannot be read, or a key is unknown, missing or no positive number.
    """
    data = parse_toml(read_text(path, UsageError, expected="TOML"), str(path), UsageError)
    tasks, source = data.pop("work", []), data.pop("source", "")
    own = [field.name for field in dataclasses.fields(Figures)]
    _check(f"{path}", data, own, own)
    if not isinstance(tasks, list) or not tasks:
        raise UsageError(f"{path}: [[work]] is missing: name at least one, with clips, frames and segment_frames")
    found = []
    for index, task in enumerate(tasks):
        label = f"{path}: work[{index}]"
        _check(label, {k: v for k, v in task.items() if k != "name"}, (*own, *_WORK_KEYS), ("clips", "frames"))
        figures = Figures(**{name: float(task.get(name, data[name])) for name in own})
        clips, frames, variations = (int(task.get(key, 0)) for key in ("clips", "frames", "variations"))
        segment = int(task.get("segment_frames", frames))
        found.append(Task(str(task.get("name", f"work {index + 1}")), clips, frames, variations, segment, figures))
    return str(source), found


def _check(label: str, data: dict[str, Any], known: Sequence[str], needed: Sequence[str]) -> None:
    """Raise UsageError unless every key is known, none is missing, and every value is a positive number."""
    for key, value in data.items():
        if key not in known:
            raise UsageError(f"{label}: {key} is unknown; expected {', '.join(known)}")
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < math.inf:
            raise UsageError(f"{label}: {key} = {value!r}: expected a positive number")
    for key in needed:
        if key not in data:
            raise UsageError(f"{label}: {key} is missing; expected a positive number")


def scale_task(task: Task, gpus: int) -> Row:
    """What a task would take on so many GPUs, each with its cores and workers."""
    own = task.figures
    by_gpu, by_cores = 1e3 / own.kernel_ms, 1e3 * own.cores / own.processor_ms
    rate = min(by_gpu, by_cores)
    slots = gpus * own.workers
    size = task.frames if task.variations else min(task.segment_frames, task.frames)
    job = own.job_s + size * own.workers / rate
    lighting = math.ceil(task.jobs / slots) * job
    at_once = min(own.workers, math.ceil(task.clips / gpus))
    looked = max(own.survey_ms, at_once * own.survey_processor_ms / own.cores)
    survey = math.ceil(task.clips / slots) * task.frames * looked / 1e3
    bound = "rounds" if task.jobs < slots / 2 else "GPU" if by_gpu < by_cores else "cores"
    per_s = task.lit / lighting
    return Row(gpus, survey, lighting, bound, per_s, per_s * own.frame_bytes, task.jobs / lighting)


def table_of(task: Task, gpus: Sequence[int] = GPUS) -> str:
    """A task on several numbers of GPUs, as a table in Markdown."""
    lines = [
        f"**{task.name}**: {task.lit:,} frames in {task.jobs:,} jobs",
        "",
        "| GPUs | survey | lighting | together | frames a second | bound by | written | jobs a second |",
        "| --: | --: | --: | --: | --: | --- | --: | --: |",
    ]
    for row in (scale_task(task, count) for count in gpus):
        lines.append(
            f"| {row.gpus:,} | {_time(row.survey_s)} | {_time(row.lighting_s)} | {_time(row.seconds)} | "
            f"{row.frames_per_s:,.0f} | {row.bound} | {row.bytes_per_s / 1e6:,.0f} MB/s | {_count(row.jobs_per_s)} |"
        )
    return "\n".join(lines)


def _count(number: float) -> str:
    """A number as a table has it."""
    return f"{number:,.0f}" if number >= 10.0 else f"{number:.2g}"


def _time(seconds: float) -> str:
    """Seconds, minutes or hours, whichever reads best."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"
