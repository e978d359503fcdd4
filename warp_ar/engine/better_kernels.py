"""A process of its own that compiles kernels better than those with which frames have begun, and keeps them.

It reads one job after another, each a line of JSON, and works while a core has nothing else to do. When what it reads
from ends, so does it, at once: nothing is left but what is whole. It compiles what another process has translated
already, and so imports of Warp what calls Clang, without starting it.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import re
import shutil
import sys
import threading
import types
from pathlib import Path
from typing import Any, Final

FOLDER: Final = "better_"
"""What the name of the folder begins with in which a process works, beside the kernels; its number follows."""


def work_folder(cache: Path, process: int) -> Path:
    """Where a process keeps what is not whole yet."""
    return cache / f"{FOLDER}{process}"


def work_beside() -> None:
    """Leave every core to whoever else has anything to do."""
    with contextlib.suppress(OSError):
        if hasattr(os, "SCHED_IDLE"):
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        elif hasattr(os, "nice"):
            os.nice(19)


def work_at_once(process: int) -> None:
    """Let a process that works beside others end as fast as any."""
    with contextlib.suppress(OSError):
        if hasattr(os, "SCHED_IDLE"):
            os.sched_setscheduler(process, os.SCHED_OTHER, os.sched_param(0))


def remove_left_behind(cache: Path) -> None:
    """Remove folders of processes that were killed."""
    for folder in cache.glob(f"{FOLDER}*"):
        number = folder.name[len(FOLDER) :]
        if number.isdecimal() and not _runs(int(number)):
            shutil.rmtree(folder, ignore_errors=True)


def _runs(process: int) -> bool:
    if os.name == "nt":
        return True  # asking would end it
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


class Compiler:
    """Compiles jobs into the kernel cache; Warp is imported by the first of them."""

    def __init__(self, cache: Path) -> None:
        """Make a folder to work in.

        Args:
            cache: Warp's folder of kernels.
        """
        self._cache = cache
        self.folder = work_folder(cache, os.getpid())
        self._headers = self.folder / "headers"
        self._headers.mkdir(parents=True)
        self._build: Any = None

    def compile(self, job: dict[str, Any]) -> None:
        """Compile one module; it appears in the cache whole, or not at all.

        Args:
            job: ``source`` and ``meta``, files that Warp has written for the same module; ``name`` of the module's
                folder in the cache, and of its ``binary`` there; ``headers``, a folder with those that another process
                has parsed, and ``flags_digest``, by which Warp names them; ``library``, Warp's Clang; ``arguments`` of
                Warp's ``build_cpu``.
        """
        target = self._cache / job["name"]
        if target.is_dir():
            return
        if self._build is None:
            self._build = _load_clang(job["library"])
        for path in Path(job["headers"]).glob("*.pch"):
            # Named by flags, of which those that differ say nothing about headers; Clang looks whether they fit.
            name = re.sub(r"_f[0-9a-f]{16}(?=\.pch$)", f"_f{job['flags_digest']}", path.name)
            if not (self._headers / name).exists():
                shutil.copyfile(path, self._headers / name)
        part = self.folder / job["name"]
        part.mkdir()
        source = part / f"{job['name']}.cpp"
        shutil.copyfile(job["source"], source)
        shutil.copyfile(job["meta"], part / f"{job['name']}.meta")
        self._build(str(part / job["binary"]), str(source), pch_dir=str(self._headers), **job["arguments"])
        if (part / job["binary"]).stat().st_size:
            with contextlib.suppress(OSError):  # another process was faster
                part.rename(target)


def _load_clang(library: str) -> Any:
    """Warp's function that compiles a file of C++, without the rest of Warp being started."""
    import ctypes

    if sys.path and Path(sys.path[0]) == Path(__file__).parent:
        sys.path.pop(0)  # this file was run: its neighbours are no modules of their own
    from warp._src import build, context

    context.runtime = types.SimpleNamespace(llvm=ctypes.CDLL(library))
    return build.build_cpu


def main() -> None:
    """Work on what is read until there is no more of it; the cache is the one argument."""
    cache = Path(sys.argv[1])
    work_beside()
    remove_left_behind(cache)
    compiler = Compiler(cache)
    jobs: queue.Queue[dict[str, Any]] = queue.Queue()

    def read() -> None:
        for line in sys.stdin:
            jobs.put(json.loads(line))
        work_at_once(0)
        shutil.rmtree(compiler.folder, ignore_errors=True)
        os._exit(0)  # Clang cannot be asked to stop

    threading.Thread(target=read, daemon=True).start()
    while True:
        compiler.compile(jobs.get())


if __name__ == "__main__":
    main()
