"""Persistent record of a run, so that after a crash nothing is lost or repeated.

``manifest.jsonl`` has a line for each job that is done or has failed for good, and for each failed attempt. A line is
appended by one write and synchronised to the disk. An incomplete line after a crash is removed when the file is opened.
A job writes its outputs to a temporary folder, which is renamed when they are complete. The outputs include a
``record.json`` that names the job. If a crash leaves complete outputs without a line, the line is added. If the outputs
of a line are missing, the job is repeated.

Only one driver at a time works on a run: it locks the folder, and the lock ends with its process.
"""

from __future__ import annotations

import collections
import contextlib
import errno
import hashlib
import json
import math
import os
import secrets
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import filelock

from warp_ar.errors import UsageError, WarpArError, counted, printable, reason
from warp_ar.files import parse_json, read_bytes, take_name, write_whole

MANIFEST, RUN, LOCK, RECORD = "manifest.jsonl", "run.json", "lock", "record.json"
ASIDE = ".aside"
"""Folder of the temporary folders with incomplete outputs."""
_NUMBERS = ("frames", "bytes", "length", "jobs", "seconds", "ended", "worker")
"""Numeric values that the line of a finished job may have."""
NO_SPACE = (errno.ENOSPC, errno.EDQUOT)
"""Error numbers of a full disk."""

LOCK_SECONDS = 1.0
"""Longest time in seconds that a driver waits for the lock; the command ``status`` holds it for a moment."""


class RunError(WarpArError):
    """Error after which a run cannot go on."""


class Manifest:
    """Manifest of a run: its file, and the states of the jobs."""

    def __init__(self, folder: Path) -> None:
        """Read the existing lines of the run in a folder.

        Raises:
            RunError: The manifest cannot be read, or a line before the last is damaged.
        """
        self.path = folder / MANIFEST
        self.done: dict[str, dict[str, Any]] = {}
        """Records of finished jobs, by their keys."""
        self.failed: dict[str, str] = {}
        """Reasons of jobs that have failed for good."""
        self.tries: dict[str, int] = {}
        """Number of failed attempts of jobs that are neither done nor failed."""
        data = _kept(self.path) or b""
        self._size = data.rfind(b"\n") + 1
        for number, line in enumerate(data[: self._size].splitlines(), 1):
            try:
                self._take(parse_line(line))
            except (ValueError, RunError) as error:
                raise RunError(
                    f"{self.path}: line {number} is damaged ({reason(error)}); remove the line and resume"
                ) from error

    def _take(self, line: dict[str, Any]) -> None:
        key = line["job"]
        match line["state"]:
            case "done":
                self.done[key] = {name: line[name] for name in (*_NUMBERS, "inputs") if name in line}
                self.failed.pop(key, None)
            case "failed":
                self.failed[key] = line["reason"]
            case "try":
                self.tries[key] = self.tries.get(key, 0) + 1
            case "again":
                self.failed.pop(key, None)
                self.tries.pop(key, None)
                self.done.pop(key, None)

    def add(self, state: str, key: str, **values: Any) -> None:
        """Append a line, after removing an incomplete one.

        Args:
            state: ``done``, ``failed`` (for good), ``try`` (an attempt has failed) or ``again`` (the job is repeated).
            key: Key of the job.
            values: Further values of the line.

        Raises:
            RunError: The line cannot be written; no complete line is lost.
        """
        line = {"state": state, "job": key, **values}
        data = (json.dumps(line) + "\n").encode()
        try:
            with open(self.path, "ab", buffering=0) as file:
                file.truncate(self._size)
                if file.write(data) < len(data):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.fsync(file.fileno())
        except OSError as error:
            raise RunError(f"{self.path} cannot be written: {reason(error)}") from error
        self._size += len(data)
        self._take(line)


def parse_line(line: bytes) -> dict[str, Any]:
    """Return a line of a manifest as data.

    Raises:
        RunError: The line is not JSON.
        ValueError: The line is of no job.
    """
    told = parse_json(line.decode(), "it", RunError)
    if not isinstance(told, dict) or not isinstance(told.get("job"), str) or "/" not in told["job"]:
        raise ValueError("no line of a job")
    if told.get("state") not in ("done", "failed", "try", "again"):
        raise ValueError(f"state is {told.get('state')!r}")
    if told["state"] == "failed" and not isinstance(told.get("reason"), str):
        raise ValueError("no reason")
    for name in _NUMBERS:
        if not isinstance(told.get(name), int | float | None) or not math.isfinite(told.get(name) or 0):
            raise ValueError(f"{name} is no number")
    return told


