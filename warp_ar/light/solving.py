"""Estimates in a separate process, on CUDA and for pictures that are shown in real time.

A solution takes tens of milliseconds of NumPy products that hold Python's lock. A thread of this process that launches
kernels or finds markers would wait for the lock at each of its calls. A separate process costs the frames only copies
of the equations, some 12 MB. It keeps no state between estimates: a solver is sent and returned with its updated state.
If the process dies, one estimate is lost and computed here instead.

The process is not started by ``multiprocessing``, which would run the caller's main module again.
"""

from __future__ import annotations

import atexit
import contextlib
import multiprocessing
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol

_BLAS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")


class Solver(Protocol):
    """Solver that can be pickled together with its arguments."""

    def update(self, *sides: Any) -> Any:
        """Solve one frame's equations; the fifth argument is the function that traces emitters."""


class SolvingProcess:
    """Process that solves for all pipelines of this process, one estimate at a time."""

    def __init__(self) -> None:
        """Create the object without starting the process."""
        self._forget()

    def _forget(self) -> None:
        """Drop the process without ending it; also in a fork, because the process belongs to the parent."""
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Any = None
        self._ready = self._closed = False

    def prepare(self) -> None:
        """Start the process if there is none; it is ready some seconds later."""
        with self._lock:
            if self._process is not None or self._closed:
                return
            ours, theirs = multiprocessing.Pipe()
            # Import paths of this process as absolute paths, independent of the working folder.
            paths = [str(Path(__file__).parents[2]), *(os.path.abspath(path) for path in sys.path)]
            code = f"import sys; sys.path[:] = {paths!r}; from {__name__} import serve; serve({theirs.fileno()})"
            with contextlib.suppress(OSError), theirs:  # if no process can be started, estimates are computed here
                self._process = subprocess.Popen(
                    [sys.executable, "-c", code],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    env={**os.environ, **dict.fromkeys(_BLAS, "1")},
                    start_new_session=True,  # without the terminal's interrupts
                    pass_fds=(theirs.fileno(),),
                )
            self._connection = ours

    @property
    def ready(self) -> bool:
        """True if the process is ready to solve, or is solving."""
        if not self._ready and self._process is not None and self._lock.acquire(blocking=False):
            try:
                with contextlib.suppress(EOFError, OSError):
                    self._ready = self._connection.poll() and self._connection.recv() == "ready"
            finally:
                self._lock.release()
        return self._ready

    @property
    def starting(self) -> bool:
        """True while the process is starting."""
        return not self.ready and self._process is not None and self._process.poll() is None

    def update(self, solver: Solver, sides: tuple[Any, ...], trace: Callable[[Any], Any] | None) -> tuple[Any, Any]:
        """Solve in the process if it is ready, otherwise here.

        Args:
            solver: Solver; it is unchanged if the process solves.
            sides: Cells, transfer, mirrored, observations and the camera's position, as for ``Recovery.update``.
            trace: Function that traces emitters; called on this thread.

        Returns:
            The solver with its updated state, and its solution.
        """
        solved = self._ask(solver, sides, trace) if self.ready else None
        return (solver, update(solver, sides, trace)) if solved is None else solved

    def _ask(
        self, solver: Solver, sides: tuple[Any, ...], trace: Callable[[Any], Any] | None
    ) -> tuple[Any, Any] | None:
        """Let the process solve; return its updated solver and its solution, or None if the process has died."""
        with self._lock:
            try:
                self._connection.send((solver, sides, trace is not None))
                kind, value = self._connection.recv()
                while kind == "trace":
                    assert trace is not None
                    self._connection.send(trace(value))
                    kind, value = self._connection.recv()
            except (EOFError, OSError):
                self._end()
                return None
            except BaseException:
                self._end()  # after an error of the trace, the process waits for an answer that will not come
                raise
        if kind == "error":
            raise value
        return value  # type: ignore[no-any-return]

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._connection.close()
        self._process, self._ready = None, False

    def close(self) -> None:
        """End the process; requested estimates are computed here."""
        self._closed = True
        if self._process is not None:
            self._process.kill()  # a thread that waits for it wakes up and releases the lock
        with self._lock:
            self._end()


def update(solver: Solver, sides: tuple[Any, ...], trace: Callable[[Any], Any] | None) -> Any:
    """Solve on this thread; ``SolvingProcess.update`` describes the arguments."""
    cells, transfer, mirrored, observations, camera = sides
    return solver.update(cells, transfer, mirrored, observations, trace, camera)


def serve(descriptor: int) -> None:
    """Solve the problems that arrive through a pipe, until it is closed; main function of the solving process."""
    import warp_ar.light.recovery  # noqa: F401 - unpickling needs it

    connection = Connection(descriptor)

    def trace(emitters: Any) -> Any:
        connection.send(("trace", emitters))
        return connection.recv()

    with contextlib.suppress(EOFError, OSError), connection:
        connection.send("ready")
        while True:
            solver, sides, traced = connection.recv()
            answer: tuple[str, Any]
            try:
                answer = "solved", (solver, update(solver, sides, trace if traced else None))
            except (EOFError, OSError):
                raise
            except Exception as error:
                answer = "error", error
            connection.send(answer)


PROCESS = SolvingProcess()
"""Solving process that all pipelines of this process share."""
atexit.register(PROCESS.close)
os.register_at_fork(after_in_child=PROCESS._forget)
