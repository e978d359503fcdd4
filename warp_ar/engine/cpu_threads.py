"""Native threads that run a frame's passes on CPU, their tables, and calls back into Python.

``kernels/bands.py`` describes the threads' algorithm and the columns of its tables. This module packs all launches into
the tables once. For each frame it enters the range of rows of each pass. Passes that need Python, such as work on the
host, are run by a callback.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import sys
import threading
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.kernels import bands
from warp_ar.kernels.launch import Note, alone_with_tiles
from warp_ar.stages.base import Pass, Stage

_Entry = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
_Callback = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int64)
_SEMAPHORE_BYTES = 64
_Table = npt.NDArray[np.int64]


class _Packed:
    """Recorded kernel launch, with the packed arguments of the kernel's compiled function."""

    def __init__(self, launch: wp.Launch) -> None:
        names = [argument.label for argument in launch.kernel.adj.args]
        values = launch.params[1:]
        fields = [(name, type(value)) for name, value in zip(names, values, strict=True)]
        self.arguments = type("Arguments", (ctypes.Structure,), {"_fields_": fields})()
        for name, value in zip(names, values, strict=True):
            setattr(self.arguments, name, value)
        self.bounds = launch.bounds
        self.entry = ctypes.cast(launch.hooks.forward, ctypes.c_void_p).value or 0
        self.launch = launch  # this reference keeps the arrays and the loaded module alive

    def call(self) -> None:
        """Run the launch on this thread, without the interpreter's lock."""
        _Entry(self.entry)(ctypes.addressof(self.bounds), ctypes.addressof(self.arguments))


