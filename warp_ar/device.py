"""Selection and start of the device that kernels run on."""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import gc
import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from typing import Any, Final

import warp as wp

from warp_ar.errors import UsageError, check_process, say

_ARENA_MAX = -8
"""``M_ARENA_MAX`` of glibc's ``malloc.h``."""
CPU_COMPILER_FLAGS: Final = "-march=native"
"""Compiler flags of all CPU kernels: with them Clang uses LLVM's inlining threshold, 225, instead of Warp's 9,000.

``desk`` at ``medium`` then compiles in 38 s of processor time. The time of a frame is the same as with other
thresholds, within the spread of repeated runs.
"""
_CUDA = threading.RLock()
_TRANSLATION = threading.RLock()
ASK_EVERY = 1e-4
"""Seconds between two polls of an event."""
LONGEST_ASKING = 0.25
"""Seconds of polling an event after which CUDA's own wait, which keeps a core busy, is called."""
_STARTED: list[int] = []
"""Process id in which Warp was started; empty before that."""
_OPENING: list[threading.Thread] = []
"""Thread that is creating a CUDA context; empty if there is none."""


def usable_cores() -> int:
    """Return the number of the host's cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def exclusive(device: Any) -> contextlib.AbstractContextManager[Any]:
    """Return a lock that keeps other threads off a CUDA device while it is held; on CPU it does nothing.

    Warp's current stream, current device and running capture belong to the process, not to the thread. If one thread
    captures a graph, allocations and launches of another would become part of that graph or break it. Launches and
    copies that name their stream do not need the lock.
    """
    return _CUDA if device.is_cuda else contextlib.nullcontext()


@contextlib.contextmanager
def translating(device: Any) -> Iterator[None]:
    """Lock for declaring kernels or launching them for the first time; acquire it before ``exclusive``."""
    with compiling(), exclusive(device):
        yield


@contextlib.contextmanager
def compiling() -> Iterator[None]:
    """Lock for compiling kernels in several threads: no other thread translates kernels meanwhile; frames go on.

    Python 3.11 may collect garbage while its parser runs. A finaliser then lets another thread parse, and both parsers
    fail with "AST constructor recursion depth mismatch" (CPython issue 106905). While the lock is held, garbage
    collection is off.
    """
    with _TRANSLATION:
        collects = gc.isenabled()
        gc.disable()
        try:
            yield
        finally:
            if collects:
                gc.enable()


class _Captures:
    """Lock of one thread that captures a graph, or of several that wait for events: CUDA does not allow both."""

    def __init__(self) -> None:
        self.changed = threading.Condition()
        self.holders = 0
        """Number of threads that wait for events; -1 while a graph is captured."""

    @contextlib.contextmanager
    def held(self, change: int) -> Iterator[None]:
        """Hold the lock to wait for an event (``change`` = 1) or to capture a graph (-1)."""
        with self.changed:
            self.changed.wait_for(lambda: self.holders == 0 or (self.holders > 0 and change > 0))
            self.holders += change
        try:
            yield
        finally:
            with self.changed:
                self.holders -= change
                self.changed.notify_all()


_CAPTURES = _Captures()


def capturing() -> contextlib.AbstractContextManager[None]:
    """Return the context for capturing a graph: no thread waits for an event meanwhile, which CUDA forbids."""
    return _CAPTURES.held(-1)


def wait_for(event: Any) -> None:
    """Wait until a recorded event is complete on its CUDA device.

    The event is polled: CUDA's own wait keeps a core busy. With 16 cameras on 16 cores it took 2.4 of a frame's 8 ms.

    Raises:
        RuntimeError: The launched work has failed.
    """
    stop = time.perf_counter() + LONGEST_ASKING
    while True:
        with _CAPTURES.held(1):
            if event.is_complete:
                return
            if time.perf_counter() > stop:  # an event of failed work never completes; CUDA's own wait raises its error
                wp.synchronize_event(event)
                return
        time.sleep(ASK_EVERY)


@contextlib.contextmanager
def _native_stderr_silenced() -> Iterator[None]:
    """Suppress the output of native code to stderr.

    Without an NVIDIA driver, Warp's start prints a warning there regardless of its log level.
    """
    sys.stderr.flush()
    saved = os.dup(2)
    with open(os.devnull, "wb") as sink:
        os.dup2(sink.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


def start_warp() -> None:
    """Initialise Warp quietly, with this package's compiler flags; further calls do nothing.

    Raises:
        UsageError: This process is a fork of one that has started Warp.
    """
    wp.config.cpu_compiler_flags = CPU_COMPILER_FLAGS
    if _STARTED:
        check_process("Warp was started", _STARTED[0])
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    with _TRANSLATION:
        if not _STARTED:
            _init_warp()
            _STARTED.append(os.getpid())


def _init_warp() -> None:
    """Initialise Warp; if its kernel cache is not writable, put kernels into a temporary folder."""
    if not os.environ.get("WARP_CACHE_PATH", "unset"):
        del os.environ["WARP_CACHE_PATH"]  # Warp would take an empty one for the current folder
    with _native_stderr_silenced():
        try:
            wp.init()
            folder = wp.config.kernel_cache_dir
            with tempfile.TemporaryFile(dir=folder):
                return
        except OSError as error:
            problem = error
        folder = tempfile.mkdtemp(prefix="warp_ar_kernels_")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        os.environ["WARP_CACHE_PATH"] = wp.config.kernel_cache_dir = folder  # in child processes, too
        wp.init()
    say(f"the cache of kernels cannot be written ({problem}); kernels of this run are kept in {folder} until it ends")


def open_ahead(name: str) -> None:
    """Create a CUDA device's context on a thread while this one imports modules; ``resolve_device`` waits for it.

    Args:
        name: ``auto``, ``cpu``, ``cuda`` or ``cuda:N``. If it is no CUDA device of this machine, nothing is done.
    """
    known = [str(device) for device in wp.get_devices() if device.is_cuda]
    wanted = "cuda:0" if name in ("auto", "cuda") else name
    if wanted not in known or _OPENING:
        return

    def open_context() -> None:
        with contextlib.suppress(RuntimeError):  # the first use of the device fails with the same error and reports it
            _ = wp.get_device(wanted).context

    _OPENING.append(threading.Thread(target=open_context, name="warp_ar-open"))
    _OPENING[-1].start()


def resolve_device(name: str = "auto") -> Any:
    """Return the Warp device for ``name``: ``auto`` (CUDA where present, else CPU), ``cpu``, ``cuda`` or ``cuda:N``.

    Raises:
        UsageError: This machine has no such device, or this process is a fork of one that has started Warp.
    """
    start_warp()
    for thread in _OPENING:
        thread.join()
    if name == "auto":
        return wp.get_device("cuda:0") if wp.is_cuda_available() else wp.get_device("cpu")
    known = [str(device) for device in wp.get_devices()]
    wanted = "cuda:0" if name == "cuda" else name
    if wanted not in known:
        raise UsageError(f"device {name!r} does not exist; this machine has auto, {', '.join(known)}")
    return wp.get_device(wanted)


def release_memory() -> None:
    """Return freed memory to the system.

    glibc keeps freed memory below the newest allocation of each thread's arena: after 500 pipelines, built one after
    another on one thread, 2.3 GB of unused memory were left. Other C libraries neither have this call nor need it.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


def bound_arenas(count: int = 2) -> None:
    """Limit the number of glibc's memory arenas for all threads; to be called before many threads are started.

    Each arena keeps its own freed memory. Over 100 changes of quality a page grew by 21 of 315 MB with an arena per
    thread, and by 4 MB with one arena for all.
    """
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            mallopt(_ARENA_MAX, count)
