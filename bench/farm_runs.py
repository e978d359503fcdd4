"""Runs of the farm as a benchmark sees them: begun from a survey that is there, watched, counted by their records."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import resource
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from warp_ar.farm.jobs import read_jobs
from warp_ar.farm.manifest import begin_run
from warp_ar.farm.version import program_version

ROOT = Path(__file__).resolve().parents[1]
TELL_SECONDS = 10.0
"""Between two lines of progress."""


@dataclasses.dataclass
class Watched:
    """What was seen of a run from outside."""

    seconds: float = 0.0
    code: int | None = None
    """Exit code; None: it was ended at its limit."""
    errors: str = ""
    driver_mb: list[float] = dataclasses.field(default_factory=list)
    """Resident memory of the driver, one value a sample."""
    worker_mb: list[float] = dataclasses.field(default_factory=list)
    """Of the largest worker."""
    workers_mb: list[float] = dataclasses.field(default_factory=list)
    """Of all workers, and of the processes that they have begun."""
    processor_seconds: float = 0.0
    """Of driver and workers, and of the processes that these have begun."""
    spent: list[tuple[float, float]] = dataclasses.field(default_factory=list)
    """Unix seconds, and processor time until then, one pair a sample."""
    gpus: dict[int, list[tuple[int, int]]] = dataclasses.field(default_factory=dict)
    """Share of the time in which a kernel ran in percent, and MB in use, of each GPU, one pair a sample."""

    def cores_between(self, begin: float, end: float) -> float | None:
        """Cores that were busy on average from one moment to another, Unix seconds; None where nothing was seen."""
        seen = [sample for sample in self.spent if begin <= sample[0] <= end]
        if len(seen) < 2:
            return None
        return (seen[-1][1] - seen[0][1]) / (seen[-1][0] - seen[0][0])

    def gpu_figures(self) -> dict[str, Any]:
        """Median load in the second half of the run, and most memory, of each GPU."""
        return {
            f"gpu{index}": {
                "busy_percent": statistics.median(busy for busy, _ in samples[len(samples) // 2 :]),
                "peak_mb": max(memory for _, memory in samples),
            }
            for index, samples in self.gpus.items()
        }

    def memory(self) -> dict[str, Any]:
        """Figures of memory over time: at the tenths of the run."""

        def tenths(values: list[float]) -> list[int]:
            return [round(values[(len(values) - 1) * n // 10]) for n in range(11)] if values else []

        return {
            "driver_mb": tenths(self.driver_mb),
            "largest_worker_mb": tenths(self.worker_mb),
            "all_workers_mb": tenths(self.workers_mb),
            "largest_worker_peak_mb": round(max(self.worker_mb, default=0.0)),
            "driver_peak_mb": round(max(self.driver_mb, default=0.0)),
            "samples": len(self.driver_mb),
        }


def together(runs: Sequence[Watched]) -> Watched:
    """What was seen of runs one after another, as of one."""
    whole = Watched(code=runs[-1].code, errors=runs[-1].errors, gpus=runs[-1].gpus)
    for run in runs:
        whole.seconds += run.seconds
        whole.processor_seconds += run.processor_seconds
        for name in ("driver_mb", "worker_mb", "workers_mb"):
            getattr(whole, name).extend(getattr(run, name))
    return whole


def prepare(folder: Path, jobs: Path, survey: Path | None) -> None:
    """Begin a run without working on it; its clips are taken to be surveyed already as another run's first clip.

    Args:
        folder: Of the new run.
        jobs: The job file.
        survey: Folder of a run whose first clip's survey holds for all clips; None: they are surveyed.
    """
    data = read_jobs(jobs)
    begin_run(folder, data, program_version())
    if survey is None:
        return
    lines = [json.loads(line) for line in (survey / "manifest.jsonl").read_text().splitlines()]
    done = next(line for line in lines if line["state"] == "done" and line["job"].endswith("/survey"))
    source = survey / "clips" / done["job"].rsplit("/", 1)[0]
    with open(folder / "manifest.jsonl", "w", encoding="utf-8") as manifest:
        for clip in data["clip"]:
            key = f"{clip['name']}/survey"
            place = folder / "clips" / clip["name"]
            shutil.copytree(source, place, copy_function=_copy_or_link)
            record = json.loads((place / "record.json").read_text())
            (place / "record.json").write_text(json.dumps({**record, "job": key}))
            manifest.write(json.dumps({**done, "job": key, "frames": 0}) + "\n")


def _copy_or_link(source: str, target: str) -> None:
    """Copy a file; maps of a long survey take gigabytes, and nobody writes to what has been published."""
    (os.link if source.endswith(".bin") else shutil.copy2)(source, target)


def work(
    folder: Path,
    workers: int,
    device: str,
    say: Callable[[str], None],
    *,
    gpus: Sequence[int] = (),
    cores: Sequence[int] = (),
    limit: float = 600.0,
    steady: float | None = None,
    meddle: Callable[[int], None] | None = None,
) -> Watched:
    """Work a run through with the command, and watch it.

    Args:
        folder: Of the run, which has begun.
        workers: Workers.
        device: ``cpu`` or ``cuda``.
        say: Called with a line of progress now and then.
        gpus: Numbers of the GPUs that it sees; empty: all.
        cores: Cores that it keeps to; empty: all.
        limit: Seconds after which it is interrupted.
        steady: The same, counted from when as many jobs as there are workers have been done; None: to its end.
        meddle: Called five times a second with the driver's process number.
    """
    process = _start(folder, workers, device, gpus, cores)
    seen, start = Watched(), time.monotonic()
    ended = threading.Event()
    watcher = threading.Thread(target=_watch, args=(process.pid, folder, seen, say, ended), daemon=True)
    watcher.start()
    with _gpu_load(seen) if device != "cpu" else contextlib.nullcontext():
        until, warm = start + limit, False
        while process.poll() is None and time.monotonic() < until:
            time.sleep(0.2)
            if meddle is not None:
                meddle(process.pid)
            if steady is not None and not warm and _segments_done(folder) >= workers:
                warm, until = True, min(until, time.monotonic() + steady)
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        else:
            seen.code = process.returncode
        try:
            seen.errors = process.communicate(timeout=30.0)[1]
        except subprocess.TimeoutExpired:
            process.kill()
            seen.errors = process.communicate()[1]
    seen.seconds = time.monotonic() - start
    ended.set()
    watcher.join()
    return seen


def _start(folder: Path, workers: int, device: str, gpus: Sequence[int], cores: Sequence[int]) -> subprocess.Popen[str]:
    """The command that works a run through, on the GPUs and cores that it may use."""
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    environment = dict(os.environ, PYTHONPATH=path)
    if gpus and device != "cpu":
        environment["CUDA_VISIBLE_DEVICES"] = ",".join(map(str, gpus))
    command = [sys.executable, "-m", "warp_ar.farm", "resume", str(folder), "--workers", str(workers)]
    before = os.sched_getaffinity(0)
    if cores:
        os.sched_setaffinity(0, cores)
    try:
        return subprocess.Popen(
            [*command, "--device", device],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
    finally:
        os.sched_setaffinity(0, before)


def _segments_done(folder: Path) -> int:
    """How many segments or variations a run has done."""
    with contextlib.suppress(OSError):
        text = (folder / "manifest.jsonl").read_text()
        return text.count("/segment-") + text.count("/variation-")
    return 0


@contextlib.contextmanager
def _gpu_load(seen: Watched) -> Iterator[None]:
    """Have ``nvidia-smi`` note each second how busy the GPUs are, where it is there."""
    program = shutil.which("nvidia-smi")
    if program is None:
        yield
        return
    query = [program, "--query-gpu=index,utilization.gpu,memory.used", "--format=csv,noheader,nounits", "-lms", "500"]
    with tempfile.TemporaryFile("w+") as file, subprocess.Popen(query, stdout=file, stderr=subprocess.DEVNULL) as smi:
        try:
            yield
        finally:
            smi.terminate()
            smi.wait()
            file.seek(0)
            for line in file:
                with contextlib.suppress(ValueError):
                    index, busy, memory = (int(value) for value in line.split(","))
                    seen.gpus.setdefault(index, []).append((busy, memory))


def _watch(pid: int, folder: Path, seen: Watched, say: Callable[[str], None], ended: threading.Event) -> None:
    """Sample memory and processor time each half second, and tell how far the run is."""
    told, page = time.monotonic(), resource.getpagesize() / 1e6
    ticks = os.sysconf("SC_CLK_TCK")
    spent: dict[int, float] = {}
    while not ended.wait(0.5):
        sizes = []
        mine = workers_of(pid)
        for process in [pid, *mine, *(helper for worker in mine for helper in _children_of(worker))]:
            with contextlib.suppress(OSError, ValueError, IndexError):
                resident = int(Path(f"/proc/{process}/statm").read_text().split()[1]) * page
                fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
                spent[process] = (int(fields[11]) + int(fields[12])) / ticks
                sizes.append((process, resident))
        others = [size for process, size in sizes if process != pid]
        if len(sizes) > len(others):
            seen.driver_mb.append(next(size for process, size in sizes if process == pid))
            seen.worker_mb.append(max((size for process, size in sizes if process in mine), default=0.0))
            seen.workers_mb.append(sum(others))
        seen.processor_seconds = sum(spent.values())
        seen.spent.append((time.time(), seen.processor_seconds))
        if time.monotonic() - told > TELL_SECONDS:
            told = time.monotonic()
            with contextlib.suppress(OSError, ValueError):
                progress = json.loads((folder / "progress.json").read_text())
                rate = sum(worker["fps"] for worker in progress["workers"])
                say(f"{progress['jobs_open']} of {progress['jobs_known']} jobs open, {rate:.1f} frames a second")


def workers_of(pid: int) -> list[int]:
    """Workers: processes that a driver has started by spawning."""
    mine = []
    for child in _children_of(pid):
        with contextlib.suppress(OSError):
            if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                mine.append(child)
    return mine


def _children_of(pid: int) -> list[int]:
    """Processes that a process has started and that are there."""
    found = []
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError):  # a thread that has ended meanwhile
                found += [int(child) for child in (task / "children").read_text().split()]
    return found


@dataclasses.dataclass(frozen=True)
class Done:
    """A job by its line of the manifest."""

    key: str
    worker: int
    start: float
    """Unix seconds."""
    end: float
    frames: int
    bytes: int


def jobs_done(folder: Path, kind: str) -> list[Done]:
    """Jobs of a kind that a run has done."""
    found = []
    for line in (folder / "manifest.jsonl").read_text().splitlines():
        told = json.loads(line)
        if told["state"] == "done" and told["job"].rsplit("/", 1)[1].split("-")[0] == kind and "ended" in told:
            end = float(told["ended"])
            worker, frames = int(told["worker"]), int(told["frames"] if "frames" in told else told["length"])
            found.append(Done(told["job"], worker, end - told["seconds"], end, frames, int(told["bytes"])))
    return found


def rates(done: Sequence[Done], workers: int, seen: Watched | None = None) -> dict[str, Any]:
    """Frames a second of jobs: of the whole, and while all workers were past their first job and none had run out.

    A worker's first job loads kernels and allocates. Frames of a job are taken to be spread evenly over its time.

    Args:
        done: Jobs.
        workers: That did them.
        seen: What was seen of the run: then with the cores that were busy in that time, and what a frame took of them.
    """
    if not done:
        return {"frames": 0}
    own = {worker: [job for job in done if job.worker == worker] for worker in {job.worker for job in done}}
    frames = sum(job.frames for job in done)
    begin, end = min(job.start for job in done), max(job.end for job in done)
    figures: dict[str, Any] = {"frames": frames, "fps_whole": round(frames / (end - begin), 2)}
    if len(own) == workers and min(map(len, own.values())) > 1:
        begin = max(min(job.end for job in jobs) for jobs in own.values())
        end = min(max(job.end for job in jobs) for jobs in own.values())
        count = sum(
            job.frames * max(0.0, min(job.end, end) - max(job.start, begin)) / (job.end - job.start) for job in done
        )
        if end > begin:
            figures |= {"fps": round(count / (end - begin), 2), "steady_seconds": round(end - begin, 2)}
            if seen is not None and (busy := seen.cores_between(begin, end)) is not None:
                figures |= {
                    "steady_cores": round(busy, 2),
                    "processor_ms_per_frame": round(1e3 * busy / figures["fps"], 1),
                }
    return figures
