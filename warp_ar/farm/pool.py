"""Workers as processes of this machine: one per GPU, or per group of cores.

A worker is told of jobs and tells of frames through a pipe; frames and results never pass through it. Should the driver
die, however it dies, the pipe ends and the worker with it. Each keeps to its own cores, or to those of its GPU, and
BLAS to one thread, so that results do not depend on how many workers there are.
"""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import multiprocessing.connection
import multiprocessing.resource_tracker
import os
import queue
import re
import signal
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

from warp_ar.device import usable_cores
from warp_ar.farm.jobs import Job
from warp_ar.farm.records import OPENCV_THREADS, Context, Outcome
from warp_ar.farm.version import program_version

CORES = 4
"""Of a worker on CPU: more of them leave stages of few rows waiting."""
GPU_CORES = 2
"""Of a worker on a GPU, which keeps about so many busy with decoding and encoding."""
MOST_OF_GPU = 16
"""Workers that share a GPU unless more are asked for: each holds its arrays there."""
TELL_SECONDS = 0.5
"""Between two messages about frames."""


@dataclasses.dataclass(frozen=True)
class Event:
    """What a worker has to say."""

    worker: int
    kind: str
    """``ready`` (with its version), ``frames`` (with their number), ``outcome``, or ``died`` (with how)."""
    value: Any = None


class Pool(Protocol):
    """Workers, wherever they are."""

    size: int
    """How many."""
    names: Sequence[str]
    """What each is: its device."""

    def give(self, worker: int, job: Job, arguments: Any) -> None:
        """Hand a job to a worker that has none."""

    def wait(self, seconds: float) -> list[Event]:
        """What was said since the last call; waits that long at most for something."""

    def close(self) -> None:
        """End every worker at once."""