def _kept(path: Path) -> bytes | None:
    """Return the content of one of a run's own files; None if it does not exist.

    Raises:
        RunError: The file is not regular, is too large, or cannot be read.
    """
    return read_bytes(path, "run_bytes", RunError) if os.path.lexists(path) else None


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Context in which this process holds the lock of a run; incomplete outputs of dead workers are removed.

    Raises:
        RunError: Another driver holds the lock, or the folder's disk has no locks.
    """
    lock = filelock.FileLock(folder / LOCK, timeout=LOCK_SECONDS, mode=0o666)
    try:
        lock.acquire()
    except filelock.Timeout as error:
        raise RunError(f"{folder} is being worked on by another driver; see: farm status {folder}") from error
    except (OSError, NotImplementedError) as error:
        raise RunError(
            f"{folder / LOCK} cannot be locked: {reason(error)}; a run needs a folder on a disk that can"
        ) from error
    try:
        _clear_aside(folder)
        yield
    finally:
        _clear_aside(folder)
        lock.release()


def is_locked(folder: Path) -> bool:
    """Return True if a driver works on a run; False if the folder cannot be examined."""
    try:
        if (folder / LOCK).exists():
            filelock.FileLock(folder / LOCK, timeout=0, mode=0o666).acquire().lock.release()
    except (OSError, NotImplementedError) as error:
        return isinstance(error, filelock.Timeout)
    return False


def begin_run(folder: Path, data: dict[str, Any], version: str) -> None:
    """Make a run's folder, and write the jobs and the program's version.

    Args:
        folder: The folder, new or empty.
        data: Content of the job file.
        version: Version of the program.

    Raises:
        UsageError: The folder is not empty.
        RunError: The folder cannot be written.
    """
    try:
        if folder.exists() and not folder.is_dir():
            raise UsageError(f"--output {folder} is no folder; name a new one")
        folder.mkdir(parents=True, exist_ok=True)
        if RUN in (left := os.listdir(folder)):
            raise UsageError(f"{folder} holds a run already; go on with: farm resume {folder}, or name another folder")
        if left:
            raise UsageError(f"{folder} is not empty (it holds {left[0]}); name a new folder")
        text = json.dumps({"program": "warp_ar", "version": version, "jobs": data})
        write_whole(folder / RUN, text.encode())
    except OSError as error:
        raise RunError(f"{folder} cannot be written: {reason(error)}") from error


def load_run(folder: Path) -> tuple[dict[str, Any], str]:
    """Return the content of a run's job file, and the version of the program that began the run.

    Raises:
        UsageError: The folder has no run.
        RunError: The run is damaged.
    """
    path = folder / RUN
    kept = _kept(path)
    if kept is None:
        raise UsageError(
            f"{folder} holds no run ({RUN} is missing); begin one with: farm run JOBS.toml --output {folder}"
        )
    data = parse_json(kept.decode(errors="replace"), str(path), RunError)
    jobs = data.get("jobs") if isinstance(data, dict) else None
    if not isinstance(jobs, dict) or not isinstance(jobs.get("clip"), list) or "version" not in data:
        raise RunError(f"{path} is damaged: expected a version, and jobs with their clips")
    return jobs, str(data["version"])


def _clear_aside(folder: Path) -> None:
    shutil.rmtree(folder / ASIDE, ignore_errors=True)


@contextlib.contextmanager
def aside(folder: Path, token: str) -> Iterator[Path]:
    """Yield an empty temporary folder for outputs; on exit it is removed unless it was renamed.

    Args:
        folder: Folder of the run.
        token: Beginning of the temporary folder's name.
    """
    path = folder / ASIDE / f"{token}.{secrets.token_hex(4)}"
    path.mkdir(parents=True)
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


def publish(part: Path, place: Path, key: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Move a folder of outputs to its final path.

    If outputs of another worker for this job are there already, they stay, because they are equal.

    Args:
        part: Folder of outputs, on the disk of the final path.
        place: Final path.
        key: Key of the job.
        values: Further values of the job's line in the manifest. They are written to the record, so that a later driver
            can add the line if this one dies before it does.

    Returns:
        The values, the key, the size in bytes, and a digest of names and contents.
    """
    size, digest = 0, hashlib.sha256()
    for path in sorted(path for path in part.rglob("*") if path.is_file()):
        digest.update(path.relative_to(part).as_posix().encode() + b"\0")
        with open(path, "r+b") as stream:  # Windows synchronises only writable files
            digest.update(hashlib.file_digest(stream, "sha256").digest())
            os.fsync(stream.fileno())
        size += path.stat().st_size
    told = {**values, "job": key, "bytes": size, "sha256": digest.hexdigest()}
    (part / RECORD).write_text(json.dumps(told), encoding="utf-8")
    place.parent.mkdir(parents=True, exist_ok=True)
    try:
        take_name(part, place)
    except OSError as error:
        if error.errno not in (errno.EEXIST, errno.ENOTEMPTY) or record_at(place, key) is None:
            raise
    _sync_folder(place.parent)
    return told


def publish_files(part: Path, place: Path) -> int:
    """Move the content of a folder to the folder of ``place``, which is moved last; return the size of ``place``.

    Existing files and folders are replaced.
    """
    place.parent.mkdir(parents=True, exist_ok=True)
    for path in sorted(part.iterdir(), key=lambda path: path.name == place.name):
        if path.is_dir():
            shutil.rmtree(place.with_name(path.name), ignore_errors=True)
        else:
            with open(path, "r+b") as stream:
                os.fsync(stream.fileno())
        take_name(path, place.with_name(path.name))
    _sync_folder(place.parent)
    return place.stat().st_size


