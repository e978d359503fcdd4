"""Estimates of recovery in processes of their own, for pictures that are shown as they are made, and on CUDA.

A solution is 20 to 100 ms of small NumPy products that hold Python's lock; threads of the same process that
launch kernels or look for markers then wait for it at each of their calls. In a process beside them it costs the frames
the copies of its equations, some 12 MB. A process keeps nothing between two estimates: a solver goes there and comes
back with what it learnt, so a process that dies costs one estimate, which is then made here.

A message is a pickle and its arrays beside it, with their lengths before them. Whether there is anything to solve for
is asked before the message is written: in a light that stands still most of the time there is not.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import pickle
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

from warp_ar.device import usable_cores

CORES_EACH = 4
"""Cores for each process: solutions are a small part of what a frame costs."""
PIPE = 1 << 20
"""Bytes that a pipe to a process holds, the most that Linux gives an ordinary user: each time that it is full or empty
both sides wait for each other, and here for Python's lock. By default it is 64 KB."""
_COUNT = struct.Struct("<I")
_SIZE = struct.Struct("<Q")
_BLAS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")


class Solver(Protocol):
    """What solves: it and its arguments can be pickled."""

    def rests(self, cells: Any, observations: Any) -> bool:
        """Whether the last solution still holds."""

    def update(self, *sides: Any) -> Any:
        """A solution; the fifth argument traces emitters."""


def write_message(stream: Any, value: Any) -> None:
    """Write a value; arrays go as they lie in memory.

    Args:
        stream: Binary, not buffered.
        value: What can be pickled.
    """
    buffers: list[pickle.PickleBuffer] = []
    head = pickle.dumps(value, 5, buffer_callback=buffers.append)
    parts = [memoryview(head), *(buffer.raw() for buffer in buffers)]
    stream.write(b"".join([_COUNT.pack(len(parts)), *(_SIZE.pack(part.nbytes) for part in parts)]))
    for part in parts:
        while part:
            part = part[stream.write(part) :]


def read_message(stream: Any) -> Any:
    """The next value of a stream.

    Raises:
        EOFError: The other side has gone.
    """
    (count,) = _COUNT.unpack(_read(stream, _COUNT.size))
    sizes = [_SIZE.unpack(_read(stream, _SIZE.size))[0] for _ in range(count)]
    head, *buffers = (_read(stream, size) for size in sizes)
    return pickle.loads(head, buffers=buffers)


def _read(stream: Any, size: int) -> bytearray:
    data = bytearray(size)
    view = memoryview(data)
    while view:
        count = stream.readinto(view)
        if not count:
            raise EOFError("the other process has gone")
        view = view[count:]
    return data


def start_process(module: str, descriptors: tuple[int, ...] = ()) -> subprocess.Popen[bytes]:
    """A process that calls a module's ``serve``, with pipes to its standard input and output.

    Args:
        module: Its name.
        descriptors: Of files that stay open there, by the same numbers.
    """
    # Where this process finds what it imports, wherever it stands now and however it was begun.
    paths = [str(Path(__file__).parents[2]), *(os.path.abspath(path) for path in sys.path)]
    code = f"import sys; sys.path[:] = {paths!r}; from {module} import serve; serve()"
    return subprocess.Popen(
        [sys.executable, "-c", code],
        bufsize=0,
        pipesize=PIPE,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, **dict.fromkeys(_BLAS, "1")},
        start_new_session=True,  # an interrupt of the terminal is not for it
        pass_fds=descriptors,
    )


@contextlib.contextmanager
def own_streams() -> Iterator[tuple[Any, Any]]:
    """Of such a process: what comes from the one that started it, and what goes there, not buffered."""
    with os.fdopen(os.dup(0), "rb", 0) as source, os.fdopen(os.dup(1), "wb", 0) as target:
        with open(os.devnull, "r+b") as nothing:  # what libraries print is no message
            os.dup2(nothing.fileno(), 0)
            os.dup2(nothing.fileno(), 1)
        yield source, target


class SolvingProcess:
    """One process that solves; started here, ready when it has loaded what it needs."""

    def __init__(self) -> None:
        """Start; returns at once."""
        self._process = start_process(__name__)
        self.ready = False
        self._greeting = threading.Thread(target=self._wait, name="warp_ar-solving", daemon=True)
        self._greeting.start()

    def _wait(self) -> None:
        with contextlib.suppress(EOFError, OSError):
            self.ready = read_message(self._process.stdout) == "ready"

    @property
    def starting(self) -> bool:
        """Whether it has not said yet that it is ready, and may."""
        return self._greeting.is_alive()

    def solve(self, solver: Solver, sides: tuple[Any, ...], trace: Callable[[Any], Any] | None) -> tuple[Any, Any]:
        """The solver with what it learnt, and its solution; arguments as ``SolvingPool.solve``.

        Whether the last solution still holds is not asked.

        Raises:
            EOFError: The process has gone.
            OSError: The same.
        """
        write_message(self._process.stdin, (solver, sides, trace is not None))
        while True:
            kind, value = read_message(self._process.stdout)
            if kind == "trace":
                assert trace is not None
                write_message(self._process.stdin, trace(value))
            elif kind == "error":
                raise value
            else:
                return value  # type: ignore[no-any-return]

    def end(self) -> None:
        """End it, and see it gone; a thread that is solving by it is told by its next read or write."""
        self._process.kill()
        self._process.wait()

    def close(self) -> None:
        """End it and close the streams to it, which no thread may be reading any more."""
        self.end()
        self._greeting.join()
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            with contextlib.suppress(OSError):
                stream.close()


