"""Workers of a run: processes of this machine, each on its own cores, or actors of a Ray cluster.

A worker receives jobs and returns records; frames never pass through a pool. Each process has an executor of its own,
so that its death loses only one job. BLAS and OpenCV use one thread in every worker, so that results do not depend on
the number of workers.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import multiprocessing
import multiprocessing.resource_tracker
import os
import signal
import socket
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from warp_ar.device import usable_cores
from warp_ar.errors import UsageError, import_extra, reason
from warp_ar.farm.jobs import Context, Job, Outcome, program_version
from warp_ar.farm.manifest import RunError

CORES = 4
"""Number of processor cores per worker on CPU; stages with few rows cannot use more."""
GPU_CORES = 2
"""Number of processor cores per worker on a GPU, for decoding and encoding."""
MOST_OF_GPU = 16
"""Largest default number of workers on a GPU; each holds arrays of its own there."""
DEATHS = 5
"""Number of deaths of its worker after which a job has failed."""
STARTS = 3
"""Number of consecutive deaths of a starting worker after which the run ends."""
KNOCK_SECONDS = 5.0
"""Seconds within which a cluster's host must accept a connection."""


def devices_of(device: str, workers: int | None) -> list[str]:
    """Return the device of each worker; GPUs are assigned to the workers in turn.

    Args:
        device: ``auto``, ``cpu`` or ``cuda``.
        workers: Number of workers. None: on CPU, one per ``CORES`` cores; on GPUs, one per ``GPU_CORES`` cores, but at
            least one and at most ``MOST_OF_GPU`` for each GPU.
    """
    from warp_ar.device import resolve_device

    first = None if device == "cpu" else resolve_device(device)
    if first is None or not first.is_cuda:
        return ["cpu"] * (workers or max(1, usable_cores() // CORES))
    import warp as wp

    found = [str(gpu) for gpu in wp.get_cuda_devices()] if device in ("auto", "cuda") else [str(first)]
    each = min(max(usable_cores() // GPU_CORES // len(found), 1), MOST_OF_GPU)
    return [found[n % len(found)] for n in range(workers or each * len(found))]


def cores_of(devices: Sequence[str]) -> list[list[int]]:
    """Return the numbers of each worker's cores; empty lists if the system cannot bind a process to cores.

    On CPU the cores are divided evenly; if there are more workers than cores, some share a core. On GPUs the cores are
    divided among the GPUs, and the workers of one GPU share its cores: while one waits, another runs.

    Args:
        devices: Device of each worker.
    """
    if not hasattr(os, "sched_getaffinity"):
        return [[] for _ in devices]
    cores = sorted(os.sched_getaffinity(0))
    owners: list[Any] = list(range(len(devices))) if "cpu" in devices else list(devices)
    place = {owner: n for n, owner in enumerate(dict.fromkeys(owners))}
    if len(place) >= len(cores):
        return [[cores[place[owner] % len(cores)]] for owner in owners]
    ends = [round(n * len(cores) / len(place)) for n in range(len(place) + 1)]
    return [cores[ends[place[owner]] : ends[place[owner] + 1]] for owner in owners]


@contextlib.contextmanager
def keeping_to(cores: Sequence[int]) -> Iterator[None]:
    """Context in which this thread, and those that it starts, are bound to cores; without cores it does nothing."""
    if not cores or not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


class Pool(ABC):
    """Workers of any kind, each with a thread that waits for it."""

    def __init__(self, size: int) -> None:
        """Start the threads for ``size`` workers."""
        self.size = size
        self._closed = False
        # The tracker is started before interrupts are blocked in the threads, because its start unblocks them.
        multiprocessing.resource_tracker.ensure_running()
        self._threads = [ThreadPoolExecutor(1, "warp_ar-worker", initializer=_hold_interrupts) for _ in range(size)]

    def submit(self, worker: int, job: Job) -> Future[Outcome]:
        """Submit a job to an idle worker.

        Args:
            worker: Index of the worker.
            job: The job.

        Returns:
            Future of the outcome; it raises RunError if the run cannot go on.
        """
        return self._threads[worker].submit(self._do, worker, job)

    @abstractmethod
    def _do(self, worker: int, job: Job) -> Outcome:
        """Have a job done by a worker and return its outcome; the state is ``lost`` if the worker dies repeatedly."""

    @abstractmethod
    def _end(self) -> None:
        """End every worker at once."""

    def close(self) -> None:
        """End every worker at once, and wait until they have ended."""
        self._closed = True
        self._end()
        for thread in self._threads:
            thread.shutdown(wait=True, cancel_futures=True)


def _hold_interrupts() -> None:
    """Block the terminal's interrupts in processes that this thread starts; only the driver handles them."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])


class ProcessPool(Pool):
    """Workers as processes of this machine; a dead worker is restarted, and its job repeated."""

    def __init__(self, context: Context, devices: Sequence[str]) -> None:
        """Start the workers.

        Args:
            context: Context of the run; each worker gets its own device and index.
            devices: Device of each worker.
        """
        super().__init__(len(devices))
        self._context, self._devices, self._cores = context, devices, cores_of(devices)
        self._executors: dict[int, ProcessPoolExecutor] = {}
        for worker, thread in enumerate(self._threads):
            thread.submit(self._ready, worker)

    def _ready(self, worker: int) -> ProcessPoolExecutor:
        """Return a worker's executor when it is ready.

        Raises:
            RunError: The worker has died repeatedly before it was ready.
        """
        for _ in range(STARTS):
            if worker not in self._executors:
                context = dataclasses.replace(self._context, device=self._devices[worker], worker=worker)
                every = sorted({core for own in self._cores for core in own})
                self._executors[worker] = ProcessPoolExecutor(
                    1,
                    mp_context=multiprocessing.get_context("spawn"),
                    initializer=_begin,
                    initargs=(context, self._cores[worker], every),
                )
            try:
                self._executors[worker].submit(os.getpid).result()
                return self._executors[worker]
            except BrokenExecutor:
                del self._executors[worker]
            if self._closed:
                break
        raise RunError(f"worker {worker} died {STARTS} times before it was ready; see {self._log(worker)}")

    def _do(self, worker: int, job: Job) -> Outcome:
        for _ in range(DEATHS):
            executor = self._ready(worker)
            try:
                return executor.submit(_do, job).result()
            except BrokenExecutor:
                del self._executors[worker]
            if self._closed:
                break
        log = self._log(worker)
        return Outcome("lost", reason=f"its worker died {DEATHS} times, killed or crashed; see {log}")

    def _log(self, worker: int) -> Path:
        return self._context.folder / "log" / f"worker-{worker}.log"

    def _end(self) -> None:
        for process in multiprocessing.active_children():
            process.kill()
        for executor in list(self._executors.values()):
            executor.shutdown(wait=True, cancel_futures=True)


_worker: tuple[Any, Sequence[int]] | None = None
"""Worker object and the cores of all workers, in a worker's process; None in the driver."""


def _begin(context: Context, cores: Sequence[int], every: Sequence[int]) -> None:
    """Make this process a worker: it ends with the process that started it, runs on its own cores and writes to a log.

    Args:
        context: Context of the run for this worker.
        cores: Indices of the cores of this worker; empty: it is not bound to cores.
        every: Indices of the cores of all workers, which surveys may use.
    """
    global _worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_driver, name="warp_ar-driver", daemon=True).start()
    if cores:
        os.sched_setaffinity(0, cores)
    _write_to_log(context.folder / "log" / f"worker-{context.worker}.log")
    from warp_ar.farm.work import Work  # imported here: a driver does not need Warp

    _worker = Work(context), every


def _end_with_driver() -> None:
    driver = multiprocessing.parent_process()
    if driver is not None:
        driver.join()
        os._exit(1)


def _do(job: Job) -> Outcome:
    """Do a job in this worker's process; a survey may use the cores of all workers, because others wait for it."""
    assert _worker is not None
    work, every = _worker
    with keeping_to(every if job.kind == "survey" else ()):
        outcome: Outcome = work.do(job)
    return outcome


def _write_to_log(path: Path) -> None:
    """Redirect all printed output, including that of native code, to a file."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "ab") as file:
            for stream in (1, 2):
                os.dup2(file.fileno(), stream)
        sys.stdout = sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115  (for as long as the process lives)


class RayPool(Pool):
    """Workers as Ray actors: one per GPU of the cluster, or per core without GPUs.

    Ray places the actors, restarts an actor that has died or lost its node, and repeats its job.
    """

    def __init__(self, address: str | None, workers: int | None) -> None:
        """Connect to a cluster.

        Args:
            address: Address of the cluster; None: the one on this machine, or a new one for this run.
            workers: Number of workers; None: the cluster's number of GPUs, or of cores.

        Raises:
            UsageError: Ray is not installed, or no cluster answers at the address.
        """
        ray = import_extra("farm", "--ray needs Ray", "ray")
        self._ray = ray
        _connect(ray, address)
        found = ray.cluster_resources()
        self._gpus = int(found.get("GPU", 0))
        super().__init__(workers or self._gpus or max(1, int(found.get("CPU", 1))))
        self._actors: list[Any] = []

    def employ(self, context: Context) -> RayPool:
        """Start the actors for a run."""
        from warp_ar.farm.work import Work

        needs = {"num_gpus": share_of_gpu(self.size, self._gpus)} if self._gpus else {"num_cpus": 1}
        # If an actor or its node is lost, Ray restarts the actor on any node and repeats its job.
        actor = self._ray.remote(Work).options(max_restarts=-1, max_task_retries=DEATHS, **needs)
        device = "cuda" if self._gpus else "cpu"
        for worker in range(self.size):
            self._actors.append(actor.remote(dataclasses.replace(context, device=device, worker=worker)))
        return self

    def _do(self, worker: int, job: Job) -> Outcome:
        actor = self._actors[worker]
        try:
            if (version := self._ray.get(actor.version.remote())) != (mine := program_version()):
                raise RunError(f"worker {worker} is {version}, the driver is {mine}; install one version on all")
            outcome: Outcome = self._ray.get(actor.do.remote(job))
        except self._ray.exceptions.RayError as error:
            return Outcome("lost", reason=f"its worker died, killed or crashed: {reason(error)}")
        return outcome

    def _end(self) -> None:
        for actor in self._actors:
            self._ray.kill(actor, no_restart=True)
        self._ray.shutdown()


def share_of_gpu(workers: int, gpus: int) -> float:
    """Return the share of a GPU for each worker, rounded down to Ray's unit of 1/10,000 so that all workers fit."""
    on_one = -(-workers // gpus)
    return 1 if on_one == 1 else math.floor(1e4 / on_one) / 1e4


def _connect(ray: Any, address: str | None) -> None:
    """Connect to a cluster; the host is tried first, because Ray takes half a minute to report that none answers.

    Raises:
        UsageError: No cluster answers at the address.
    """
    options = {"logging_level": "ERROR", "log_to_driver": False}
    if address is None:
        try:
            ray.init(address="auto", **options)
        except ConnectionError:
            ray.init(**options)
        return
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        socket.create_connection((host, int(port)), KNOCK_SECONDS).close()
        ray.init(address=address, **options)
    except Exception as error:  # Ray raises any error of its transport
        raise UsageError(
            f"--ray {address}: no cluster answers ({reason(error)[:200]}); expected HOST:PORT, as `ray start --head` "
            "prints it"
        ) from error
