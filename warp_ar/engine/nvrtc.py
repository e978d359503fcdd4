"""CUDA modules compiled in processes beside this one.

NVRTC does a part of its work, some seventh of it, for one program of a process at a time, so that sixteen threads
finish no sooner than seven. Here each thread hands what Warp has translated to a process of its own
(``nvrtc_process``), which makes the same binary to the byte. The first two threads compile in this process: they begin
with the longest modules, hardly wait for each other, and a process is up only after half a second. So processes pay
where nothing is cached: the modules that one more scene needs are compiled sooner by threads.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import Any, Final

import warp as wp

from warp_ar.errors import UsageError

VARIABLE: Final = "WARP_AR_COMPILERS"
"""Environment variable, for measuring: processes that compile CUDA modules at most; 0: threads of this one alone."""
MOST: Final = 14
"""Processes at most; each takes some 200 MB while it compiles."""
HERE: Final = 2
"""Threads that compile in this process."""
LEAST: Final = 30
"""Modules from which on processes are started: on an H100 they took 4 s off the 41 of ``desk`` and added 1 to 7 s to
those that further scenes lack."""

_THREAD: Final = threading.local()
_OWN: Final = threading.Lock()
_ENABLED = threading.Event()


def compile_beside() -> None:
    """Have CUDA modules compiled by processes from now on. For commands alone: a library starts none."""
    _ENABLED.set()


def compiles_beside() -> bool:
    """Whether this process is a command's, which has modules compiled beside what it does."""
    return _ENABLED.is_set()


@contextlib.contextmanager
def telling_when_translated(translated: threading.Event) -> Iterator[None]:
    """Around what a thread has Warp compile for CUDA: the event is set when NVRTC's part begins.

    Args:
        translated: Another thread may translate from then on. It is set in any case, after an error too.
    """
    _hand_over()
    _THREAD.translated = translated
    try:
        yield
    finally:
        _THREAD.translated = None
        translated.set()


def count_processes(modules: int, cores: int) -> int:
    """Processes to compile so many modules with, beside threads of this one.

    Raises:
        UsageError: The environment variable is no number.
    """
    asked = os.environ.get(VARIABLE, "")
    if asked and not asked.isdecimal():
        raise UsageError(f"{VARIABLE} = {asked!r}: expected a number of processes")
    most = int(asked) if asked else MOST if _ENABLED.is_set() and modules >= LEAST else 0
    return max(min(modules, cores, most + HERE) - HERE, 0)


class Compilers:
    """The processes, each started by the thread that uses it."""

    def __init__(self, count: int, here: int = HERE) -> None:
        """Start none as yet.

        Args:
            count: Processes at most.
            here: Threads that compile in this process, at least.
        """
        self._left, self._most_here = count, here
        self._lock = threading.Lock()
        self._processes: list[subprocess.Popen[str]] = []
        self._here = 0
        self.closed = False
        if count:
            _hand_over()

    @contextlib.contextmanager
    def used(self) -> Iterator[None]:
        """Around what a thread has Warp compile: the thread's own process does it, of all but the first threads."""
        if not hasattr(_THREAD, "process") or _THREAD.owner is not self:
            _THREAD.owner, _THREAD.process = self, self._start()
        yield

    def _start(self) -> subprocess.Popen[str] | None:
        with self._lock:
            if self._here < self._most_here or not self._left:
                self._here += 1
                return None
            self._left -= 1
        from warp_ar.engine import nvrtc_process

        try:
            process = subprocess.Popen(
                [sys.executable, str(nvrtc_process.__file__)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                env={**os.environ, "CUDA_VISIBLE_DEVICES": ""},  # it compiles alone
                start_new_session=True,  # Ctrl-C is for this process, which ends them
            )
        except OSError:
            return None
        with self._lock:
            self._processes.append(process)
        return process

    def close(self) -> None:
        """End the processes, whatever they are at."""
        with self._lock:
            processes, self._processes, self._left, self.closed = self._processes, [], 0, True
        for process in processes:
            process.kill()
        for process in processes:
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    with contextlib.suppress(OSError):
                        pipe.close()


def _hand_over() -> None:
    """Have Warp tell the thread's event and ask its process, where it has one, before it compiles by itself."""
    builder: Any = getattr(getattr(wp, "_src", None), "build", None)
    build = getattr(builder, "build_cuda", None)
    with _OWN:
        if build is None or hasattr(build, "__wrapped__"):
            return

        @functools.wraps(build)
        def build_cuda(
            cu_path: str,
            arch: int,
            output_path: str,
            *,
            pch_dir: str | None = None,
            ltoirs: Any = None,
            fatbins: Any = None,
            **options: Any,
        ) -> None:
            process = getattr(_THREAD, "process", None)
            translated = getattr(_THREAD, "translated", None)
            if translated is not None:
                translated.set()
            job = {"source": cu_path, "arch": arch, "target": output_path, "options": options}
            if process is None or ltoirs or fatbins or not _ask(process, job):
                if process is not None and _THREAD.owner.closed:
                    raise RuntimeError("compiling was interrupted")
                build(cu_path, arch, output_path, pch_dir=pch_dir, ltoirs=ltoirs, fatbins=fatbins, **options)

        builder.build_cuda = build_cuda


def _ask(process: subprocess.Popen[str], job: dict[str, Any]) -> bool:
    """Whether a process has compiled a module."""
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        process.stdin.write(json.dumps(job) + "\n")
        process.stdin.flush()
        answer = process.stdout.readline()
    except (OSError, TypeError, ValueError):
        return False  # it has ended, or what Warp asks for cannot be written down
    return answer == "1\n"
