"""Where a run stands, from its folder alone: a driver need not be there."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

from warp_ar.errors import printable
from warp_ar.farm.manifest import PROGRESS, Manifest, is_locked, load_run, read_kept

STALE_SECONDS = 15.0
"""Since the last word of a driver whose lock cannot be asked for, after which it is taken to be gone."""


def read_status(folder: Path) -> dict[str, Any]:
    """What is done, what has failed, and what is being done.

    Raises:
        UsageError: There is no run.
        RunError: It cannot be read.
    """
    data, version = load_run(folder)
    manifest = Manifest(folder, write=False)
    progress = read_kept(folder / PROGRESS) or {}
    if not _is_progress(progress):
        progress = {}
    kinds: dict[str, int] = {}
    for key in manifest.done:
        kind = key.rsplit("/", 1)[1].split("-")[0]
        kinds[kind] = kinds.get(kind, 0) + 1
    return {
        "version": version,
        "clips": len(data["clip"]),
        "done": kinds,
        "frames": sum(
            int(record.get("frames") or 0)
            for key, record in manifest.done.items()
            if key.rsplit("/", 1)[1].startswith(("segment", "variation"))
        ),
        "bytes": sum(int(record.get("bytes") or 0) for record in manifest.done.values()),
        "failed": manifest.failed,
        "progress": progress,
        "running": _is_running(folder, progress),
    }


def _is_progress(told: dict[str, Any]) -> bool:
    """Whether a driver's word of where things stand is whole."""

    def is_number(value: object) -> bool:
        return isinstance(value, int | float) and math.isfinite(value)

    workers = told.get("workers")
    numbers = [told.get(name) for name in ("time", "jobs_open", "jobs_known", "clips_surveyed")]
    if not isinstance(workers, list) or not all(map(is_number, numbers)):
        return False
    left = told.get("seconds_left")
    return (left is None or is_number(left)) and all(
        isinstance(worker, dict)
        and isinstance(worker.get("job"), str | None)
        and is_number(worker.get("frames"))
        and is_number(worker.get("fps"))
        and "device" in worker
        for worker in workers
    )


def _is_running(folder: Path, progress: dict[str, Any]) -> bool:
    """Whether a driver is at work: by its lock, and where that cannot be asked for by when it was last heard of."""
    locked = is_locked(folder)
    if locked is None:
        return not progress.get("ended") and abs(time.time() - float(progress.get("time", 0))) < STALE_SECONDS
    return locked and bool(progress) and not progress.get("ended")


def status_lines(folder: Path, status: dict[str, Any]) -> list[str]:
    """The same in words."""
    done = ", ".join(f"{count} {kind}{'s' if count != 1 else ''}" for kind, count in sorted(status["done"].items()))
    lines = [f"{folder}: {status['clips']} clips; done: {done or 'nothing yet'}"]
    lines.append(
        f"{status['frames']} frames lit, {status['bytes'] / 1e6:.1f} MB written, {len(status['failed'])} jobs failed"
    )
    lines += [f"failed: {key}: {why}" for key, why in sorted(status["failed"].items())[:20]]
    if len(status["failed"]) > 20:
        lines.append(f"and {len(status['failed']) - 20} more; all are in {folder / 'manifest.jsonl'}")
    progress = status["progress"]
    if not status["running"]:
        nothing = progress.get("ended") and not progress["jobs_open"]
        hint = "nothing that is known is open" if nothing else f"go on with: farm resume {folder}"
        return [printable(line) for line in (*lines, f"no driver is at work; {hint}")]
    lines.append(
        f"{progress['jobs_open']} of {progress['jobs_known']} jobs open, {progress['clips_surveyed']} clips surveyed"
    )
    for number, worker in enumerate(progress["workers"]):
        what = f"{worker['job']}, frame {worker['frames']}" if worker["job"] else "waiting"
        lines.append(f"worker {number} on {worker['device']}: {worker['fps']:.1f} frames/s, {what}")
    left = progress.get("seconds_left")
    lines.append("time left: too early to say" if left is None else f"time left: {words_of_seconds(left)}")
    return [printable(line) for line in lines]


def words_of_seconds(seconds: float) -> str:
    """A duration."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
