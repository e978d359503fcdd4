"""Tries every input in this process, which may die of it: ``python -m tests.hostile.attack START [DAMAGES]``.

One line of JSON for each: number, and "read", "refused" with the message, or what went wrong. Memory is limited to what
the process has and 3 GiB more, time to `SECONDS` an input.
"""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import resource
import shutil
import signal
import sys
import tempfile
from typing import Any

from tests.hostile.cases import DAMAGES, Case, all_cases
from warp_ar.errors import WarpArError, printable

SECONDS = 20
"""Of the processor, for an input; and ten times as long by the clock, on a busy machine. A hang takes forever."""
MEMORY = 3 << 30


class TookTooLong(BaseException):
    """An input kept its reader busy."""


def attempt(case: Case, folder: pathlib.Path) -> dict[str, Any]:
    """What became of one input."""

    def give_up(*_: object) -> None:
        raise TookTooLong

    take = case.prepare(folder)
    for number in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(number, give_up)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.alarm(10 * SECONDS)
    try:
        take()
    except WarpArError as error:
        message = str(error)
        shown = printable(message)
        good = "\n" not in message and shown and "Traceback" not in message
        return {"outcome": "refused" if good else "a message of several lines", "message": shown[:300]}
    except TookTooLong:
        return {"outcome": f"took more than {SECONDS} s"}
    except BaseException as error:
        return {"outcome": f"{type(error).__name__}: {printable(error)[:300]}"}
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)
    return {"outcome": "read"}


def limit_memory() -> None:
    """Let this process have `MEMORY` more than it has."""
    import trimesh  # noqa: F401

    import warp_ar.scene.mesh_files  # noqa: F401  loaded before memory is limited, as is all that it loads

    used = int(pathlib.Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))


def main(start: int, damages: int) -> None:
    """Try all inputs from number ``start`` on, with so many damaged copies of each file."""
    limit_memory()
    results = os.fdopen(os.dup(1), "w", buffering=1)
    # Libraries write to both: what counts is on the copy.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(1, 2)
    for number, case in enumerate(all_cases(damages)):
        if number < start:
            continue
        results.write(json.dumps({"number": number, "row": case.row, "what": case.what}) + "\n")
        folder = pathlib.Path(tempfile.mkdtemp())
        try:
            results.write(json.dumps(attempt(case, folder)) + "\n")
        finally:
            with contextlib.suppress(OSError):
                shutil.rmtree(folder)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else DAMAGES)