class _System:
    """Functions of the operating system for semaphores, the clock, and yielding the processor."""

    def __init__(self) -> None:
        self.clock_id = 1
        if sys.platform == "win32":
            kernel = ctypes.WinDLL("kernel32")
            kernel.CreateSemaphoreW.restype = ctypes.c_void_p
            self.functions = [
                kernel.WaitForSingleObject,
                kernel.ReleaseSemaphore,
                kernel.SwitchToThread,
                kernel.QueryPerformanceCounter,
            ]
            self.clock_id = -1
            self.make_semaphore: Callable[[], int] = lambda: int(kernel.CreateSemaphoreW(None, 0, 1 << 20, None))
            return
        library = ctypes.CDLL(None)
        if sys.platform == "darwin":
            library.dispatch_semaphore_create.restype = ctypes.c_void_p
            self.functions = [library.dispatch_semaphore_wait, library.dispatch_semaphore_signal]
            self.clock_id = 6
            self.make_semaphore = lambda: int(library.dispatch_semaphore_create(ctypes.c_long(0)))
        else:
            self.functions = [library.sem_wait, library.sem_post]
            self.make_semaphore = self._make_posix
        self.functions += [library.sched_yield, library.clock_gettime]
        self._library, self._kept = library, list[Any]()

    def _make_posix(self) -> int:
        memory = (ctypes.c_int64 * (_SEMAPHORE_BYTES // 8))()
        self._kept.append(memory)
        self._library.sem_init(memory, 0, 0)
        return ctypes.addressof(memory)

    def addresses(self) -> list[int]:
        """Return the addresses of the functions wait, post, yield and clock."""
        return [ctypes.cast(function, ctypes.c_void_p).value or 0 for function in self.functions]


class CpuThreads:
    """Native threads of one scheduler, and the tables of its passes."""

    def __init__(
        self,
        steps: Sequence[tuple[Stage, list[Pass]]],
        notes: Mapping[int, list[Note]],
        readers: Mapping[str, list[str]],
        *,
        threads: int,
        bands_per_pass: int | None,
    ) -> None:
        """Pack all passes; the threads start with the first frame.

        Args:
            steps: Stages with their passes, in order.
            notes: Recorded launches of each pass, by the ``id`` of the pass; a pass without an entry is run by Python.
            readers: Names of the stages that read the output of each stage, by the stage's name.
            threads: Number of threads that process rows, including the caller's.
            bands_per_pass: Number of equal bands of each pass; None: sizes depend on the rows left and on the threads.

        Raises:
            ValueError: There are more stages than the native tables hold.
        """
        self._error: BaseException | None = None
        self._system = _System()
        self._packed: list[Any] = []
        self._host_steps: list[Callable[[], None]] = []
        self._threads: list[threading.Thread] = []
        self._count = threads
        self._names = [stage.name for stage, _ in steps]
        if len(steps) > bands.MOST_STAGES:
            raise ValueError(f"{len(steps)} stages; native threads run at most {bands.MOST_STAGES}")
        self._rows: dict[int, int] = {}  # row of each pass in the pass table, by the pass's id
        self._tiles = False
        self._fill_tables(steps, notes, readers)
        self._fill_state(bands_per_pass)

    def _fill_tables(
        self,
        steps: Sequence[tuple[Stage, list[Pass]]],
        notes: Mapping[int, list[Note]],
        readers: Mapping[str, list[str]],
    ) -> None:
        passes: list[dict[str, int]] = []
        calls: list[dict[str, int]] = []
        stages: list[dict[str, int]] = []
        reading: list[int] = []

        places = {name: place for place, name in enumerate(self._names)}

        def add_host(step: Callable[[], None]) -> None:
            passes.append({"whole": 1, "callback": len(self._host_steps)})
            self._host_steps.append(step)

        for stage, own in steps:
            first = len(passes)
            for step in own:
                self._rows[id(step)] = len(passes)
                packed = self._pack(step, notes[id(step)]) if id(step) in notes else None
                if packed is None:
                    add_host(lambda step=step: step.launch(None))  # type: ignore[misc]
                    continue
                tiles = any(note.tiles for note in notes[id(step)])
                self._tiles = self._tiles or tiles
                span = {"first_call": len(calls), "last_call": len(calls) + len(packed)}
                passes.append({**span, "whole": int(tiles or step.rows is None), "tiles": int(tiles), "callback": -1})
                calls += packed
            told = [places[name] for name in readers[stage.name]]
            stages.append(
                {
                    "first_pass": first,
                    "last_pass": len(passes),
                    "first_reader": len(reading),
                    "last_reader": len(reading) + len(told),
                }
            )
            reading += told
        self._passes = _table(bands.PASS, passes)
        self._calls = _table(bands.CALL, calls)
        self._stages = _table(bands.STAGE, stages)
        self._readers = np.array(reading or [0], np.int64)
        waits = np.bincount(reading, minlength=len(stages)).astype(np.int64)
        begin, end = (_column(self._stages, bands.STAGE, name) for name in ("first_pass", "last_pass"))
        self._owner = np.repeat(np.arange(len(stages)), end - begin)
        self._unbegun = self._stages.copy()
        for name, column in (("waits", waits), ("current", begin), ("ready", 2 * (waits == 0))):
            _column(self._unbegun, bands.STAGE, name)[:] = column
        self._open, self._has_failed = bands.STATE.index("open"), bands.STATE.index("failed")
        self._start, self._stop, self._time = (
            _column(self._passes, bands.PASS, name) for name in ("start", "stop", "time")
        )

    def _pack(self, step: Pass, notes: list[Note]) -> list[dict[str, int]] | None:
        """Return one row of the call table for each launch of a pass; None if the pass must be launched from Python.

        Args:
            step: The pass.
            notes: Its recorded launches and copies.
        """
        rows = []
        for note in notes:
            banded = note.rows is not None
            if step.rows is not None and note.rows != (0, step.rows) and note.arrays is None:
                return None  # the launch does not cover exactly the rows of the pass, so it cannot be split with it
            if note.arrays is not None:
                target, source = note.arrays
                if not (target.is_contiguous and source.is_contiguous and target.shape == source.shape):
                    return None
                height = step.rows or 1
                if target.capacity % height:
                    return None
                row = {"arguments": target.ptr, "row_offset": source.ptr, "argument_bytes": target.capacity // height}
                self._packed.append(note)
                rows.append(row)
                continue
            assert note.record is not None
            packed = _Packed(note.record())
            size = ctypes.sizeof(packed.arguments)
            if size > bands.ARGUMENT_ROOM or ctypes.sizeof(packed.bounds) > bands.BOUNDS_ROOM:
                return None
            self._packed.append(packed)
            bounds = packed.bounds
            offset = getattr(type(packed.arguments), packed.launch.kernel.adj.args[0].label).offset if banded else -1
            rows.append(
                {
                    "entry": packed.entry,
                    "arguments": ctypes.addressof(packed.arguments),
                    "argument_bytes": size,
                    "row_offset": offset,
                    "bounds": ctypes.addressof(bounds),
                    "bounds_bytes": ctypes.sizeof(bounds),
                    "size_offset": type(bounds).size.offset,
                    "row_size": bounds.size // max(bounds.shape[0], 1),
                }
            )
        return rows

    def _fill_state(self, bands_per_pass: int | None) -> None:
        wait, post, let_others, clock = self._system.addresses()
        self._called = _Callback(self._call_back)
        self._state = _table(
            bands.STATE,
            [
                {
                    "threads": self._count,
                    "bands": bands_per_pass or 0,
                    "stages": len(self._names),
                    "clock_id": self._system.clock_id,
                    "semaphore": self._system.make_semaphore(),
                    "caller_semaphore": self._system.make_semaphore(),
                    "wait": wait,
                    "post": post,
                    "let_others": let_others,
                    "clock": clock,
                    "callback": ctypes.cast(self._called, ctypes.c_void_p).value or 0,
                    "stage_table": self._stages.ctypes.data,
                    "pass_table": self._passes.ctypes.data,
                    "call_table": self._calls.ctypes.data,
                    "reader_table": self._readers.ctypes.data,
                }
            ],
        )
        self._failed = wp.zeros(1, dtype=wp.int32, device="cpu")
        self._caller = self._serve(1)
        self._helpers = [self._serve(0) for _ in range(self._count - 1)]
        self._end = weakref.finalize(self, _stop, self._state, self._system, self._count)
        # The threads are not stopped at Python's exit. A thread that was woken then would be unwound through native
        # code, which aborts the process; a sleeping thread ends with the process.
        self._end.atexit = False

    def _serve(self, caller: int) -> _Packed:
        inputs = [wp.uint64(self._state.ctypes.data), caller]
        out = wp.zeros(1, dtype=wp.int32, device="cpu")
        return _Packed(wp.launch(bands.serve_kernel, 1, inputs, [out], device="cpu", record_cmd=True))

    def _call_back(self, number: int) -> int:
        """Run host step ``number`` in Python, on the thread that calls; return 1 if it failed, else 0."""
        try:
            self._host_steps[number]()
        except BaseException as error:  # raised again on the thread that runs the frame
            self._error = error
            return 1
        return 0

    # ---- one frame ------------------------------------------------------------------------------------------------

    def run(self, due: Sequence[tuple[Stage, list[Pass]]]) -> Mapping[str, float]:
        """Run a frame, with this thread as one of the threads.

        Args:
            due: Stages to run, with those of their passes that take part.

        Returns:
            Nanoseconds by stage, summed over all threads.

        Raises:
            BaseException: Error of a step in Python; no thread works on the frame any more.
        """
        for column in (self._start, self._stop, self._time):
            column[:] = 0
        for step in (step for _, steps in due for step in steps):
            all_rows = 0, 1 if step.rows is None else step.rows
            start, stop = all_rows if step.extent is None else step.extent()
            row = self._rows[id(step)]
            self._start[row], self._stop[row] = start, max(start, stop)
        self._stages[:] = self._unbegun
        self._state[0, self._open] = len(self._names)
        self._state[0, self._has_failed] = 0
        if len(self._threads) < len(self._helpers):
            # This object may be garbage collected without having been closed, so each thread refers to all data that it
            # reads until it returns. It does not refer to the callback, which refers to this object and is called only
            # during frames.
            read = (self._state, self._stages, self._passes, self._calls, self._readers, self._system)
            self._threads = [threading.Thread(target=_serve, args=(one, read), daemon=True) for one in self._helpers]
            for thread in self._threads:
                thread.start()
        if self._tiles:
            with alone_with_tiles():
                self._caller.call()
        else:
            self._caller.call()
        if self._error is not None:
            error, self._error = self._error, None
            raise error
        times = np.bincount(self._owner, self._time, len(self._names))
        return dict(zip(self._names, times.tolist(), strict=True))

    def close(self) -> None:
        """End the threads, and release the tables, which refer to the scheduler and it to this object."""
        self._end()
        for thread in self._threads:
            thread.join()
        vars(self).clear()


def _serve(helper: _Packed, read: tuple[Any, ...]) -> None:
    """Run one native thread until it is stopped.

    Args:
        helper: The launch of ``serve_kernel``.
        read: Data that the thread reads; this reference keeps it alive until the thread returns.
    """
    helper.call()
    del read


def _stop(state: _Table, system: _System, count: int) -> None:
    state[0, bands.STATE.index("stop")] = 1
    post, semaphore = system.functions[1], int(state[0, bands.STATE.index("semaphore")])
    for _ in range(count):
        post(ctypes.c_void_p(semaphore), *([ctypes.c_long(1), None] if sys.platform == "win32" else []))


def _table(names: tuple[str, ...], rows: list[dict[str, int]]) -> _Table:
    return np.array([[row.get(name, 0) for name in names] for row in rows], np.int64).reshape(len(rows), len(names))


def _column(table: _Table, names: tuple[str, ...], name: str) -> _Table:
    return table[:, names.index(name)]
