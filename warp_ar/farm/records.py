"""What passes between a driver and its workers beside jobs."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from warp_ar.farm.jobs import JobFile

OPENCV_THREADS = 1
"""Of a worker: with more, to look for a marker takes more processor time and is no sooner done."""


@dataclasses.dataclass(frozen=True)
class Context:
    """What all jobs of a run share."""

    jobs: JobFile
    folder: Path
    """Of the run."""
    device: str
    """``cpu`` or ``cuda:N``."""
    worker: int = 0
    """Number of the worker."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of a job."""

    state: str
    """``done``, ``failed``, or ``full``: the disk is."""
    values: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Of the manifest's line."""
    reason: str = ""
    """What went wrong, on one line."""