class SolvingPool:
    """Processes that solve for all pipelines of this one, started as they are asked for."""

    def __init__(self, most: int) -> None:
        """No process yet.

        Args:
            most: Processes at once.
        """
        self._most = most
        self._changed = threading.Condition()
        self._idle: list[SolvingProcess] = []
        self._all: list[SolvingProcess] = []
        self._closed = False

    def prepare(self) -> None:
        """Start a process if none has started, so that it is ready when it is needed."""
        with self._changed:
            if not self._all and not self._closed:
                self._start()

    @property
    def ready(self) -> bool:
        """Whether a process is ready to solve, or at work."""
        with self._changed:
            return any(process.ready for process in self._all)

    @property
    def starting(self) -> bool:
        """Whether none is ready, and one is about to be: a second or two after it was started."""
        with self._changed:
            return not any(process.ready for process in self._all) and any(one.starting for one in self._all)

    def _start(self) -> None:
        with contextlib.suppress(OSError):  # no more processes: solved for here
            process = SolvingProcess()
            self._all.append(process)
            self._idle.append(process)

    def solve(self, solver: Solver, sides: tuple[Any, ...], trace: Callable[[Any], Any] | None) -> tuple[Any, Any]:
        """Solve, in a process that is ready, or here.

        Args:
            solver: Where another process solves it only takes note of the light.
            sides: Cells, transfer, mirrored, observations and the camera's place, as ``Recovery.update``.
            trace: Traces emitters, called by this thread.

        Returns:
            The solver with what it learnt, and its solution; None where the last still holds.
        """
        cells, _, _, observations, _ = sides
        if solver.rests(cells, observations):
            return solver, None
        process = self._take()
        if process is None:
            return solver, _update_by(solver, sides, trace)
        try:
            solved = process.solve(solver, sides, trace)
        except (EOFError, OSError):
            self._drop(process)
            return solver, _update_by(solver, sides, trace)
        except BaseException:
            self._drop(process)  # where the trace failed, it waits for an answer that will not come
            raise
        with self._changed:
            closed = self._closed
            if not closed:
                self._idle.append(process)
                self._changed.notify()
        if closed:
            process.close()
        return solved

    def _take(self) -> SolvingProcess | None:
        """A process that nobody uses; None: none can be had."""
        with self._changed:
            if not self._idle and len(self._all) < self._most and not self._closed:
                self._start()
            while not self._closed:
                ready = [process for process in self._idle if process.ready]
                if ready:
                    self._idle.remove(ready[0])
                    return ready[0]
                if not any(process.ready for process in self._all):
                    return None
                self._changed.wait()  # for one that is at work: sooner than one that was just started
            return None

    def _drop(self, process: SolvingProcess) -> None:
        with self._changed:
            if process in self._all:
                self._all.remove(process)
            self._changed.notify_all()  # without a process left, all who wait for one solve for themselves
        process.close()

    def close(self) -> None:
        """End the processes; what is still asked for is solved for here."""
        with self._changed:
            self._closed = True
            processes, self._all, idle, self._idle = self._all, [], self._idle, []
            self._changed.notify_all()
        for process in processes:
            # The streams of one that is at work are its caller's, who drops it.
            if process in idle:
                process.close()
            else:
                process.end()


def solve_by(solver: Solver, sides: tuple[Any, ...], trace: Callable[[Any], Any] | None) -> Any:
    """A solution by this thread; None where the last still holds. Arguments as ``SolvingPool.solve``."""
    cells, _, _, observations, _ = sides
    return None if solver.rests(cells, observations) else _update_by(solver, sides, trace)


def _update_by(solver: Solver, sides: tuple[Any, ...], trace: Callable[[Any], Any] | None) -> Any:
    cells, transfer, mirrored, observations, camera = sides
    return solver.update(cells, transfer, mirrored, observations, trace, camera)


def serve() -> None:
    """What a process does: solve what comes on its standard input until that ends."""
    with own_streams() as (source, target):
        import warp_ar.light.recovery  # noqa: F401 - what unpickling needs, loaded before it is asked for

        with contextlib.suppress(EOFError, OSError):
            _answer(source, target)


def _answer(source: Any, target: Any) -> None:
    """Solve what comes until the stream ends, which is an ``EOFError`` or an ``OSError``."""

    def trace(emitters: Any) -> Any:
        write_message(target, ("trace", emitters))
        return read_message(source)

    write_message(target, "ready")
    while True:
        solver, sides, traced = read_message(source)
        answer: tuple[str, Any]
        try:
            answer = "solved", (solver, _update_by(solver, sides, trace if traced else None))
        except (EOFError, OSError):
            raise
        except Exception as error:
            answer = "error", error
        write_message(target, answer)


POOL = SolvingPool(max(1, usable_cores() // CORES_EACH))
"""Of this process."""
atexit.register(POOL.close)
