"""A process of its own that compiles CUDA modules for another one, which has translated them.

It reads one job after another, each a line of JSON, and answers each with a line: ``1`` where the binary is there,
``0`` where it is not. When what it reads from ends, so does it, at once.
"""

from __future__ import annotations

import json
import os
import queue
import sys
import threading
from pathlib import Path
from typing import Any, TextIO


def start_warp() -> Any:
    """Warp's function that compiles a file of CUDA; nothing that it prints reaches anybody."""
    if sys.path and Path(sys.path[0]) == Path(__file__).parent:
        sys.path.pop(0)  # this file was run: its neighbours are no modules of their own
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR
    wp.init()
    return wp._src.build.build_cuda, wp._src.context.runtime.get_nvrtc_pch_dir()


def compile_module(build: Any, headers: str | None, job: dict[str, Any]) -> bool:
    """Compile one module.

    Args:
        build: Warp's ``build_cuda``.
        headers: Folder for parsed headers; None: NVRTC keeps them in memory.
        job: ``source`` and ``target``, files; ``arch``; ``options``, the other arguments of ``build_cuda``.

    Returns:
        Whether the binary is there.
    """
    try:
        build(job["source"], job["arch"], job["target"], pch_dir=headers, **job["options"])
    except Exception as error:  # the process that asked compiles it by itself, and says what is wrong
        print(error, file=sys.stderr)
        return False
    return Path(job["target"]).is_file()


def main() -> None:
    """Work on what is read until there is no more of it."""
    answers: TextIO = os.fdopen(os.dup(1), "w", encoding="ascii")
    os.dup2(2, 1)  # native code prints there
    jobs: queue.Queue[dict[str, Any]] = queue.Queue()

    def read() -> None:
        for line in sys.stdin:
            jobs.put(json.loads(line))
        os._exit(0)  # NVRTC cannot be asked to stop

    threading.Thread(target=read, daemon=True).start()
    build, headers = start_warp()
    while True:
        print(int(compile_module(build, headers, jobs.get())), file=answers, flush=True)


if __name__ == "__main__":
    main()
