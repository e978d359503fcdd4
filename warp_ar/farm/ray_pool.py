"""Workers as Ray actors, on as many machines as a Ray cluster has; the run's folder must be one that all of them see.

Scheduling is Ray's: where an actor runs, and that it is started again when it or its node dies. Job and record are all
that passes through Ray; nothing goes into its object store but they.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import socket
import threading
from collections.abc import Sequence
from typing import Any

from warp_ar.errors import UsageError, reason
from warp_ar.farm.jobs import Job
from warp_ar.farm.pool import Event
from warp_ar.farm.records import OPENCV_THREADS, Context
from warp_ar.farm.version import program_version

CONNECT_SECONDS = 30.0
"""Within which a cluster must answer."""

KNOCK_SECONDS = 5.0
"""Within which its host must accept a connection."""


class Member:
    """A worker within an actor: one job at a time, while another thread answers how far it is."""

    def __init__(self, context: Context) -> None:
        """Do nothing yet."""
        import cv2

        from warp_ar.farm.work import Work

        cv2.setNumThreads(OPENCV_THREADS)
        self._work, self._frames = Work(context), 0
        self._lock = threading.Lock()

    def version(self) -> str:
        """Of the program that the node has."""
        return program_version()

    def frames(self) -> int:
        """Frames of the job that is being done."""
        return self._frames

    def do(self, job: Job, arguments: Any) -> Any:
        """Do a job; returns its outcome."""

        def tell(frames: int) -> None:
            self._frames = frames

        with self._lock:
            self._frames = 0
            return self._work.do(job, tell, arguments)


class RayPool:
    """Workers as actors: one per GPU of the cluster, or per group of cores where it has none."""

    def __init__(self, context: Context, address: str | None, workers: int | None, *, cores: int = 1) -> None:
        """Connect, and have the actors started.

        Args:
            context: Of the run.
            address: Of the cluster; None: the one that runs here, else one that is started for this run.
            workers: How many; None: as many as the cluster has GPUs, or groups of cores.
            cores: Of a worker where there are no GPUs.

        Raises:
            UsageError: Ray is not installed, or nothing answers at the address.
        """
        try:
            import ray
        except ImportError as error:
            raise UsageError("--ray needs Ray: pip install 'warp-ar[farm]'") from error
        self._ray = ray
        _connect(ray, address)
        found = ray.cluster_resources()
        gpus = int(found.get("GPU", 0))
        # A node that is busy or gone comes back, or another does: so does the actor, and its job is given again.
        self.size = workers or gpus or max(1, int(found.get("CPU", 1)) // cores)
        needs = {"num_gpus": share_of_gpu(self.size, gpus)} if gpus else {"num_cpus": cores}
        environment = {"env_vars": {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}}
        actor = ray.remote(Member).options(
            max_restarts=-1, max_task_retries=0, max_concurrency=2, runtime_env=environment, **needs
        )
        device = "cuda" if gpus else "cpu"
        self.names: Sequence[str] = [f"ray {device}"] * self.size
        self._actors = [
            actor.remote(dataclasses.replace(context, device=device, worker=worker)) for worker in range(self.size)
        ]
        self._tasks: dict[Any, tuple[int, str]] = {}
        for worker in range(self.size):
            self._ask_version(worker)

    def dashboard(self) -> str:
        """Address of Ray's page; empty where it has none."""
        with contextlib.suppress(Exception):
            return str(self._ray.get_runtime_context().worker.node.webui_url or "")
        return ""

    def _ask_version(self, worker: int) -> None:
        """Ask until an actor that is being started, perhaps again, answers."""
        self._tasks[self._actors[worker].version.options(max_task_retries=-1).remote()] = worker, "ready"

    def give(self, worker: int, job: Job, arguments: Any) -> None:
        """As ``Pool.give``."""
        self._tasks[self._actors[worker].do.remote(job, arguments)] = worker, "outcome"
        self._tasks[self._actors[worker].frames.remote()] = worker, "frames"

    def wait(self, seconds: float) -> list[Event]:
        """As ``Pool.wait``."""
        done, _ = self._ray.wait(list(self._tasks), num_returns=1, timeout=seconds)
        busy = {worker for worker, kind in self._tasks.values() if kind == "outcome"}
        events: list[Event] = []
        for task in done:
            worker, kind = self._tasks.pop(task)
            try:
                events.append(Event(worker, kind, self._ray.get(task)))
            except self._ray.exceptions.RayError as error:
                if kind == "frames":
                    continue  # its job says so, too
                events.append(Event(worker, "died", f"its actor died: {reason(error)[:200]}"))
                self._ask_version(worker)
        asked = {worker for worker, kind in self._tasks.values() if kind == "frames"}
        if not done:
            for worker in busy - asked:
                self._tasks[self._actors[worker].frames.remote()] = worker, "frames"
        return events

    def close(self) -> None:
        """As ``Pool.close``; the cluster goes on."""
        for actor in self._actors:
            self._ray.kill(actor, no_restart=True)
        self._ray.shutdown()


def share_of_gpu(workers: int, gpus: int) -> float:
    """What of a GPU each worker takes: a whole one, or a part that all find room for; Ray counts ten-thousandths."""
    on_one = -(-workers // gpus)
    return 1 if on_one == 1 else math.floor(1e4 / on_one) / 1e4


def _knock(address: str) -> None:
    """Raise UsageError if nobody listens at ``HOST:PORT``: Ray itself takes half a minute to say so."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise UsageError(f"--ray {address}: expected HOST:PORT, as `ray start --head` prints it")
    try:
        socket.create_connection((host, int(port)), KNOCK_SECONDS).close()
    except OSError as error:
        told = f"--ray {address}: no cluster answers ({reason(error)}); start one with: ray start --head"
        raise UsageError(told) from error


def _connect(ray: Any, address: str | None) -> None:
    """Connect to a cluster, in a time that is bounded."""
    failure: list[BaseException] = []

    def connect() -> None:
        try:
            ray.init(address=address, logging_level="ERROR", log_to_driver=False)
        except Exception as error:  # Ray raises whatever its transport does
            failure.append(error)

    if address is None:
        with contextlib.suppress(ConnectionError):
            ray.init(address="auto", logging_level="ERROR", log_to_driver=False)
            return
        connect()
    else:
        _knock(address)
        thread = threading.Thread(target=connect, name="warp_ar-ray", daemon=True)
        thread.start()
        thread.join(CONNECT_SECONDS)
        if thread.is_alive():
            raise UsageError(
                f"--ray {address}: nothing answers within {CONNECT_SECONDS:g} s; start one with: ray start --head"
            )
    if failure:
        raise UsageError(
            f"--ray {address or 'local'}: no cluster answers ({reason(failure[0])[:200]}); start one with: "
            "ray start --head"
        )
