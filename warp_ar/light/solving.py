"""Estimates in a process beside this one, on CUDA and for pictures that are shown as they are made.

A solution is tens of milliseconds of NumPy products that hold Python's lock; a thread of this process that launches
kernels or looks for markers would wait for it at each of its calls. A process costs the frames the copies of its
equations, some 12 MB. It keeps nothing between two estimates: a solver goes there and comes back with what it learnt,
so a process that dies costs one estimate, which is then made here.

The process is no child of ``multiprocessing``, which would run the main module of the caller again.
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
    """A solver; it and its arguments can be pickled."""

    def update(self, *sides: Any) -> Any:
        """Solve; the fifth argument traces emitters."""


class SolvingProcess:
    """One process that solves for all pipelines of this one, an estimate at a time."""

    def __init__(self) -> None:
        """Start nothing yet."""
        self._forget()

    def _forget(self) -> None:
        """Have no process: also in a fork, whose parent the process goes on to solve for."""
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
            # Where this process finds what it imports, wherever it stands now and however it was begun.
            paths = [str(Path(__file__).parents[2]), *(os.path.abspath(path) for path in sys.path)]
            code = f"import sys; sys.path[:] = {paths!r}; from {__name__} import serve; serve({theirs.fileno()})"
            with contextlib.suppress(OSError), theirs:  # no more processes: solved for here
                self._process = subprocess.Popen(
                    [sys.executable, "-c", code],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    env={**os.environ, **dict.fromkeys(_BLAS, "1")},
                    start_new_session=True,  # an interrupt of the terminal is not for it
                    pass_fds=(theirs.fileno(),),
                )
            self._connection = ours

    @property
    def ready(self) -> bool:
        """True where the process can solve, or is at work."""
        if not self._ready and self._process is not None and self._lock.acquire(blocking=False):
            try:
                with contextlib.suppress(EOFError, OSError):
                    self._ready = self._connection.poll() and self._connection.recv() == "ready"
            finally:
                self._lock.release()
        return self._ready

    @property
    def starting(self) -> bool:
        """True where the process is not ready yet, but about to be."""
        return not self.ready and self._process is not None and self._process.poll() is None

    def update(self, solver: Solver, sides: tuple[Any, ...], trace: Callable[[Any], Any] | None) -> tuple[Any, Any]:
        """Solve, in the process if it is ready, else here.

        Args:
            solver: It is not changed where the process solves.
            sides: Cells, transfer, mirrored, observations and the camera's place, as ``Recovery.update``.
            trace: Traces emitters, called by this thread.

        Returns:
            The solver with what it learnt, and its solution.
        """
        solved = self._ask(solver, sides, trace) if self.ready else None
        return (solver, update(solver, sides, trace)) if solved is None else solved

    def _ask(
        self, solver: Solver, sides: tuple[Any, ...], trace: Callable[[Any], Any] | None
    ) -> tuple[Any, Any] | None:
        """Return the process's solver and solution; None where it has gone."""
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
                self._end()  # where the trace failed, it waits for an answer that will not come
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
        """End the process; what is still asked for is solved for here."""
        self._closed = True
        if self._process is not None:
            self._process.kill()  # a thread that waits for it notices, and lets go of the lock
        with self._lock:
            self._end()


def update(solver: Solver, sides: tuple[Any, ...], trace: Callable[[Any], Any] | None) -> Any:
    """Solve in this thread; arguments as ``SolvingProcess.update``."""
    cells, transfer, mirrored, observations, camera = sides
    return solver.update(cells, transfer, mirrored, observations, trace, camera)


def serve(descriptor: int) -> None:
    """Solve what comes through a pipe until it ends: what such a process does."""
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
"""Solving process of this process."""
atexit.register(PROCESS.close)
os.register_at_fork(after_in_child=PROCESS._forget)
