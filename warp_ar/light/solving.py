"""Estimates in a separate process, on CUDA and for pictures that are shown in real time.

A solution takes tens of milliseconds of NumPy products, during which other threads of the process, which launch kernels
and find markers, often wait for the interpreter's lock. With a separate process, frames only have to copy the
equations, some 12 MB. The process keeps no state between estimates: a solver is sent to it, and returned with its
updated state. If the process dies, the estimate is computed in this process instead.

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
    """Separate process that solves for all pipelines of this process, one estimate at a time."""

    def __init__(self) -> None:
        """Create the object without starting the process."""
        self._forget()

    def _forget(self) -> None:
        """Drop the references to the process without ending it, also in a fork, where the parent owns the process."""
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
            # The import paths of this process are passed as absolute paths, independent of the working folder.
            paths = [str(Path(__file__).parents[2]), *(os.path.abspath(path) for path in sys.path)]
            code = f"import sys; sys.path[:] = {paths!r}; from {__name__} import serve; serve({theirs.fileno()})"
            with contextlib.suppress(OSError), theirs:  # without a process, estimates are computed in this one
                self._process = subprocess.Popen(
                    [sys.executable, "-c", code],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    env={**os.environ, **dict.fromkeys(_BLAS, "1")},
                    start_new_session=True,  # the terminal's interrupts do not reach it
                    pass_fds=(theirs.fileno(),),
                )
            self._connection = ours

    @property
    def ready(self) -> bool:
        """True once the process can solve, also while it is solving."""
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

    def update(self, solver: Solver, sides: tuple[Any, ...], trace: Callable[[Any], Any]) -> tuple[Any, Any]:
        """Solve in the separate process if it is ready, otherwise on this thread.

        Args:
            solver: Solver; it is unchanged if the separate process solves.
            sides: Arguments ``cells``, ``transfer``, ``mirrored``, ``observations`` and ``camera`` of
                ``Recovery.update``.
            trace: Function that traces emitters; it is called on this thread.

        Returns:
            The solver with its updated state, and its solution.
        """
        solved = self._ask(solver, sides, trace) if self.ready else None
        return (solver, update(solver, sides, trace)) if solved is None else solved

    def _ask(self, solver: Solver, sides: tuple[Any, ...], trace: Callable[[Any], Any]) -> tuple[Any, Any] | None:
        """Have the process solve; return the updated solver and the solution, or None if the process has died."""
        with self._lock:
            try:
                self._connection.send((solver, sides))
                kind, value = self._connection.recv()
                while kind == "trace":
                    self._connection.send(trace(value))
                    kind, value = self._connection.recv()
            except (EOFError, OSError):
                self._end()
                return None
            except BaseException:
                self._end()  # after an error in ``trace``, the process would wait for ever for its result
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
        """End the process; later estimates are computed in this one."""
        self._closed = True
        if self._process is not None:
            self._process.kill()  # a thread that waits for it wakes up and releases the lock
        with self._lock:
            self._end()


def update(solver: Solver, sides: tuple[Any, ...], trace: Callable[[Any], Any]) -> Any:
    """Solve on this thread and return the solution; the arguments are those of ``SolvingProcess.update``."""
    cells, transfer, mirrored, observations, camera = sides
    return solver.update(cells, transfer, mirrored, observations, trace, camera)


def serve(descriptor: int) -> None:
    """Solve the problems that arrive through a pipe, until it is closed; this is the main function of the process."""
    import warp_ar.light.recovery  # noqa: F401 - unpickling needs it

    connection = Connection(descriptor)

    def trace(emitters: Any) -> Any:
        connection.send(("trace", emitters))
        return connection.recv()

    with contextlib.suppress(EOFError, OSError), connection:
        connection.send("ready")
        while True:
            solver, sides = connection.recv()
            answer: tuple[str, Any]
            try:
                answer = "solved", (solver, update(solver, sides, trace))
            except (EOFError, OSError):
                raise
            except Exception as error:
                answer = "error", error
            connection.send(answer)


PROCESS = SolvingProcess()
"""Solving process that all pipelines of this process share."""
atexit.register(PROCESS.close)
os.register_at_fork(after_in_child=PROCESS._forget)
