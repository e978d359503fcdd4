"""Choosing and starting the device that kernels run on."""

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

from warp_ar.errors import UsageError, say

_ARENA_MAX = -8
"""``M_ARENA_MAX`` of glibc's ``malloc.h``."""
CPU_COMPILER_FLAGS: Final = "-march=native"
"""Flags of Clang for every kernel: LLVM's own bound of inlining, 225, instead of Warp's 9,000.

``desk`` at ``medium`` then compiles in 38 s of processor time, and a frame takes as long as with other bounds, within
what repeated runs differ by.
"""
_CUDA = threading.RLock()
_TRANSLATION = threading.RLock()
ASK_EVERY = 1e-4
"""Seconds between two looks at an event that is waited for."""
LONGEST_ASKING = 0.25
"""Seconds after which CUDA itself is made to wait."""
_STARTED: list[int] = []
"""The process in which Warp was started, if it was."""
_OPENING: list[threading.Thread] = []
"""The thread that makes a device's context, if one does."""


def usable_cores() -> int:
    """Cores of the host that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def exclusive(device: Any) -> contextlib.AbstractContextManager[Any]:
    """Keeps other threads off a CUDA device for as long as it is entered; on CPU it does nothing.

    Warp's current stream, current device and running capture belong to the process, not to the thread: what one thread
    allocates or launches while another captures would end up in that graph, or break it. Not meant are launches and
    copies on a stream that they name.
    """
    return _CUDA if device.is_cuda else contextlib.nullcontext()


@contextlib.contextmanager
def translating(device: Any) -> Iterator[None]:
    """Held by who declares kernels or launches them for the first time; to be entered before ``exclusive``."""
    with compiling(), exclusive(device):
        yield


@contextlib.contextmanager
def compiling() -> Iterator[None]:
    """Held by who has kernels compiled, in threads of its own: nobody else translates, frames go on.

    Python 3.11 collects garbage inside its parser; a finalizer lets another thread parse, and then both parsers end in
    "AST constructor recursion depth mismatch" (CPython's issue 106905). Until it is released nothing is collected.
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
    """Turns of those who capture and those who wait for events: CUDA allows one or the other."""

    def __init__(self) -> None:
        self.changed = threading.Condition()
        self.waiting = 0
        self.capturing = False


_CAPTURES = _Captures()


@contextlib.contextmanager
def capturing() -> Iterator[None]:
    """Held around the capture of a graph: no thread waits for an event meanwhile, which CUDA forbids."""
    now = _CAPTURES
    with now.changed:
        now.changed.wait_for(lambda: not now.waiting and not now.capturing)
        now.capturing = True
    try:
        yield
    finally:
        with now.changed:
            now.capturing = False
            now.changed.notify_all()


@contextlib.contextmanager
def _asking() -> Iterator[None]:
    """Held around what CUDA forbids while a graph is captured."""
    now = _CAPTURES
    with now.changed:
        now.changed.wait_for(lambda: not now.capturing)
        now.waiting += 1
    try:
        yield
    finally:
        with now.changed:
            now.waiting -= 1
            now.changed.notify_all()


def wait_for(event: Any) -> None:
    """Wait until an event that has been recorded has come to pass on its CUDA device.

    CUDA's own way keeps a core busy for as long as it waits: with 16 cameras on 16 cores, for 2.4 of a frame's 8 ms.

    Raises:
        RuntimeError: What was launched has failed.
    """
    stop = time.perf_counter() + LONGEST_ASKING
    while True:
        with _asking():
            if event.is_complete:
                return
            if time.perf_counter() > stop:  # an event that never comes is not complete either: this says why
                wp.synchronize_event(event)
                return
        time.sleep(ASK_EVERY)


@contextlib.contextmanager
def _native_stderr_silenced() -> Iterator[None]:
    """Keep what native code prints to stderr off the terminal.

    Without an NVIDIA driver Warp's start warns there, past its own log level.
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
    """Initialise Warp quietly, with the flags of Clang that this package's kernels take; again it does nothing.

    Raises:
        UsageError: This process is a fork of one that has started Warp.
    """
    wp.config.cpu_compiler_flags = CPU_COMPILER_FLAGS
    if _STARTED and os.getpid() not in _STARTED:
        raise UsageError(
            f"Warp was started in process {_STARTED[0]}, of which this one is a fork without its threads and its "
            "device; start processes by spawn"
        )
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    with _TRANSLATION:
        if not _STARTED:
            _init_warp()
            _STARTED.append(os.getpid())


def _init_warp() -> None:
    """Initialise Warp; where its cache of kernels cannot be written, kernels go to a temporary folder."""
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
        os.environ["WARP_CACHE_PATH"] = wp.config.kernel_cache_dir = folder  # of processes that this one starts, too
        wp.init()
    say(f"the cache of kernels cannot be written ({problem}); kernels of this run are kept in {folder} until it ends")


def open_ahead(name: str) -> None:
    """Have a CUDA device's context made beside what this thread imports; ``resolve_device`` waits for it.

    Args:
        name: As for ``resolve_device``; where it is no CUDA device of this machine, nothing is done.
    """
    known = [str(device) for device in wp.get_devices() if device.is_cuda]
    wanted = "cuda:0" if name in ("auto", "cuda") else name
    if wanted not in known or _OPENING:
        return

    def open_context() -> None:
        with contextlib.suppress(RuntimeError):  # who uses the device first meets it too, and says it
            _ = wp.get_device(wanted).context

    _OPENING.append(threading.Thread(target=open_context, name="warp_ar-open"))
    _OPENING[-1].start()


def resolve_device(name: str = "auto") -> Any:
    """Warp device for ``name``: ``auto`` (CUDA where present, else CPU), ``cpu``, ``cuda`` or ``cuda:N``.

    Raises:
        UsageError: The name is no device of this machine, or this process is a fork of one that has started Warp.
    """
    start_warp()
    for thread in _OPENING:
        thread.join()
    if name == "auto":
        return wp.get_device("cuda:0") if wp.is_cuda_available() else wp.get_device("cpu")
    known = [str(device) for device in wp.get_devices()]
    wanted = "cuda:0" if name == "cuda" else name
    if wanted not in known:
        raise UsageError(f"device {name!r} is not here; this machine has auto, {', '.join(known)}")
    return wp.get_device(wanted)


def release_memory() -> None:
    """Hand memory that has been freed back to the system.

    glibc keeps what lies below the newest allocation of each thread's arena: 500 pipelines, built one after another on
    a thread of their own, left 2.3 GB with it that nothing used. Other C libraries have no such call, and no such need.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


def bound_arenas(count: int = 2) -> None:
    """Have glibc serve all threads from so many arenas; to be called before there are many threads.

    Each keeps its own freed memory: over 100 changes of quality a page grew by 21 of 315 MB with one for every thread,
    by 4 with one for all.
    """
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            mallopt(_ARENA_MAX, count)