def devices_of(device: str, workers: int | None) -> list[str]:
    """Device of each worker, one GPU after another.

    Args:
        device: ``auto``, ``cpu`` or ``cuda``.
        workers: How many; None: one per four cores, on GPUs one per two, and at least one for each GPU.
    """
    if device == "cpu":
        return ["cpu"] * (workers or max(1, usable_cores() // CORES))
    from warp_ar.device import resolve_device

    first = resolve_device(device)
    if first.is_cpu:
        return ["cpu"] * (workers or max(1, usable_cores() // CORES))
    import warp as wp

    found = [str(gpu) for gpu in wp.get_cuda_devices()] if device in ("auto", "cuda") else [str(first)]
    each = min(max(usable_cores() // GPU_CORES // len(found), 1), MOST_OF_GPU)
    return [found[n % len(found)] for n in range(workers or each * len(found))]


def by_siblings(cores: Iterable[int]) -> list[int]:
    """Cores in such an order that threads of one of the processor's are beside each other, as far as Linux tells.

    Half of a list in which they are not is more than half of a machine.
    """
    return sorted(cores, key=lambda core: (_first_sibling(core), core))


def _first_sibling(core: int) -> int:
    """The first thread of the processor's core that a core is a thread of."""
    path = Path(f"/sys/devices/system/cpu/cpu{core}/topology/thread_siblings_list")
    try:
        return int(re.split("[,-]", path.read_text(encoding="ascii"))[0])
    except (OSError, ValueError):
        return core


def cores_of(devices: Sequence[str]) -> list[list[int]]:
    """Cores of each worker.

    On CPU each has its own, as evenly as they go, and shared where there are more workers than cores. Workers of one
    GPU share its part of them: where one waits for its GPU or for its encoder, another goes on. Where a
    core of the processor has several threads, they are in one part, as far as that goes.

    Args:
        devices: Of each worker.
    """
    if not hasattr(os, "sched_getaffinity"):
        return [[] for _ in devices]
    cores = by_siblings(os.sched_getaffinity(0))
    owners: list[Any] = list(range(len(devices))) if "cpu" in devices else list(devices)
    place = {owner: n for n, owner in enumerate(dict.fromkeys(owners))}
    if len(place) >= len(cores):
        return [[cores[place[owner] % len(cores)]] for owner in owners]
    ends = [round(n * len(cores) / len(place)) for n in range(len(place) + 1)]
    return [cores[ends[place[owner]] : ends[place[owner] + 1]] for owner in owners]


@contextlib.contextmanager
def keeping_to(cores: Sequence[int]) -> Iterator[None]:
    """Have threads that are started within keep to some cores; without any, to all."""
    if not cores or not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


class ProcessPool:
    """Workers as processes, started anew where they die."""

    def __init__(self, context: Context, devices: Sequence[str]) -> None:
        """Start them.

        Args:
            context: Of the run; each worker gets its own device and number.
            devices: Of each worker.
        """
        self.size, self.names = len(devices), list(devices)
        self._context, self._cores = context, cores_of(devices)
        self._spawn = multiprocessing.get_context("spawn")
        self._workers: list[tuple[Any, Any]] = []
        for worker in range(self.size):
            self._workers.append(self._start(worker))

    def _start(self, worker: int) -> tuple[Any, Any]:
        mine, theirs = self._spawn.Pipe()
        context = dataclasses.replace(self._context, device=self.names[worker], worker=worker)
        cores = self._cores[worker], sorted({core for own in self._cores for core in own})
        process = self._spawn.Process(
            target=_serve, args=(theirs, context, *cores), name=f"warp_ar-farm-{worker}", daemon=True
        )
        with _environment(OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1"), _interrupts_held():
            process.start()
        theirs.close()
        return process, mine

    def give(self, worker: int, job: Job, arguments: Any) -> None:
        """As ``Pool.give``; that the worker has died is told by the next ``wait``."""
        with contextlib.suppress(OSError):
            self._workers[worker][1].send((job, arguments))

    def wait(self, seconds: float) -> list[Event]:
        """As ``Pool.wait``; a worker that died has been replaced."""
        pipes: dict[Any, int] = {pipe: worker for worker, (_, pipe) in enumerate(self._workers)}
        events: list[Event] = []
        heard: list[Any] = multiprocessing.connection.wait(list(pipes), seconds)
        for pipe in heard:
            worker = pipes[pipe]
            try:
                while pipe.poll():
                    kind, value = pipe.recv()
                    events.append(Event(worker, kind, value))
            except (EOFError, OSError):
                events.append(Event(worker, "died", self._end(worker)))
                self._workers[worker] = self._start(worker)
        return events

    def _end(self, worker: int) -> int:
        """Exit code of a worker whose pipe has ended."""
        process, pipe = self._workers[worker]
        pipe.close()
        process.join(5.0)
        if process.exitcode is None:
            process.kill()
            process.join()
        return int(process.exitcode or 0)

    def close(self) -> None:
        """As ``Pool.close``."""
        for process, pipe in self._workers:
            pipe.close()
            process.kill()
        for process, _ in self._workers:
            process.join()


@contextlib.contextmanager
def _environment(**values: str) -> Iterator[None]:
    """Environment variables for processes that are started within."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Processes that are started within never see an interrupt of the terminal; one that comes now is told afterwards.

    They ignore it by themselves, but only when they have imported what they need for that.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    multiprocessing.resource_tracker.ensure_running()  # here: its start lets interrupts through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(pipe: Any, context: Context, cores: Sequence[int], every: Sequence[int]) -> None:
    """A worker's process: does jobs until its pipe ends.

    Args:
        pipe: To the driver.
        context: Of the run.
        cores: That it keeps to; empty: no worker keeps to any.
        every: Of all workers: a survey may use them all, for others wait for what it finds.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the driver decides what an interrupt ends
    if cores:
        os.sched_setaffinity(0, cores)
    _write_to_log(context.folder / "log" / f"worker-{context.worker}.log")
    import cv2

    from warp_ar.farm.work import Work  # here: a driver does without Warp

    cv2.setNumThreads(OPENCV_THREADS)
    jobs: queue.SimpleQueue[tuple[Job, Any]] = queue.SimpleQueue()

    def listen() -> None:
        try:
            while True:
                jobs.put(pipe.recv())
        except (EOFError, OSError):
            os._exit(1)  # the driver is gone: what is half done is nobody's

    threading.Thread(target=listen, name="warp_ar-pipe", daemon=True).start()
    work = Work(context)
    _say(pipe, "ready", program_version())
    while True:
        job, arguments = jobs.get()
        with keeping_to(every if job.kind == "survey" else ()):
            outcome = work.do(job, Teller(lambda frames: _say(pipe, "frames", frames)), arguments)
        _say(pipe, "outcome", outcome)


class Teller:
    """Passes on how many frames are done, not too often."""

    def __init__(self, say: Any) -> None:
        """Call ``say`` with a number now and then."""
        self._say, self._last = say, time.monotonic()

    def __call__(self, frames: int) -> None:
        """Note that so many are done."""
        now = time.monotonic()
        if now - self._last >= TELL_SECONDS:
            self._last = now
            self._say(frames)


def _say(pipe: Any, kind: str, value: str | int | Outcome) -> None:
    try:
        pipe.send((kind, value))
    except OSError:
        os._exit(1)


def _write_to_log(path: Path) -> None:
    """Have what native code prints go to a file."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
        for stream in (1, 2):
            os.dup2(file, stream)
        os.close(file)
        sys.stdout = sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115  (for as long as the process lives)


def words_of_exit(code: int) -> str:
    """How a process ended."""
    if code >= 0:
        return f"its worker ended with exit code {code}"
    with contextlib.suppress(ValueError):
        return f"its worker was ended by {signal.Signals(-code).name}"
    return f"its worker was ended by signal {-code}"


def is_from_outside(code: int) -> bool:
    """Whether a process was ended by somebody else: an operator, the system that ran out of memory, a node's end."""
    outside = {getattr(signal, name, None) for name in ("SIGKILL", "SIGTERM", "SIGHUP", "SIGINT")}
    return code < 0 and -code in {int(number) for number in outside if number is not None}