def _sync_folder(path: Path) -> None:
    with contextlib.suppress(OSError):
        file = os.open(path, os.O_RDONLY)
        try:
            os.fsync(file)
        finally:
            os.close(file)


def record_at(place: Path, key: str) -> dict[str, Any] | None:
    """Return the record in a folder of outputs; None if it has none of the job with this key."""
    with contextlib.suppress(RunError, ValueError):
        told = parse_json((_kept(place / RECORD) or b"").decode(), str(place), RunError)
        return told if isinstance(told, dict) and told.get("job") == key else None
    return None


def bytes_of(place: Path) -> int | None:
    """Return the size of a file, or of all files in a folder except its record; None if neither exists."""
    try:
        if not place.is_dir():
            return place.stat().st_size
        return sum(path.stat().st_size for path in place.rglob("*") if path.is_file() and path != place / RECORD)
    except OSError:
        return None


def describe_inputs(paths: Iterable[Path]) -> dict[str, list[Any]]:
    """Return size, modification time in nanoseconds and SHA-256 of files, and of files in folders, by their paths."""
    files = [file for path in paths for file in (sorted(path.iterdir()) if path.is_dir() else [path])]
    return {str(file): [*_stamp(file), _digest(file)] for file in files if file.is_file()}


def changed_input(inputs: Mapping[str, Sequence[Any]]) -> str | None:
    """Return a message that names a changed file; None if all are unchanged.

    A file is read only if its size is unchanged and its modification time differs.

    Args:
        inputs: Result of ``describe_inputs`` for the files.
    """
    for name, (size, changed, digest) in inputs.items():
        try:
            now = _stamp(Path(name))
            if now[0] != size or (now[1] != changed and _digest(Path(name)) != digest):
                return f"{name} is not the file"
        except OSError:
            return f"{name} is gone: it is a file"
    return None


def _stamp(path: Path) -> tuple[int, int]:
    found = path.stat()
    return found.st_size, found.st_mtime_ns


def _digest(path: Path) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


PACE = 50
"""Number of the latest jobs that determine the remaining time."""


def read_status(folder: Path) -> dict[str, Any]:
    """Return the progress of a run, as data for JSON: jobs by state, frames, bytes and time left.

    Raises:
        UsageError: The folder has no run.
        RunError: The run cannot be read.
    """
    data, version = load_run(folder)
    manifest = Manifest(folder)
    kinds = collections.Counter(_kind(key) for key in manifest.done)
    lit = [line for key, line in manifest.done.items() if _kind(key) in ("segment", "variation")]
    failed = sum(_kind(key) in ("segment", "variation") for key in manifest.failed)
    known = sum(int(line.get("jobs") or 0) for line in manifest.done.values())
    left = max(known - len(lit) - failed, 0)
    ended = sorted(float(line.get("ended") or 0.0) for line in lit)[-PACE:]
    return {
        "version": version,
        "clips": len(data["clip"]),
        "done": dict(kinds),
        "frames": sum(int(line.get("frames") or 0) for line in lit),
        "bytes": sum(int(line.get("bytes") or 0) for line in manifest.done.values()),
        "failed": manifest.failed,
        "running": is_locked(folder),
        "jobs_known": known,
        "jobs_open": left,
        "seconds_left": round(left * (ended[-1] - ended[0]) / (len(ended) - 1), 1) if len(ended) > 1 else None,
    }


def _kind(key: str) -> str:
    return key.rsplit("/", 1)[1].split("-")[0]


def status_lines(folder: Path, status: dict[str, Any]) -> list[str]:
    """Return the result of ``read_status`` in words, one string per line."""
    counts = ", ".join(counted(count, kind) for kind, count in sorted(status["done"].items()))
    failed = counted(len(status["failed"]), "job")
    lines = [
        f"{folder}: {status['clips']} clips; done: {counts or 'nothing yet'}",
        f"{status['frames']} frames lit, {status['bytes'] / 1e6:.1f} MB written, {failed} failed",
        *(f"failed: {key}: {why}" for key, why in sorted(status["failed"].items())[:20]),
    ]
    if len(status["failed"]) > 20:
        lines.append(f"and {len(status['failed']) - 20} more; all are in {folder / MANIFEST}")
    lines.append(f"{status['jobs_open']} of {status['jobs_known']} jobs of the clips that are surveyed are open")
    if not status["running"]:
        hint = f"go on with: farm resume {folder}" if status["jobs_open"] else "nothing that is known is open"
        lines.append(f"no driver is at work; {hint}")
    else:
        left = status["seconds_left"]
        lines.append("time left: too early to say" if left is None else f"time left: {words_of_seconds(left)}")
    return [printable(line) for line in lines]


def words_of_seconds(seconds: float) -> str:
    """Return a duration in words."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
